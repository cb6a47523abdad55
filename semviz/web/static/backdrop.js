// @ts-check
/* What the 3D pane draws behind everything else: ground and backdrop. */

/** An object of viser's scene, as three.js has it.
 *
 * @typedef {{
 *   renderOrder: number,
 *   onAfterRender: (renderer: {clearDepth: () => void}) => void,
 *   traverse: (act: (one: SceneObject) => void) => void,
 * }} SceneObject
 */

const BACKDROP = "/backdrop";
const BEHIND = ["/grid", "/road", BACKDROP]; // from the farthest: each covers those before it

/** To be called before each picture. Each of these objects is drawn before all others, and then its
 * depth is forgotten: so no pole is hidden by the points of what stands before it.
 *
 * @param {{[name: string]: SceneObject | null | undefined}} nodes by name
 */
export function putBehind(nodes) {
  if (!nodes[BACKDROP]) return;
  BEHIND.forEach((name, place) => {
    nodes[name]?.traverse((one) => {
      one.renderOrder = place - BEHIND.length;
      one.onAfterRender = (renderer) => renderer.clearDepth();
    });
  });
}
