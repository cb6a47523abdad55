// What waits for a person in the last map: decisions to judge, and findings to look at.
import { byId, el } from "/static/dom.js";
import { classGlyph } from "/static/glyphs.js";
import { Kept, badge, capital, header } from "./widgets.js";

/** The lists, by what the server calls them. */
export const REVIEWS = {
  decisions: { title: "Map decisions", one: "decision", none: "No decision is open." },
  findings: { title: "Lint findings", one: "finding", none: "Nothing looks odd in the last map." },
};
const QUESTIONS = { merge: "One thing?", split: "Two things?", apart: "Two things?", "leave out": "Leave out?" };
const KEYS = ["Y", "Shift Y"]; // of the first answers

/** Commands for `Keys`. */
export function reviewCommands(review) {
  const group = "Map";
  return [
    { key: "y", group, title: "Answer as the map has it", run: () => review.answer(0) },
    { key: "y", shift: true, group, title: "Answer the other way", run: () => review.answer(1) },
    { key: "m", shift: true, group, title: "Build the map; again: stop that", run: () => review.build() },
  ];
}

export class Review {
  /** `send(message)` to the server; `submit`, `go` and `select` as for the tools; `tell` as of the
   * panels; `fit` shows whole images. */
  constructor(state, keys, { send, submit, go, select, tell, fit }) {
    Object.assign(this, { state, keys, send, submit, go, select, tell, fit });
    this.kept = new Kept(state);
    this.asked = null; // the labels and map of the last question
    this.answered = null; // key of the last one that was answered here
    this.failure = "";
    byId("build").addEventListener("click", () => this.build());
  }

  /** Opens a list, or goes on in the one that is open. */
  step(list, by) {
    if (this.state.labels.map.built === null) {
      this.tell("No map yet: press Build map, or run semviz map build.");
      return;
    }
    const { review } = this.state;
    const isOpen = review?.list === list;
    this.#ask(list, isOpen ? review.key : null, isOpen ? review.place : 0, isOpen ? by : 0);
  }

  answer(place) {
    const { review, pending } = this.state;
    const answer = review?.answers[place];
    if (!answer || (this.answered === review.key && pending.length)) return; // pressed twice
    this.answered = review.key;
    this.submit(answer.edit); // once it is saved, the next one is asked for
  }

  /** Builds the map or, where that is going on, stops it. */
  build() {
    this.send({ type: "build", stop: this.state.labels.map.building !== null });
  }

  /** Returns whether a card was open. */
  close() {
    const wasOpen = Boolean(this.state.review);
    if (wasOpen) {
      this.state.set({ review: null });
      this.send({ type: "review" });
    }
    return wasOpen;
  }

  /** The server's answer: a new card leads to its frame, the same one anew stays where the page is. */
  received({ card }) {
    if (!card) return;
    const before = this.state.review;
    if (!card.count) {
      this.state.set({ review: null });
      this.tell(`${REVIEWS[card.list].none}${this.#isDue() ? " Build map follows what you have answered." : ""}`);
      return;
    }
    this.state.set({ review: card });
    if (before?.list === card.list && before.key === card.key) return;
    this.fit();
    if (card.frame !== null) this.go(card.frame);
    this.select(card.list === "findings" ? card.elements[0]?.id ?? null : null);
  }

  show() {
    const { labels, review, theme } = this.state;
    const { map, operation } = labels;
    const now = JSON.stringify([operation, map]);
    if (review && this.asked !== now) this.#ask(review.list, review.key, review.place, 0);
    if (map.failure && map.failure !== this.failure) this.tell(map.failure, "wrong");
    this.failure = map.failure;
    this.#showBuild(map);
    document.body.classList.toggle("reviewing", Boolean(review));
    byId("review").hidden = !review;
    if (review) this.kept.show("review", [review, this.state.frame, theme], () => this.#card(review));
  }

  #ask(list, key, place, by) {
    const { map, operation } = this.state.labels;
    this.asked = JSON.stringify([operation, map]);
    this.send({ type: "review", list, key, place, by });
  }

  /** Whether the map is older than the labels. */
  #isDue() {
    const { map, operation } = this.state.labels;
    return operation > 0 && map.built !== operation;
  }

  /** In the accent where the labels have changed since. */
  #showBuild(map) {
    const node = byId("build");
    node.textContent = map.building === null ? "Build map" : `Stop, ${map.building.match(/\d+ %/)?.[0] ?? "0 %"}`;
    node.classList.toggle("due", map.building === null && this.#isDue());
    const known = map.built === null ? "There is no map yet" : `The map knows the labels up to operation ${map.built}`;
    node.title = map.building === null ? known : `Building the map: ${map.building}`;
  }

  #card(review) {
    const { kind, list, place, count, severity, reason, evidence, answers } = review;
    const title = list === "decisions" ? QUESTIONS[kind] : capital(kind);
    const chip = severity ? el("span", { class: `push chip ${severity}`, text: severity }) : null;
    return [
      header(title, `${REVIEWS[list].one} ${place + 1} of ${count}`, null, chip),
      el("div", { class: "seen-list" }, ...review.elements.map((one) => this.#element(one, answers))),
      review.about.length ? el("p", { class: "seen" }, "in question", ...this.#frames(review.about)) : null,
      el("p", { class: "reason", text: reason }),
      el("dl", { class: "evidence" }, ...evidence.flatMap(({ name, value }) => [el("dt", { text: name }), el("dd", { text: value })])),
      answers.length ? el("div", { class: "buttons" }, ...answers.slice(0, KEYS.length).map((one, index) => this.#answer(one, index))) : null,
    ].filter(Boolean);
  }

  /** Where of three and more elements one alone can be another thing, its line says so. */
  #element({ id, number, name, class: classId, frames }, answers) {
    const other = answers.findIndex((answer) => answer.name === `not ${number}`);
    const one = classId === null ? null : this.state.classOf(classId);
    const glyph = one && classGlyph(one, this.state.colorOf(one));
    const label = el("b", { text: name });
    if (one) label.style.color = this.state.colorOf(one);
    return el("p", { class: "seen" }, glyph, id ? el("button", { class: "small", onclick: () => this.select(id) }, label) : label, ...this.#frames(frames),
      other < 0 ? null : el("button", { class: "push small", title: answers[other].title, onclick: () => this.answer(other), text: "another" }));
  }

  /** Where to look: buttons that lead to frames. */
  #frames(frames) {
    return frames.map((frame) => el("button", {
      class: frame === this.state.frame ? "small frame chosen" : "small frame", title: `To frame ${frame}`,
      onclick: () => this.go(frame), text: frame,
    }));
  }

  #answer({ title }, index) {
    return el("button", { class: "small", onclick: () => this.answer(index) }, title, KEYS[index] ? badge(this.keys, KEYS[index]) : null);
  }
}
