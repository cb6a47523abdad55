// @ts-check
// Shows an earlier state of the labels in the images, read-only.
/** @import {annotator} from "/static/protocol" */
/** @import {Keys} from "/static/keys.js" */
/** @import {Page} from "../main.js" */
/** @import {State} from "../state.js" */
import { byId, el } from "/static/dom.js";
import { spaced } from "../values.js";
import { RenderCache, badge } from "../panels/widgets.js";

const DRAG_MS = 60; // shortest interval of requests while the slider moves

export class Past {
  /**
   * @param {State} state
   * @param {Keys} keys
   * @param {Pick<Page, "socket" | "submit" | "preview">} page
   */
  constructor(state, keys, page) {
    this.state = state;
    this.keys = keys;
    this.page = page;
    this.cache = new RenderCache(state);
    /** @type {{operation: number, frame: number} | null} */
    this.requested = null;
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.timer = undefined;
    state.onChange(() => {
      if (this.requested && this.requested.frame !== state.frame) this.view(this.requested.operation);
    });
  }

  /** Requests the state after `operation` in the frame on screen.
   *
   * @param {number} operation
   */
  view(operation) {
    const request = { operation, frame: this.state.frame ?? 0, second: this.state.second };
    this.requested = request;
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.page.socket.send("show_past_frame", request), DRAG_MS);
    if (this.state.drawing) this.state.set({ drawing: null });
  }

  /** Shows the server's answer, unless another state was requested since.
   *
   * @param {annotator.PastFrame} past
   */
  received(past) {
    const { operation, frame } = this.requested ?? {};
    if (past.operation === operation && past.frame.index === frame) this.state.set({ past, preview: null });
  }

  /** Returns to the present. Returns whether an earlier state was shown. */
  back() {
    const was = Boolean(this.requested);
    clearTimeout(this.timer);
    this.requested = null;
    this.state.set({ past: null });
    if (was) this.page.preview();
    return was;
  }

  /** Restores the shown state by a new operation. */
  restore() {
    const { past } = this.state;
    if (!past) return;
    this.back();
    this.page.submit({ kind: "restore", number: past.operation });
  }

  show() {
    const { past, workspace } = this.state;
    byId("past").hidden = !past;
    document.body.classList.toggle("past", Boolean(past));
    this.cache.show("past", past && past.operation, () => (past ? this.#bar(past, workspace.author) : []));
  }

  /**
   * @param {annotator.PastFrame} past
   * @param {string} me
   */
  #bar({ operation, done }, me) {
    const about = done ? [ago(done.time), done.author === me ? "you" : done.author, done.text].join(", ") : "the beginning";
    return [
      el("b", { text: `State after operation ${spaced(operation)}` }),
      el("span", { class: "fill", text: `${about}. Nothing is changed.` }),
      el("button", { class: "small", onclick: () => this.restore(), text: "Restore as new operation" }),
      el("button", { class: "small", onclick: () => this.back() }, "Back to now", badge(this.keys, "Esc")),
    ];
  }
}

/** How long ago a time was, for people.
 *
 * @param {string} time ISO 8601
 */
export function ago(time) {
  const minutes = Math.floor((Date.now() - Date.parse(time)) / 60_000);
  if (minutes < 1) return "just now"; // also if another computer's clock is ahead
  if (minutes < 60) return `${minutes} min ago`;
  if (minutes < 24 * 60) return `${Math.floor(minutes / 60)} h ago`;
  const days = Math.floor(minutes / (24 * 60));
  return days === 1 ? "1 day ago" : `${days} days ago`;
}
