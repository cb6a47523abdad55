// What was done, newest first.
import { el } from "/static/dom.js";
import { spaced } from "./state.js";
import { Kept, row } from "./widgets.js";

export class History {
  constructor(state, actions) {
    this.state = state;
    this.actions = actions;
    this.kept = new Kept(state);
  }

  show() {
    const { history } = this.state.labels;
    this.kept.show("history", history, () => history.map((one, place) => this.#row(one, place === 0)));
  }

  #row({ number, text, author, frame }, chosen) {
    return row({ chosen, title: `${author}, frame ${frame ?? "none"}`, onclick: () => this.actions.go(frame) },
      el("span", { class: "faint", text: spaced(number) }), el("span", { class: "fill", text }));
  }
}
