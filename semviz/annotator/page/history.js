// What was done, newest first; from here people go back to any state, and give states names.
import { byId, el } from "/static/dom.js";
import { ago } from "./past.js";
import { spaced } from "./state.js";
import { Kept, badge, row } from "./widgets.js";

const NEAR_END = 80; // CSS pixels above the end of the list, where older ones are asked for

export class History {
  /** `past`: where earlier states are looked at. */
  constructor(state, keys, past, { go, send, submit }) {
    this.state = state;
    this.keys = keys;
    this.past = past;
    this.go = go;
    this.send = send;
    this.submit = submit;
    this.kept = new Kept(state);
    this.rows = []; // newest first, without a gap
    this.named = null;
    this.waiting = false;
    this.list = byId("history");
    this.list.addEventListener("scroll", () => this.#more());
    byId("past-slider").addEventListener("input", (event) => this.#slide(Number(event.target.value)));
    byId("naming").addEventListener("submit", (event) => this.#name(event));
    byId("naming").addEventListener("keydown", (event) => { if (event.key === "Escape") this.#stopNaming(); });
  }

  show() {
    if (!this.state.connected) this.waiting = false;
    if (this.#take(this.state.labels.history)) this.#ask(null);
    this.kept.show("history-keys", null, () => ["Ctrl B", "H"].map((name) => badge(this.keys, name)));
    this.kept.show("named", this.named, () => (this.named ?? []).map((one) => this.#named(one)));
    const { past, labels } = this.state;
    const slider = byId("past-slider");
    slider.max = labels.operation;
    if (document.activeElement !== slider || !this.past.asked) slider.value = past?.operation ?? labels.operation;
    this.#mark(past?.operation ?? labels.operation);
  }

  /** Older operations, or the names of states. */
  received({ operations, named }) {
    this.waiting = false;
    if (named) this.named = named;
    const oldest = this.rows.at(-1)?.number ?? Infinity;
    const older = operations.filter((one) => one.number < oldest);
    this.rows.push(...older);
    this.list.append(...older.map((one) => this.#row(one)));
    this.show();
  }

  /** Opens the field for the name of the state there is. */
  startNaming() {
    document.body.classList.toggle("history", isSmall());
    byId("naming").hidden = false;
    byId("state-name").focus();
  }

  /** Takes over the newest operations. Returns whether names may have changed. */
  #take(newest) {
    const known = this.rows[0]?.number ?? 0;
    const isOther = known > 0 && (newest.at(-1)?.number ?? Infinity) > known + 1; // or a backup was restored
    if (isOther || (newest[0]?.number ?? 0) < known) {
      this.rows = [];
      this.list.replaceChildren();
    }
    const added = newest.filter((one) => one.number > (this.rows[0]?.number ?? 0));
    this.rows.unshift(...added);
    this.list.prepend(...added.map((one) => this.#row(one)));
    const isFirst = this.named === null;
    this.named ??= [];
    return isFirst || added.some((one) => one.kind === "name");
  }

  #more() {
    const { scrollTop, scrollHeight, clientHeight } = this.list;
    const oldest = this.rows.at(-1)?.number ?? 1;
    if (oldest > 1 && !this.waiting && scrollTop + clientHeight > scrollHeight - NEAR_END) this.#ask(oldest);
  }

  #ask(before) {
    this.waiting = this.send({ type: "history", before });
  }

  #row({ number, text, author, frame, time }) {
    const isMine = author === this.state.hello.author;
    const about = `${isMine ? "You" : author}, ${ago(time)}, ${frame === null ? "no frame" : `frame ${frame}`}`;
    return el("div", { class: "operation", data: { number } },
      row({ title: about, onclick: () => this.go(frame) },
        el("span", { class: "faint", text: spaced(number) }), el("span", { class: "fill", text }),
        isMine ? null : el("span", { class: "faint", text: author })),
      el("button", { class: "look", title: `See the state after operation ${number}`, onclick: () => this.past.look(number), text: "look" }));
  }

  #named({ number, text, time, author }) {
    return row({ title: `Named by ${author}, ${ago(time)}. See this state`, onclick: () => this.past.look(number) },
      el("span", { class: "fill", text }), el("span", { class: "faint", text: spaced(number) }));
  }

  #mark(operation) {
    if (this.marked?.isConnected && Number(this.marked.dataset.number) === operation) return;
    this.marked?.firstChild.classList.remove("chosen");
    this.marked = this.list.querySelector(`[data-number="${operation}"]`);
    this.marked?.firstChild.classList.add("chosen");
  }

  #slide(operation) {
    if (operation === this.state.labels.operation) this.past.back();
    else this.past.look(operation);
  }

  #name(event) {
    event.preventDefault();
    const name = byId("state-name").value.trim();
    if (name) this.submit({ kind: "name", name });
    this.#stopNaming();
  }

  #stopNaming() {
    byId("state-name").value = "";
    byId("naming").hidden = true;
    document.querySelector("canvas.marks").focus({ preventScroll: true });
  }
}

/** Shows or hides the history; in a small window it takes the place of the aids. */
export function toggleHistory() {
  document.body.classList.toggle("history");
}

/** Whether the history is hidden unless asked for, as the style sheet has it. */
const isSmall = () => window.matchMedia("(max-width: 1400px), (max-height: 800px)").matches;
