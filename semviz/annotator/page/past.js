// An earlier state of the labels, shown in the images. Nothing can be changed in it.
import { byId, el } from "/static/dom.js";
import { spaced } from "./state.js";
import { Kept, badge } from "./widgets.js";

const DRAG_MS = 60; // a slider that moves asks no more often

export class Past {
  /** `send(message)` to the server; `submit(edit)` and `look()` as for the tools. */
  constructor(state, keys, { send, submit, look }) {
    this.state = state;
    this.keys = keys;
    this.send = send;
    this.submit = submit;
    this.ask = look;
    this.kept = new Kept(state);
    this.asked = null; // {operation, frame}
    this.timer = 0;
    state.onChange(() => {
      if (this.asked && this.asked.frame !== state.frame) this.look(this.asked.operation);
    });
  }

  /** Shows the state after `operation` in the frame on screen, as soon as it comes. */
  look(operation) {
    this.asked = { operation, frame: this.state.frame };
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.send({ type: "at", ...this.asked }), DRAG_MS);
    if (this.state.drawing) this.state.set({ drawing: null });
  }

  /** The server's answer; one that nobody waits for any more is dropped. */
  received({ type: _, ...past }) {
    const { operation, frame } = this.asked ?? {};
    if (past.operation === operation && past.frame.index === frame) this.state.set({ past, look: null });
  }

  /** Back to now. Returns whether something else was shown. */
  back() {
    const was = Boolean(this.asked);
    clearTimeout(this.timer);
    this.asked = null;
    this.state.set({ past: null });
    if (was) this.ask();
    return was;
  }

  /** Makes the state that is shown the present one, by a new operation. */
  restore() {
    const { operation } = this.state.past;
    this.back();
    this.submit({ kind: "restore", number: operation });
  }

  show() {
    const { past, hello } = this.state;
    byId("past").hidden = !past;
    document.body.classList.toggle("past", Boolean(past));
    this.kept.show("past", past && past.operation, () => this.#bar(past, hello.author));
  }

  #bar(past, me) {
    if (!past) return [];
    const { time, author, text } = past.done ?? {};
    const about = time ? [ago(time), author === me ? "you" : author, text].join(", ") : "the beginning";
    return [
      el("b", { text: `State after operation ${spaced(past.operation)}` }),
      el("span", { class: "fill", text: `${about}. Nothing is changed.` }),
      el("button", { class: "small", onclick: () => this.restore(), text: "Restore as new operation" }),
      el("button", { class: "small", onclick: () => this.back() }, "Back to now", badge(this.keys, "Esc")),
    ];
  }
}

/** How long ago, as people say it. `time`: ISO 8601. */
export function ago(time) {
  const minutes = Math.floor((Date.now() - Date.parse(time)) / 60_000);
  if (minutes < 1) return "just now"; // also where another computer's clock is ahead
  if (minutes < 60) return `${minutes} min ago`;
  if (minutes < 24 * 60) return `${Math.floor(minutes / 60)} h ago`;
  const days = Math.floor(minutes / (24 * 60));
  return days === 1 ? "1 day ago" : `${days} days ago`;
}
