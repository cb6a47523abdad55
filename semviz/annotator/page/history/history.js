// @ts-check
// The list of operations, newest first: view, restore and name earlier states.
/** @import {annotator} from "/static/protocol" */
/** @import {Keys} from "/static/keys.js" */
/** @import {Page} from "../main.js" */
/** @import {Past} from "./past.js" */
/** @import {State} from "../state.js" */
import { byId, el } from "/static/dom.js";
import { focusImages } from "../panels/focus.js";
import { ago } from "./past.js";
import { spaced } from "../values.js";
import { RenderCache, badge, row } from "../panels/widgets.js";

const NEAR_END = 80; // CSS pixels above the end of the list at which older operations are requested

export class History {
  /**
   * @param {State} state
   * @param {Keys} keys
   * @param {Past} past shows earlier states
   * @param {Pick<Page, "go" | "socket" | "submit">} page
   */
  constructor(state, keys, past, page) {
    this.state = state;
    this.keys = keys;
    this.past = past;
    this.page = page;
    this.cache = new RenderCache(state);
    /** @type {annotator.OperationView[]} */
    this.rows = []; // newest first, without gaps
    /** @type {annotator.OperationView[] | null} */
    this.named = null;
    /** @type {HTMLElement | null} */
    this.marked = null; // the row of the shown state
    this.waiting = false;
    this.list = byId("history");
    this.list.addEventListener("scroll", () => this.#more());
    this.slider = byId("past-slider", HTMLInputElement);
    this.slider.addEventListener("input", () => this.#slide(Number(this.slider.value)));
    byId("naming").addEventListener("submit", (event) => this.#name(event));
    byId("naming").addEventListener("keydown", (event) => { if (event.key === "Escape") this.#stopNaming(); });
  }

  show() {
    if (!this.state.connected) this.waiting = false;
    if (this.#take(this.state.labels.history)) this.waiting = this.page.socket.send("list_named_states", {});
    this.cache.show("history-keys", null, () => ["Ctrl B", "H"].map((name) => badge(this.keys, name)));
    this.cache.show("named", this.named, () => (this.named ?? []).map((operation) => this.#named(operation)));
    const { past, labels } = this.state;
    this.slider.max = String(labels.operation);
    const isDragged = document.activeElement === this.slider && this.past.requested;
    if (!isDragged) this.slider.value = String(past?.operation ?? labels.operation);
    this.#mark(past?.operation ?? labels.operation);
  }

  /** Shows the named states.
   *
   * @param {annotator.OperationView[]} states
   */
  receivedNames(states) {
    this.waiting = false;
    this.named = states;
    this.show();
  }

  /** Appends older operations.
   *
   * @param {annotator.OperationView[]} operations
   */
  received(operations) {
    this.waiting = false;
    const oldest = this.rows.at(-1)?.number ?? Infinity;
    const older = operations.filter(({ number }) => number < oldest);
    this.rows.push(...older);
    this.list.append(...older.map((operation) => this.#row(operation)));
    this.show();
  }

  /** Opens the field for the name of the present state. */
  startNaming() {
    document.body.classList.toggle("history", isSmall());
    byId("naming").hidden = false;
    byId("state-name").focus();
  }

  /** Adds the newest operations. Returns whether named states may have changed.
   *
   * @param {annotator.OperationView[]} newest
   */
  #take(newest) {
    const known = this.rows[0]?.number ?? 0;
    const hasGap = known > 0 && (newest.at(-1)?.number ?? Infinity) > known + 1;
    if (hasGap || (newest[0]?.number ?? 0) < known) { // the latter: a backup was restored
      this.rows = [];
      this.list.replaceChildren();
    }
    const added = newest.filter(({ number }) => number > (this.rows[0]?.number ?? 0));
    this.rows.unshift(...added);
    this.list.prepend(...added.map((operation) => this.#row(operation)));
    const isFirst = this.named === null;
    this.named ??= [];
    return isFirst || added.some(({ kind }) => kind === "name");
  }

  #more() {
    const { scrollTop, scrollHeight, clientHeight } = this.list;
    const oldest = this.rows.at(-1)?.number ?? 1;
    if (oldest > 1 && !this.waiting && scrollTop + clientHeight > scrollHeight - NEAR_END) {
      this.waiting = this.page.socket.send("list_operations", { before: oldest });
    }
  }

  /** @param {annotator.OperationView} operation */
  #row({ number, text, author, frame, time }) {
    const isMine = author === this.state.workspace.author;
    const about = `${isMine ? "You" : author}, ${ago(time)}, ${frame === null ? "no frame" : `frame ${frame}`}`;
    return el("div", { class: "operation", data: { number } },
      row({ title: about, onclick: () => this.page.go(frame) },
        el("span", { class: "faint", text: spaced(number) }), el("span", { class: "fill", text }),
        isMine ? null : el("span", { class: "faint", text: author })),
      el("button", { class: "view", title: `View the state after operation ${number}`, onclick: () => this.past.view(number), text: "view" }));
  }

  /** @param {annotator.OperationView} operation */
  #named({ number, text, time, author }) {
    return row({ title: `Named by ${author}, ${ago(time)}. View this state`, onclick: () => this.past.view(number) },
      el("span", { class: "fill", text }), el("span", { class: "faint", text: spaced(number) }));
  }

  /** @param {number} operation */
  #mark(operation) {
    if (this.marked?.isConnected && Number(this.marked.dataset.number) === operation) return;
    this.marked?.firstElementChild?.classList.remove("chosen");
    this.marked = /** @type {HTMLElement | null} */ (this.list.querySelector(`[data-number="${operation}"]`));
    this.marked?.firstElementChild?.classList.add("chosen");
  }

  /** @param {number} operation */
  #slide(operation) {
    if (operation === this.state.labels.operation) this.past.back();
    else this.past.view(operation);
  }

  /** @param {Event} event */
  #name(event) {
    event.preventDefault();
    const name = byId("state-name", HTMLInputElement).value.trim();
    if (name) this.page.submit({ kind: "name", name });
    this.#stopNaming();
  }

  #stopNaming() {
    byId("state-name", HTMLInputElement).value = "";
    byId("naming").hidden = true;
    focusImages();
  }
}

/** Shows or hides the history; in a small window it replaces the aids. */
export function toggleHistory() {
  document.body.classList.toggle("history");
}

/** Whether the style sheet hides the history by default. */
const isSmall = () => window.matchMedia("(max-width: 1400px), (max-height: 800px)").matches;
