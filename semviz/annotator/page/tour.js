// @ts-check
// A tour in three steps for first-time users, beside the images.
/** @import {Keys} from "/static/keys.js" */
/** @import {State} from "./state.js" */
import { byId, el } from "/static/dom.js";
import { RenderCache, badge } from "./panels/widgets.js";

const STORAGE_KEY = "semviz.tour";

/** State of labels and page.
 * @typedef {{operation: number, frame: number | null}} Progress */
/** `at`: highlighted panels. `done`: whether the user has followed the step.
 * @typedef {{
 *   title: string, at: string[], done: (before: Progress, now: Progress) => boolean, lines: (string | {key: string})[][],
 * }} Step */

export class Tour {
  /**
   * @param {State} state
   * @param {Keys} keys
   */
  constructor(state, keys) {
    this.state = state;
    this.keys = keys;
    this.cache = new RenderCache(state);
    this.step = localStorage.getItem(STORAGE_KEY) ? null : 0;
    /** @type {Progress | null} */
    this.before = null; // the labels when the step began
  }

  /** Starts at the first step. */
  open() {
    this.#go(0);
  }

  end() {
    localStorage.setItem(STORAGE_KEY, "seen");
    this.step = null;
    this.state.set({});
  }

  show() {
    if (this.step !== null && this.#isDone(this.step)) this.step = Math.min(this.step + 1, STEPS.length - 1);
    byId("tour").hidden = this.step === null;
    for (const node of document.querySelectorAll(".toured")) node.classList.remove("toured");
    if (this.step === null) return;
    const { step } = this;
    STEPS[step].at.forEach((id) => byId(id).classList.add("toured"));
    this.cache.show("tour", step, () => this.#card(STEPS[step], step));
  }

  /** @param {number} step */
  #go(step) {
    this.step = step;
    this.before = null;
    this.state.set({});
  }

  /** Whether the user has followed a step; its button also ends it.
   *
   * @param {number} step
   */
  #isDone(step) {
    const { labels, frame } = this.state;
    const now = { operation: labels.operation, frame };
    this.before ??= now;
    if (!STEPS[step].done(this.before, now)) return false;
    this.before = now;
    return true;
  }

  /**
   * @param {Step} step
   * @param {number} place
   */
  #card({ title, lines }, place) {
    const isLast = place === STEPS.length - 1;
    return [
      el("header", {}, el("h2", { text: title }), el("span", { class: "about", text: `step ${place + 1} of ${STEPS.length}` })),
      ...lines.map((line) => el("p", {}, ...line.map((part) => (typeof part === "string" ? part : badge(this.keys, part.key))))),
      el("footer", {},
        el("button", { class: "small", onclick: () => this.end() }, "End", badge(this.keys, "Esc")),
        place ? el("button", { class: "small push", onclick: () => this.#go(place - 1), text: "Back" }) : el("span", { class: "push" }),
        el("button", { class: "small primary", onclick: () => (isLast ? this.end() : this.#go(place + 1)), text: isLast ? "Done" : "Next" })),
    ];
  }
}

/** @param {string} name */
const key = (name) => ({ key: name });

/** @type {Step[]} */
const STEPS = [
  {
    title: "Draw a pole",
    at: ["classes"],
    done: (before, now) => now.operation > before.operation,
    lines: [
      [key("1"), " selects the class pole. Point at a pole: where it is dashed, a click takes it. Else click its peak, then its bottom."],
      [key("Esc"), " cancels a drawing; ", key("Ctrl Z"), " undoes what is saved."],
    ],
  },
  {
    title: "Second image, next frames",
    at: ["elements"],
    done: (before, now) => now.frame !== before.frame,
    lines: [
      ["The pole is proposed in the right image, dashed: ", key("Space"), " accepts it, ", key("X"), " rejects it."],
      [key("."), " goes to the next frame, where it is proposed again. ", key("Shift Space"), " accepts all confident proposals."],
    ],
  },
  {
    title: "Saved, and undo",
    at: ["saved", "undo"],
    done: () => false,
    lines: [
      ["The number at the top right is the last operation on disk."],
      [key("Ctrl Z"), " undoes any edit, even after a restart. ", key("?"), " lists all keys, ", key("Ctrl K"), " finds any command."],
    ],
  },
];
