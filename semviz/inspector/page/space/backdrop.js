// @ts-check
/* The backdrop: its button. Where there is none to show, the button says why. */

import { byId } from "/static/dom.js";
import { flag, yes } from "../address.js";

/** @typedef {import("/static/protocol").inspector.BackdropEvent} BackdropEvent */
/** @typedef {import("/static/keys.js").Command} Command */
/** @typedef {import("../panel.js").AddressPart} AddressPart */
/** @typedef {import("../main.js").Page} Page */

const ABOUT = "Coloured points of the street behind the map";

export class Backdrop {
  /** @param {Page} page */
  constructor(page) {
    this.page = page;
    this.available = false;
    page.socket.on("backdrop", (event) => this.showBackdrop(event));
    byId("backdrop").addEventListener("click", () => this.toggle());
  }

  /** @returns {Command[]} */
  commands() {
    return [{ key: "b", shift: true, group: "3D", title: "Backdrop: the street in colour", run: () => this.toggle() }];
  }

  /** @returns {AddressPart[]} */
  address() {
    return [{
      fields: { backdrop: flag("yes") },
      get: () => ({ backdrop: yes(this.page.store.state.backdrop) }),
      set: ({ backdrop }) => this.page.socket.send("set_backdrop", { shown: backdrop === "yes" }),
    }];
  }

  /** Without one it asks again: one may have been made meanwhile. */
  async toggle() {
    const shown = !(this.available && this.page.store.state.backdrop);
    const { note } = await this.page.socket.request("set_backdrop", { shown });
    this.page.notice(note, true);
  }

  showState() {
    byId("backdrop").setAttribute("aria-pressed", String(this.available && this.page.store.state.backdrop));
  }

  /** @param {BackdropEvent} event */
  showBackdrop({ available, note }) {
    this.available = available;
    byId("backdrop").title = note || ABOUT;
    byId("backdrop").classList.toggle("missing", !available);
    this.showState();
  }
}
