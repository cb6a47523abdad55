// Edits on their way to the server. Each lies in localStorage under its request's UUID until the
// server has said that it is on disk, so closing the page or the server loses none; the store
// knows a request that it has already done, so sending one twice does it once.
import { uuid7 } from "./state.js";

const RETRY_MS = 3000;

/** Sends one edit at a time: what builds on an edit that could not be saved waits behind it. */
export class Outbox {
  /** `send(message)` returns false while there is no connection. */
  constructor(workspace, send) {
    this.prefix = `semviz.outbox.${workspace}.`;
    this.send = send;
    this.sent = null; // the request that the server has not answered yet
    this.timer = 0;
  }

  /** [{request, place, edit, shown}], oldest first. Their order is counted, not timed: clocks jump. */
  get entries() {
    return Object.keys(localStorage)
      .filter((key) => key.startsWith(this.prefix))
      .map((key) => JSON.parse(localStorage.getItem(key)))
      .sort((one, two) => one.place - two.place || (one.request < two.request ? -1 : 1));
  }

  /** `shown` stays here: where on the page the edit was made. */
  add(edit, shown = null) {
    const request = uuid7();
    const place = (this.entries.at(-1)?.place ?? 0) + 1;
    localStorage.setItem(this.prefix + request, JSON.stringify({ request, place, edit, shown }));
    this.flush();
  }

  /** Sends the oldest edit, unless an answer is still to come. */
  flush() {
    const [oldest] = this.sent ? [] : this.entries;
    if (!oldest) return;
    const { request, edit } = oldest;
    if (this.send({ type: "edit", request, edit })) this.sent = request;
  }

  /** The connection is gone: whatever was not acknowledged goes out again with the next one. */
  disconnected() {
    this.sent = null;
  }

  /** The server could not save it now; it goes out again soon, or with the next edit. */
  retry() {
    this.sent = null;
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.flush(), RETRY_MS);
  }

  /** Another edit in the place of one that the server has not done. */
  replace(entry, edit) {
    localStorage.setItem(this.prefix + entry.request, JSON.stringify({ ...entry, edit }));
    this.sent = null;
    this.flush();
  }

  /** The server has it on disk, or refused it for good. */
  settle(request) {
    localStorage.removeItem(this.prefix + request);
    if (this.sent === request) this.sent = null;
    this.flush();
  }
}
