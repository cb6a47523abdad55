// @ts-check
/* The 3D pane: viser in an iframe, without its own panels, with the keys of the page. */

import { putBehind } from "./backdrop.js";

/** Internals of viser that its own tests use.
 *
 * @typedef {{
 *   backgroundMaterial?: {visible: boolean},
 *   messageQueue?: {type: string}[],
 *   nodeRefFromName?: {[name: string]: import("./backdrop.js").SceneObject | null | undefined},
 * }} ViserState
 */
/** @typedef {Window & {__viserMutable?: ViserState, document: Document}} ViserWindow */

const LOOK = `canvas { cursor: crosshair !important; }
  html { color-scheme: normal !important; }
  html, body, div:has(canvas) { background: none !important; }
  [data-floating-window], .mantine-Notifications-root,
  :has([data-dock-root]) ~ .mantine-Paper-root { display: none !important; }`; // the last one is for narrow panes

const LONGEST_HOLD_MS = 300;

/** Shows the scene of `session` in `frame` (an iframe) and sends its key presses to `keys`. The frame gets
 * the class "ready" when viser's own panels are hidden. Returns the pane's `RenderGate`.
 *
 * @param {HTMLIFrameElement} frame
 * @param {string} session
 * @param {import("./keys.js").Keys} keys
 */
export function showScene(frame, session, keys) {
  const gate = new RenderGate();
  frame.onload = () => { // in place of the one of an earlier scene that has not loaded
    frame.onload = null;
    const inside = frame.contentDocument;
    const view = /** @type {ViserWindow | null} */ (frame.contentWindow);
    if (!inside || !view) return; // the browser's own error page
    const style = inside.createElement("style");
    style.textContent = LOOK;
    inside.head.append(style);
    keys.listen(view, true);
    speedUp(view, gate);
    frame.classList.add("ready");
  };
  Object.assign(frame.style, { background: "var(--scene)", colorScheme: "normal" }); // of either theme
  frame.src = `view/${encodeURIComponent(session)}/`;
  return gate;
}

/** Holds back rendering of the pane. Without a GPU each rendering blocks the page, and viser renders once
 * a second even if nothing changed. A new scene also comes in two parts, cameras first. */
export class RenderGate {
  /** @type {Set<"release" | "scene">} */
  #awaited = new Set();
  /** @type {(() => void)[]} */
  #waiting = [];
  /** @type {ReturnType<typeof setTimeout> | undefined} */
  #timer;

  /** Holds rendering until `release` and, if `forScene`, until another scene has arrived.
   *
   * @param {boolean} forScene
   */
  hold(forScene) {
    this.#awaited.add("release");
    if (forScene) this.#awaited.add("scene");
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#arrived("scene", "release"), LONGEST_HOLD_MS);
  }

  release() {
    this.#arrived("release");
  }

  /** Intercepts viser's rendering and its messages from now on.
   *
   * @param {ViserWindow} view
   */
  watch(view) {
    const messageQueue = view.__viserMutable?.messageQueue;
    if (!messageQueue) return; // another version of viser
    const request = view.requestAnimationFrame.bind(view);
    const draw = (/** @type {FrameRequestCallback} */ callback) => request((time) => {
      if (this.#awaited.size) this.#waiting.push(() => draw(callback));
      else {
        putBehind(view.__viserMutable?.nodeRefFromName ?? {});
        callback(time);
      }
    });
    view.requestAnimationFrame = draw;
    messageQueue.push = (...messages) => {
      if (!messages.every(({ type }) => type.startsWith("SetCamera"))) this.#arrived("scene");
      return Array.prototype.push.apply(messageQueue, messages);
    };
  }

  /** @param {...("release" | "scene")} events */
  #arrived(...events) {
    for (const event of events) this.#awaited.delete(event);
    if (!this.#awaited.size) for (const proceed of this.#waiting.splice(0)) proceed();
  }
}

/** Avoids unnecessary renderings, which are slow without a GPU.
 *
 * @param {ViserWindow} view
 * @param {RenderGate} gate
 */
function speedUp(view, gate) {
  // viser applies messages while it renders and shows them one rendering later; only in a hidden
  // document it applies them at once, so that the next rendering shows them
  Object.defineProperty(view.document, "hidden", { get: () => true });
  whenDrawn(view, 100, (backgroundMaterial) => {
    backgroundMaterial.visible = false; // the page provides the background, instead of viser
    gate.watch(view);
  });
}

/** Calls `act` with the scene's background as soon as viser renders.
 *
 * @param {ViserWindow} view
 * @param {number} tries
 * @param {(background: {visible: boolean}) => void} act
 */
function whenDrawn(view, tries, act) {
  const background = view.__viserMutable?.backgroundMaterial;
  if (background) act(background);
  else if (tries) setTimeout(() => whenDrawn(view, tries - 1, act), 100);
}
