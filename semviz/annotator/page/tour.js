// Three steps for people who are here for the first time. Stands beside the images, never on them.
import { byId, el } from "/static/dom.js";
import { Kept, badge } from "./widgets.js";

const PLACE = "semviz.tour";

export class Tour {
  constructor(state, keys) {
    this.state = state;
    this.keys = keys;
    this.kept = new Kept(state);
    this.step = localStorage.getItem(PLACE) ? null : 0;
    this.before = null; // the labels when the step began
  }

  /** From the first step, again. */
  open() {
    this.#go(0);
  }

  end() {
    localStorage.setItem(PLACE, "seen");
    this.step = null;
    this.state.set({});
  }

  show() {
    if (this.step !== null && this.#isDone()) this.step = Math.min(this.step + 1, STEPS.length - 1);
    const node = byId("tour");
    node.hidden = this.step === null;
    for (const one of document.querySelectorAll(".toured")) one.classList.remove("toured");
    if (this.step === null) return;
    STEPS[this.step].at.forEach((id) => byId(id).classList.add("toured"));
    this.kept.show("tour", this.step, () => this.#card(STEPS[this.step]));
  }

  #go(step) {
    this.step = step;
    this.before = null;
    this.state.set({});
  }

  /** Whether what the step asks for has been done; a step can also be left by its button. */
  #isDone() {
    const { labels, frame } = this.state;
    const now = { operation: labels.operation, frame };
    this.before ??= now;
    if (!STEPS[this.step].done(this.before, now)) return false;
    this.before = now;
    return true;
  }

  #card({ title, lines }) {
    const isLast = this.step === STEPS.length - 1;
    return [
      el("header", {}, el("h2", { text: title }), el("span", { class: "about", text: `step ${this.step + 1} of ${STEPS.length}` })),
      ...lines.map((line) => el("p", {}, ...line.map((part) => (typeof part === "string" ? part : badge(this.keys, part.key))))),
      el("footer", {},
        el("button", { class: "small", onclick: () => this.end() }, "End", badge(this.keys, "Esc")),
        this.step ? el("button", { class: "small push", onclick: () => this.#go(this.step - 1), text: "Back" }) : el("span", { class: "push" }),
        el("button", { class: "small primary", onclick: () => (isLast ? this.end() : this.#go(this.step + 1)), text: isLast ? "Done" : "Next" })),
    ];
  }
}

const key = (name) => ({ key: name });

/** `at`: panels that the step is about. `done(before, now)`: whether it has been followed. */
const STEPS = [
  {
    title: "Draw a pole",
    at: ["classes"],
    done: (before, now) => now.operation > before.operation,
    lines: [
      [key("1"), " takes the class pole. Click the pole's peak in the left image, then its bottom."],
      ["The second click saves. ", key("Esc"), " before it leaves nothing behind."],
    ],
  },
  {
    title: "Partner and next frames",
    at: ["elements"],
    done: (before, now) => now.frame !== before.frame,
    lines: [
      ["The pole is proposed in the right image, dashed: ", key("Space"), " accepts it, ", key("X"), " turns it down."],
      [key("."), " goes to the next frame, where it is proposed again. ", key("Shift Space"), " accepts all that are sure."],
    ],
  },
  {
    title: "Saved, and undo",
    at: ["saved", "undo"],
    done: () => false,
    lines: [
      ["The number at the top right is the last operation that is on disk. It counts only what is there."],
      [key("Ctrl Z"), " takes back any step, also tomorrow. ", key("?"), " lists all keys, ", key("Ctrl K"), " finds any command."],
    ],
  },
];
