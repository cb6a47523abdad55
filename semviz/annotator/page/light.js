// Brightness and contrast of the images, kept for each workspace.
import { byId } from "/static/dom.js";
import { PLAIN_LIGHT } from "./state.js";

const NAMES = Object.keys(PLAIN_LIGHT);

export class Light {
  constructor(state) {
    this.state = state;
    this.place = null; // in localStorage
    for (const name of NAMES) byId(name).addEventListener("input", () => this.#set({ ...state.light, [name]: Number(byId(name).value) }));
    byId("plain-light").addEventListener("click", () => this.#set({ ...PLAIN_LIGHT }));
  }

  /** What the workspace was looked at with last. */
  start() {
    this.place = `semviz.light.${this.state.hello.key}`;
    this.state.set({ light: { ...PLAIN_LIGHT, ...JSON.parse(localStorage.getItem(this.place) ?? "{}") } });
  }

  show() {
    byId("light").hidden = !this.state.aids.bright;
    for (const name of NAMES) {
      byId(name).value = this.state.light[name];
      byId(`${name}-value`).textContent = `${Math.round(100 * this.state.light[name])} %`;
    }
  }

  #set(light) {
    localStorage.setItem(this.place, JSON.stringify(light));
    this.state.set({ light });
  }
}
