// @ts-check
// The backdrop of the 3D map: asks for what its switch says, which this browser keeps.
/** @import {Keys} from "/static/keys.js" */
/** @import {Page} from "./main.js" */
/** @import {State} from "./state.js" */
import { byId, find } from "/static/dom.js";

const STORED = "semviz.annotate.backdrop";

export class Backdrop {
  /**
   * @param {State} state
   * @param {Keys} keys
   * @param {Pick<Page, "socket" | "notify">} page
   */
  constructor(state, keys, page) {
    this.state = state;
    this.keys = keys;
    this.page = page;
    this.asked = false; // the last switch that the server was told
    byId("backdrop").addEventListener("click", () => {
      state.set({ aids: { ...state.aids, backdrop: !state.aids.backdrop } });
    });
  }

  /** Shown unless it was switched off here; without one, nothing is said. */
  async start() {
    if (localStorage.getItem(STORED) !== "off") await this.#ask(true);
  }

  /** Follows the switch. */
  async show() {
    const shown = this.state.aids.backdrop;
    byId("backdrop").setAttribute("aria-pressed", String(shown));
    find(byId("backdrop"), "kbd").textContent = this.keys.shown("Shift B");
    if (shown === this.asked) return;
    const note = await this.#ask(shown);
    this.page.notify(note);
    if (!note) localStorage.setItem(STORED, shown ? "on" : "off");
  }

  /** Returns why there is none to show; empty where there is one.
   *
   * @param {boolean} shown
   * @returns {Promise<string>}
   */
  async #ask(shown) {
    this.#turn(shown);
    const { available, note } = await this.page.socket.request("set_backdrop", { shown });
    if (!available) this.#turn(false);
    return note;
  }

  /** @param {boolean} shown */
  #turn(shown) {
    this.asked = shown;
    this.state.set({ aids: { ...this.state.aids, backdrop: shown } });
  }
}
