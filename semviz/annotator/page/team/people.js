// @ts-check
// Who labels here besides oneself, and where: initials in the top bar; the page may follow one of them.
/** @import {annotator} from "/static/protocol" */
/** @import {Command} from "/static/keys.js" */
/** @import {Page} from "../main.js" */
/** @import {State} from "../state.js" */
import { el } from "/static/dom.js";
import { ownerOf } from "../panels/jumps.js";
import { RenderCache } from "../panels/widgets.js";

const MOST = 4; // initials in the top bar, of those who are here first

export class People {
  /**
   * @param {State} state
   * @param {Page} page
   */
  constructor(state, page) {
    this.state = state;
    this.page = page;
    this.cache = new RenderCache(state);
    /** @type {annotator.PersonView[]} */
    this.known = [];
    this.owner = ""; // whose frames the last edit was in
    this.followed = ""; // the name of who is followed
    /** @type {number | null} */
    this.led = null; // the frame to which following them led
    page.socket.on("people", ({ people }) => {
      const before = this.#framesOf(this.followed);
      this.known = people;
      this.#lead(before);
      state.set({});
    });
  }

  /** The others; empty while one labels alone. */
  get others() {
    const { author, is_blind: isBlind } = this.state.workspace;
    return isBlind ? [] : this.known.filter(({ name }) => name !== author);
  }

  /** @returns {Command[]} */
  commands() {
    return [{ key: "l", shift: true, view: "team", group: "Team", title: "Follow somebody, or nobody any more", words: "people presence watch", run: () => this.toggle() }];
  }

  /** Follows somebody: the page goes to each frame they go to, until one goes elsewhere oneself.
   *
   * @param {string} name empty: whose frame waits for review, or who is here
   */
  toggle(name = "") {
    const { page, state } = this;
    const here = this.others.filter(({ frames }) => frames.length).map((person) => person.name);
    const chosen = name || (here.find((one) => page.team.isShown && one === page.team.entry?.person) ?? here[0] ?? "");
    const stops = this.followed !== "" && (!name || name === this.followed);
    if (!stops && !here.includes(chosen)) page.notify(name ? `${name} is away.` : "Nobody else is here.", "wrong");
    this.followed = stops || !here.includes(chosen) ? "" : chosen;
    this.led = state.frame;
    if (this.followed) page.notify(`Following ${this.followed} until you go elsewhere.`);
    this.#lead([]);
    state.set({});
  }

  /** Says once whose frames one labels in, if they are another's; nothing is locked.
   *
   * @param {number | null} frame
   */
  told(frame) {
    const owner = frame === null ? "" : ownerOf(this.state, frame);
    if (owner && owner !== this.owner) this.page.notify(`Frame ${frame} is ${owner}'s. Labels count all the same.`);
    this.owner = owner;
  }

  /** @param {string} name */
  #framesOf(name) {
    return this.known.find((person) => person.name === name)?.frames ?? [];
  }

  /** Goes where who is followed went.
   *
   * @param {number[]} before frames where they were
   */
  #lead(before) {
    if (!this.followed) return;
    const frames = this.#framesOf(this.followed);
    const target = frames.find((frame) => !before.includes(frame));
    if (!frames.length) this.#end(`${this.followed} went away: nobody is followed any more.`);
    else if (target !== undefined && target !== this.led) {
      this.led = target;
      this.page.go(target);
    }
  }

  /** @param {string} why */
  #end(why) {
    this.followed = "";
    this.page.notify(why);
  }

  show() {
    const { others, state, followed } = this;
    document.body.classList.toggle("offline", !state.connected);
    if (followed && state.frame !== this.led) this.#end(`No longer following ${followed}.`);
    this.cache.show("people", [others, this.followed], () => [
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
    const isHere = frames.length > 0, isFollowed = name === this.followed;
    const where = isHere ? `frame ${frames.join(", ")}; click to go there, with Shift to follow` : "away";
    return el("button", {
      class: isHere ? "person" : "person away", title: `${name} (${role}): ${where}`, "aria-label": `${name}, ${where}`, "aria-pressed": String(isFollowed),
      onclick: (/** @type {MouseEvent} */ event) => {
        if (event.shiftKey) this.toggle(name);
        else if (frames.length) this.page.go(frames[0]);
      },
    }, initials(name));
  }
}

/** The first letters of a name.
 *
 * @param {string} name
 */
export function initials(name) {
  const words = name.split(/[\s.-]+/).filter(Boolean);
  return (words.length > 1 ? words[0][0] + words[1][0] : name.slice(0, 2)).toLowerCase();
}
