// Brightness and contrast of the images, kept for each workspace.
import { byId } from "/static/dom.js";
import { PLAIN_LIGHT } from "./state.js";

const NAMES = Object.keys(PLAIN_LIGHT);

export class Light {
  constructor(state) {
    this.state = state;
    this.place = null; // in localStorage
    for (const name of NAMES) {
      byId(name).addEventListener("input", () => this.#set(name, Number(byId(name).value)));
      byId(`${name}-value`).title = `Back to ${percent(PLAIN_LIGHT[name])}`;
      byId(`${name}-value`).addEventListener("click", () => this.#set(name, PLAIN_LIGHT[name]));
    }
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
      byId(`${name}-value`).textContent = percent(this.state.light[name]);
    }
  }

  #set(name, value) {
    const light = { ...this.state.light, [name]: value };
    localStorage.setItem(this.place, JSON.stringify(light));
    this.state.set({ light });
  }
}

const percent = (value) => `${Math.round(100 * value)} %`;
