// Two people changed one label: whose version stays is asked here, below the images.
import { byId, el } from "/static/dom.js";

export class Conflict {
  constructor(state, actions) {
    this.state = state;
    this.actions = actions;
    this.shown = null;
  }

  show() {
    const { conflict } = this.state;
    if (conflict === this.shown) return;
    this.shown = conflict;
    const bar = byId("conflict");
    bar.hidden = conflict === null;
    if (!conflict) return;
    const answer = (text, isMine) => el("button", { class: "small", text, onclick: () => this.actions.resolve(isMine) });
    bar.replaceChildren(
      el("span", { class: "fill", text: `${conflict.text} Both stay in the history.` }),
      answer("Keep mine", true), answer("Keep theirs", false));
  }
}
