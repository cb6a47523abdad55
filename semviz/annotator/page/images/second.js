// @ts-check
// The second image: the usual one, the same camera some frames apart, or another camera of the rig.
/** @import {annotator} from "/static/protocol" */
/** @import {Command, Keys} from "/static/keys.js" */
/** @import {Page} from "../main.js" */
/** @import {State} from "../state.js" */
import { byId, el } from "/static/dom.js";
import { RenderCache } from "../panels/widgets.js";

const STEPS = [-1, -2, -5, -10, 1, 2, 5, 10]; // frames, earlier ones first

export class SecondChoice {
  /**
   * @param {State} state
   * @param {Keys} keys
   * @param {Pick<Page, "go">} page
   */
  constructor(state, keys, page) {
    this.state = state;
    this.keys = keys;
    this.cache = new RenderCache(state);
    this.list = byId("second", HTMLSelectElement);
    this.list.addEventListener("change", () => {
      state.set({ wish: wishOf(this.list.value) });
      page.go(state.frame);
      this.list.blur(); // keys act on the images again
    });
  }

  show() {
    const { wish, workspace } = this.state;
    const chosen = textOf(wish);
    this.list.title = `Second image (${this.keys.shown("Shift V")})`;
    const here = this.state.panes.left?.camera ?? "";
    this.cache.show("second", here, () => options(workspace, here).map(([value, text]) => el("option", { value, text })));
    this.list.value = chosen;
    if (this.list.selectedIndex < 0) this.list.value = ""; // this camera is in the left image
  }

  open() {
    this.list.focus();
    this.list.showPicker?.();
  }
}

/** Commands for `Keys`.
 *
 * @param {State} state
 * @param {Pick<Page, "go" | "second">} page
 * @returns {Command[]}
 */
export function secondCommands(state, page) {
  const { cameras } = state.workspace;
  const commands = [{ key: "v", shift: true, group: "View", title: "Choose the second image", words: "mono stereo camera baseline", run: () => page.second.open() }];
  if (cameras.length > 1) {
    commands.push({ key: "c", shift: true, group: "Frames", title: "Next camera, same time", words: "rig side", run: () => page.go(inNextCamera(state)) });
  }
  return commands;
}

/** The frame that the next camera of the rig took at the time of the frame on screen.
 *
 * @param {State} state
 */
function inNextCamera({ workspace, panes, received }) {
  const { cameras } = workspace;
  const next = cameras[(cameras.indexOf(panes.left?.camera ?? "") + 1) % cameras.length];
  return received?.frame?.at_that_time[next] ?? null;
}

/** Values and texts of the list.
 *
 * @param {annotator.WorkspaceView} workspace
 * @param {string} here camera of the left image
 * @returns {[string, string][]}
 */
function options({ has_right: hasRight, cameras }, here) {
  const others = cameras.filter((name) => name !== here);
  return [
    ["", hasRight ? "Right" : "Best angle"],
    ...others.map((name) => /** @type {[string, string]} */ ([name, name])),
    ...STEPS.map((step) => /** @type {[string, string]} */ ([textOf({ camera: null, step }), `${Math.abs(step)} ${Math.abs(step) === 1 ? "frame" : "frames"} ${step < 0 ? "back" : "ahead"}`])),
  ];
}

/** @param {annotator.SecondImage | null} wish */
function textOf(wish) {
  if (!wish) return "";
  return wish.camera ?? `${(wish.step ?? 0) > 0 ? "+" : ""}${wish.step}`;
}

/**
 * @param {string} text
 * @returns {annotator.SecondImage | null}
 */
export function wishOf(text) {
  if (!text) return null;
  return /^[+-]?\d+$/.test(text) ? { camera: null, step: Number(text) } : { camera: text, step: null };
}

/** The wish that an address holds: `?second=CAM_BACK`, or `?second=-5`.
 *
 * @param {string} search
 */
export function wishInAddress(search) {
  return wishOf(new URLSearchParams(search).get("second") ?? "");
}

/** The part of the address that holds a wish.
 *
 * @param {annotator.SecondImage | null} wish
 */
export function inAddress(wish) {
  return wish ? `&second=${encodeURIComponent(textOf(wish))}` : "";
}
