// @ts-check
// Who labels here besides oneself, and where: initials in the top bar.
/** @import {annotator} from "/static/protocol" */
/** @import {Page} from "./main.js" */
/** @import {State} from "./state.js" */
import { el } from "/static/dom.js";
import { RenderCache } from "./widgets.js";

const MOST = 4; // initials in the top bar, of those who are here first

export class People {
  /**
   * @param {State} state
   * @param {Pick<Page, "go" | "socket">} page
   */
  constructor(state, page) {
    this.state = state;
    this.page = page;
    this.cache = new RenderCache(state);
    /** @type {annotator.PersonView[]} */
    this.known = [];
    page.socket.on("people", ({ people }) => {
      this.known = people;
      state.set({});
    });
  }

  /** The others; empty while one labels alone. */
  get others() {
    const { author, is_blind: isBlind } = this.state.workspace;
    return isBlind ? [] : this.known.filter(({ name }) => name !== author);
  }

  show() {
    const { others } = this;
    this.cache.show("people", [others, this.state.connected], () => [
      ...[...others].sort((a, b) => b.frames.length - a.frames.length).slice(0, MOST).map((person) => this.#chip(person)),
      others.length > MOST ? el("span", { class: "dim", text: `+${others.length - MOST}` }) : null,
      others.length ? el("span", { class: "dim people-here", text: this.#summary() }) : null,
    ]);
  }

  #summary() {
    const here = this.others.filter(({ frames }) => frames.length).length;
    const away = this.others.length - here;
    return [`${here} here`, away ? `${away} away` : ""].filter(Boolean).join(", ");
  }

  /** @param {annotator.PersonView} person */
  #chip({ name, role, frames }) {
    const isHere = frames.length > 0 && this.state.connected;
    const where = isHere ? `frame ${frames.join(", ")}; click to go there` : "away";
    return el("button", {
      class: isHere ? "person" : "person away", title: `${name} (${role}): ${where}`, "aria-label": `${name}, ${where}`,
      onclick: () => { if (frames.length) this.page.go(frames[0]); },
    }, initials(name));
  }
}

/** The first letters of a name.
 *
 * @param {string} name
 */
function initials(name) {
  const words = name.split(/[\s.-]+/).filter(Boolean);
  return (words.length > 1 ? words[0][0] + words[1][0] : name.slice(0, 2)).toLowerCase();
}
