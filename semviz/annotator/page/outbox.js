// @ts-check
// Unsaved edits. Each stays in localStorage under its request's UUID until the server confirms that it
// is on disk, so closing the page or the server loses none. The store recognizes a request that it has
// applied, so a request that is sent twice is applied once.
/** @import {Edit, Entry, ShownAt} from "./values.js" */
import { uuid7 } from "./values.js";

const RETRY_MS = 3000;

/** Sends one edit at a time: later edits may build on it, so they wait. */
export class Outbox {
  /**
   * @param {string} workspace
   * @param {(entry: Entry) => boolean} send false while there is no connection
   */
  constructor(workspace, send) {
    this.prefix = `semviz.outbox.${workspace}.`;
    this.send = send;
    /** @type {string | null} */
    this.sent = null; // the unanswered request
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.timer = undefined;
  }

  /** All edits, oldest first. They are numbered, because clocks jump.
   *
   * @returns {Entry[]}
   */
  get entries() {
    return Object.keys(localStorage)
      .filter((key) => key.startsWith(this.prefix))
      .map((key) => /** @type {Entry} */ (JSON.parse(localStorage.getItem(key) ?? "")))
      .sort((first, second) => first.place - second.place || (first.request < second.request ? -1 : 1));
  }

  /** The edit of a request; null if it is on disk.
   *
   * @param {string | null} request
   */
  find(request) {
    return this.entries.find((entry) => entry.request === request) ?? null;
  }

  /**
   * @param {Edit} edit
   * @param {ShownAt | null} shown where on the page the edit was made; not sent
   */
  add(edit, shown = null) {
    const request = uuid7();
    const place = (this.entries.at(-1)?.place ?? 0) + 1;
    localStorage.setItem(this.prefix + request, JSON.stringify({ request, place, edit, shown }));
    this.flush();
  }

  /** Sends the oldest edit, unless an answer is awaited. */
  flush() {
    const [oldest] = this.sent ? [] : this.entries;
    if (oldest && this.send(oldest)) this.sent = oldest.request;
  }

  /** After the connection is lost: the next `flush` sends the unconfirmed edit again. */
  disconnected() {
    this.sent = null;
  }

  /** After a failed save: sends the edit again soon, or with the next edit. */
  retry() {
    this.sent = null;
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.flush(), RETRY_MS);
  }

  /** Replaces an edit that the server has not applied.
   *
   * @param {Entry} entry
   * @param {Edit} edit
   */
  replace(entry, edit) {
    localStorage.setItem(this.prefix + entry.request, JSON.stringify({ ...entry, edit }));
    this.sent = null;
    this.flush();
  }

  /** Removes an edit that is on disk or was refused for good.
   *
   * @param {string} request
   */
  settle(request) {
    localStorage.removeItem(this.prefix + request);
    if (this.sent === request) this.sent = null;
    this.flush();
  }
}
