// What helps the eye, each with its switch.
import { el } from "/static/dom.js";
import { Kept, badge, row } from "./widgets.js";

const AIDS = [
  ["snap", "Snap to edge", "M"],
  ["loupe", "Loupe", "L"],
  ["guides", "Epipolar line", "I"],
  ["ghosts", "Ghosts", "G"],
  ["bright", "Brightness", "B"],
  ["map", "3D map", "F"],
];

export class Aids {
  constructor(state, keys) {
    this.state = state;
    this.keys = keys;
    this.kept = new Kept(state);
  }

  show() {
    this.kept.show("aids", this.state.aids, () => AIDS.map((aid) => this.#row(aid)));
  }

  #row([aid, text, key]) {
    const on = this.state.aids[aid];
    const toggle = () => this.state.set({ aids: { ...this.state.aids, [aid]: !on } });
    return row({ onclick: toggle, role: "switch", "aria-checked": on },
      el("i", { class: on ? "switch on" : "switch" }), el("span", { class: "fill", text }), badge(this.keys, key));
  }
}
