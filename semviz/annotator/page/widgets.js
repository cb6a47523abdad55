// What the panels are made of: rows, titles, and lists that stay while what they show stays.
import { byId, el } from "/static/dom.js";

/** Lists by their id. One is rebuilt only when what it shows has changed: a click needs its row to stay. */
export class Kept {
  constructor(state) {
    this.state = state;
    this.shown = {};
  }

  /** Fills the element `id` with what `build` returns, if `shown`, theme or keys are others than last time. */
  show(id, shown, build) {
    const { theme, changedKeys } = this.state;
    const key = JSON.stringify([shown, theme, changedKeys]);
    if (this.shown[id] === key) return;
    this.shown[id] = key;
    const list = byId(id);
    const focused = [...list.querySelectorAll("button")].indexOf(document.activeElement);
    list.replaceChildren(...build());
    if (focused >= 0) list.querySelectorAll("button")[focused]?.focus();
  }
}

/** A line of a list that can be pressed. */
export function row({ chosen = false, ...properties }, ...children) {
  return el("button", { class: chosen ? "row chosen" : "row", ...properties }, ...children);
}

/** The key of a command as it is now, by the name of the command's own key. */
export function badge(keys, name) {
  return el("kbd", { text: keys.shown(name) });
}

/** A panel's title, what it is about, and maybe a glyph before and a chip after them. */
export function header(name, about, glyph = null, end = null) {
  return el("header", {}, glyph, el("h2", { text: name }), el("span", { class: "about", text: about }), end);
}

export const capital = (text) => text[0].toUpperCase() + text.slice(1);
