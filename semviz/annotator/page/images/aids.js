// @ts-check
// Display aids with their switches; brightness and contrast of the images.
/** @import {Keys} from "/static/keys.js" */
/** @import {State} from "../state.js" */
/** @import {Aids as Switches} from "../values.js" */
import { byId, el } from "/static/dom.js";
import { PLAIN_LIGHT } from "../state.js";
import { RenderCache, badge, row } from "../panels/widgets.js";

/** @type {[keyof Switches, string, string][]} */
const AIDS = [
  ["snap", "Snap to edge", "M"],
  ["whole", "Whole pole", "Shift P"],
  ["loupe", "Loupe", "L"],
  ["guides", "Epipolar line", "I"],
  ["proposals", "Proposals", "G"],
  ["bright", "Brightness", "B"],
  ["map", "3D map", "F"],
];

export class Aids {
  /**
   * @param {State} state
   * @param {Keys} keys
   */
  constructor(state, keys) {
    this.state = state;
    this.keys = keys;
    this.cache = new RenderCache(state);
  }

  show() {
    this.cache.show("aids", this.state.aids, () => AIDS.map((aid) => this.#row(aid)));
  }

  /** @param {[keyof Switches, string, string]} aid */
  #row([aid, text, key]) {
    const on = this.state.aids[aid];
    const toggle = () => this.state.set({ aids: { ...this.state.aids, [aid]: !on } });
    return row({ onclick: toggle, role: "switch", "aria-checked": on },
      el("i", { class: on ? "switch on" : "switch" }), el("span", { class: "fill", text }), badge(this.keys, key));
  }
}

/** @type {("brightness" | "contrast")[]} */
const NAMES = ["brightness", "contrast"];

/** The sliders of the aid `bright`; their values are stored for each workspace. */
export class Light {
  /** @param {State} state */
  constructor(state) {
    this.state = state;
    this.storageKey = "";
    for (const name of NAMES) {
      const slider = byId(name, HTMLInputElement);
      slider.addEventListener("input", () => this.#set(name, Number(slider.value)));
      byId(`${name}-value`).title = `Back to ${percent(PLAIN_LIGHT[name])}`;
      byId(`${name}-value`).addEventListener("click", () => this.#set(name, PLAIN_LIGHT[name]));
    }
  }

  /** Restores the values that were used last. */
  start() {
    this.storageKey = `semviz.light.${this.state.workspace.key}`;
    this.state.set({ light: { ...PLAIN_LIGHT, ...JSON.parse(localStorage.getItem(this.storageKey) ?? "{}") } });
  }

  show() {
    byId("light").hidden = !this.state.aids.bright;
    for (const name of NAMES) {
      byId(name, HTMLInputElement).value = String(this.state.light[name]);
      byId(`${name}-value`).textContent = percent(this.state.light[name]);
    }
  }

  /**
   * @param {"brightness" | "contrast"} name
   * @param {number} value
   */
  #set(name, value) {
    const light = { ...this.state.light, [name]: value };
    localStorage.setItem(this.storageKey, JSON.stringify(light));
    this.state.set({ light });
  }
}

/** @param {number} value */
const percent = (value) => `${Math.round(100 * value)} %`;
