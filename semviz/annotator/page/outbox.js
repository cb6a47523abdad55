// Edits on their way to the server. Each lies in localStorage under its request's UUID until the
// server has said that it is on disk, so closing the page or the server loses none; the store
// knows a request that it has already done, so sending one twice does it once.
import { uuid7 } from "./state.js";

export class Outbox {
  /** `send(message)` returns false while there is no connection. */
  constructor(workspace, send) {
    this.prefix = `semviz.outbox.${workspace}.`;
    this.send = send;
    this.sent = new Set();
  }

  /** [{request, edit}], oldest first: version 7 UUIDs sort by the time of their making. */
  get entries() {
    return Object.keys(localStorage)
      .filter((key) => key.startsWith(this.prefix))
      .sort()
      .map((key) => JSON.parse(localStorage.getItem(key)));
  }

  add(edit) {
    const request = uuid7();
    localStorage.setItem(this.prefix + request, JSON.stringify({ request, edit }));
    this.flush();
    return request;
  }

  /** Sends what has not been sent over this connection. */
  flush() {
    for (const { request, edit } of this.entries) {
      if (this.sent.has(request)) continue;
      if (!this.send({ type: "edit", request, edit })) return;
      this.sent.add(request);
    }
  }

  /** The connection is gone: whatever was not acknowledged goes out again with the next one. */
  disconnected() {
    this.sent.clear();
  }

  /** The server has it on disk, or refused it for good. */
  settle(request) {
    localStorage.removeItem(this.prefix + request);
    this.sent.delete(request);
  }
}
