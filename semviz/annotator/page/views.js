// @ts-check
// The views of the page, as tabs in the top bar: images, filmstrip, tracks, poses, team, your drive.
/** @import {Command, Keys} from "/static/keys.js" */
/** @import {State} from "./state.js" */
import { byId } from "/static/dom.js";
import { signature } from "/static/keys.js";

/** @typedef {State["view"]} View */
/** A part of the page that is a view of its own.
 * @typedef {{entered?: () => void, left?: () => void}} Part */
/** @type {View[]} */
export const VIEWS = ["images", "filmstrip", "tracks", "poses", "team", "drive"];

/** Commands of the images that work in every view, by their group and default key. */
const EVERYWHERE = new Set(["History", "General"]);
const ALSO = new Set([",", ".", "ctrl+g", "ctrl+."]);

/** The name of a view in the table of keys. */
const keyed = (/** @type {View} */ view) => (view === "images" ? "" : view);

export class Views {
  /**
   * @param {State} state
   * @param {Keys} keys
   * @param {{go: (frame: number | null) => void}} page
   * @param {Partial<Record<View, Part>>} parts
   */
  constructor(state, keys, page, parts) {
    this.state = state;
    this.keys = keys;
    this.page = page;
    this.parts = parts;
    keys.enter = (name) => this.open(VIEWS.find((view) => keyed(view) === name) ?? "images");
    for (const view of VIEWS) byId(`tab-${view}`).addEventListener("click", () => this.open(view));
  }

  /** Shows one of the views; the address names it.
   *
   * @param {View} view
   */
  open(view) {
    const before = this.state.view;
    if (before === view) return;
    this.state.set({ view });
    this.keys.view = keyed(view);
    this.page.go(this.state.frame);
    this.parts[before]?.left?.();
    this.parts[view]?.entered?.();
  }

  /** Opens the view that the address names. */
  openNamed(/** @type {string | null} */ name) {
    const view = VIEWS.find((one) => one === name);
    if (view) this.open(view);
  }

  /** The commands of the images, which rest in other views unless they are about frames or the whole page.
   *
   * @param {Command[]} commands
   * @returns {Command[]}
   */
  ofImages(commands) {
    return commands.map((command) =>
      EVERYWHERE.has(command.group) || ALSO.has(signature(command)) ? command : { ...command, view: "" });
  }

  /** @returns {Command[]} */
  commands() {
    const titles = /** @type {[string, View, string, string][]} */ ([
      ["F2", "images", "Show the images", ""],
      ["F7", "filmstrip", "Show the filmstrip: accept a stretch of frames", "between interpolate key frames stretch"],
      ["F3", "tracks", "Show the tracks: every element in every frame", "matrix table bulk"],
      ["F4", "poses", "Show the poses against the images", "check trajectory"],
      ["F8", "team", "Show the team: who has what, the review queue", "people assign comments"],
      ["F9", "drive", "Show your drive: checks of the import", "calibration import trajectory"],
    ]);
    return titles.map(([key, view, title, words]) => ({ key, group: "General", row: "Views", title, words, run: () => this.open(view) }));
  }

  /** Marks the tab; called whenever the state of the page changes. */
  show() {
    const { view, workspace } = this.state;
    byId("tab-team").hidden = workspace.is_blind;
    byId("blind").hidden = !workspace.is_blind;
    for (const one of VIEWS) {
      byId(`tab-${one}`).setAttribute("aria-current", String(one === view));
      if (one === "images") continue;
      document.body.classList.toggle(one, one === view);
      byId(one).hidden = one !== view;
    }
  }
}
