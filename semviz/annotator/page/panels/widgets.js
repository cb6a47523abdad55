// @ts-check
// Parts of panels: rows, titles, and elements that are rebuilt only on change.
/** @import {Child, Properties} from "/static/dom.js" */
/** @import {Keys} from "/static/keys.js" */
/** @import {State} from "../state.js" */
import { byId, el, fill } from "/static/dom.js";

/** Rebuilds elements of the page only if their contents change: a click needs its row to stay. */
export class RenderCache {
  /** @param {State} state */
  constructor(state) {
    this.state = state;
    /** @type {Record<string, string>} */
    this.shown = {};
  }

  /** Fills the element `id` with the result of `build` if `shown`, theme or keys have changed.
   *
   * @param {string} id
   * @param {unknown} shown
   * @param {() => Child[]} build
   */
  show(id, shown, build) {
    const { theme, changedKeys } = this.state;
    const key = JSON.stringify([shown, theme, changedKeys]);
    if (this.shown[id] === key) return;
    this.shown[id] = key;
    const list = byId(id);
    const focused = [...list.querySelectorAll("button")].findIndex((button) => button === document.activeElement);
    fill(list, build());
    if (focused >= 0) list.querySelectorAll("button")[focused]?.focus();
  }
}

/** A clickable row of a list.
 *
 * @param {Properties} properties
 * @param {...Child} children
 */
export function row({ chosen = false, ...properties }, ...children) {
  return el("button", { class: chosen ? "row chosen" : "row", ...properties }, ...children);
}

/** A badge with the present key of a command, by the name of its default key.
 *
 * @param {Keys} keys
 * @param {string} name
 */
export function badge(keys, name) {
  return el("kbd", { text: keys.shown(name) });
}

/** A panel's header: title and subtitle, with an optional glyph before and chip after them.
 *
 * @param {string} name
 * @param {string} about
 * @param {Child} glyph
 * @param {Child} end
 */
export function header(name, about, glyph = null, end = null) {
  return el("header", {}, glyph, el("h2", { text: name }), el("span", { class: "about", text: about }), end);
}

/** @param {string} text */
export const capital = (text) => text[0].toUpperCase() + text.slice(1);
