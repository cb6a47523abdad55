// @ts-check
// Unsaved edits. Each stays in localStorage under its request's UUID until the server confirms that it
// is on disk, so closing the page or the server loses none. The store recognizes a request that it has
// applied, so a request that is sent twice is applied once.
/** @import {Edit, Entry, ShownAt} from "../values.js" */
import { uuid7 } from "../values.js";

const RETRY_MS = 3000;

/** Sends one edit at a time: later edits may build on it, so they wait. */
export class Outbox {
  /**
   * @param {string} workspace
   * @param {(entry: Entry) => boolean} send false while there is no connection
   */
  constructor(workspace, send) {
    this.prefix = `semviz.outbox.${workspace}.`;
    this.savedKey = `semviz.saved.${workspace}`;
    this.send = send;
    /** @type {string | null} */
    this.sent = null; // the unanswered request
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.timer = undefined;
    this.agreed = 0; // place of the last edit that may move to restored labels
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

  /** Returns whether the edit is stored: false if the browser has no room left for it.
   *
   * @param {Edit} edit
   * @param {ShownAt | null} shown where on the page the edit was made; not sent
   * @param {{operation: number, hash: string}} since the last operation that the page had shown when the edit was begun
   */
  add(edit, shown, since) {
    const request = uuid7();
    const place = (this.entries.at(-1)?.place ?? 0) + 1;
    const base = { ...since, known: [] };
    try {
      localStorage.setItem(this.prefix + request, JSON.stringify({ request, place, edit, shown, base }));
    } catch (error) {
      if (!(error instanceof DOMException)) throw error;
      return false;
    }
    this.flush();
    return true;
  }

  /** Sends the oldest edit, unless an answer is awaited. */
  flush() {
    const [oldest] = this.sent ? [] : this.entries;
    if (oldest && this.send(this.#withBase(oldest))) this.sent = oldest.request;
  }

  /** The edit, with what it may overwrite: also the edits of this browser that were saved since.
   *
   * @param {Entry} entry
   * @returns {Entry}
   */
  #withBase(entry) {
    if (!entry.base) return entry; // of an older page
    const { operation, known = [] } = entry.base;
    const own = this.saved.filter((saved) => saved.operation > operation).map(({ request }) => request);
    return { ...entry, base: { ...entry.base, known: [...known, ...own] } };
  }

  /** The last edits of this browser that are on disk, and all since the oldest that waits.
   *
   * @returns {{request: string, operation: number}[]}
   */
  get saved() {
    return JSON.parse(localStorage.getItem(this.savedKey) ?? "[]");
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

  /** Replaces an edit that the server refused.
   *
   * @param {Entry} entry
   * @param {Edit} edit
   */
  replace(entry, edit) {
    localStorage.setItem(this.prefix + entry.request, JSON.stringify({ ...entry, edit }));
    this.sent = null;
    this.flush();
  }

  /** Lets a refused edit, and later ones that write the same, overwrite what others did.
   *
   * @param {Entry} refused
   * @param {string[]} overwritten requests of the others
   */
  overwrite({ request, edit }, overwritten) {
    for (const entry of this.entries) {
      if (entry.request !== request && !writesTheSame(entry.edit, edit)) continue;
      const before = entry.base ?? { operation: 0 };
      const base = { ...before, known: [...(before.known ?? []), ...overwritten] };
      localStorage.setItem(this.prefix + entry.request, JSON.stringify({ ...entry, base }));
    }
    this.sent = null;
    this.flush();
  }

  /** Keeps what others did: a refused edit is made and undone at once, so that both are in the history.
   *
   * @param {Entry} refused
   * @param {string[]} overwritten requests of the others
   */
  keepTheirs({ request, edit, place, shown, base }, overwritten) {
    const knows = { ...base ?? { operation: 0 }, known: [...(base?.known ?? []), ...overwritten] };
    const undo = { request: uuid7(), place: place + 0.5, edit: { kind: "undo", request }, shown: null, base: knows };
    for (const entry of [{ request, place, edit, shown, base: knows }, undo]) {
      localStorage.setItem(this.prefix + entry.request, JSON.stringify(entry));
    }
    this.sent = null;
    this.flush();
  }

  /** Notes that all edits that wait now may move to the labels that a backup put in place. */
  agreeToRestored() {
    this.agreed = this.entries.at(-1)?.place ?? 0;
  }

  /** Sends an edit of replaced labels to the restored ones. A step through the replaced history is dropped.
   *
   * @param {Entry} refused
   * @param {{operation: number, hash?: string}} since the last restored operation that it may overwrite
   */
  moveToRestored(refused, since) {
    if (["undo", "redo", "restore"].includes(refused.edit.kind)) {
      this.settle(refused.request);
      return;
    }
    localStorage.setItem(this.prefix + refused.request, JSON.stringify({ ...refused, base: { ...since, known: [] } }));
    this.sent = null;
    this.flush();
  }

  /** Notes that an edit of this page is on disk as `operation`.
   *
   * @param {string} request
   * @param {number} operation
   */
  saw(request, operation) {
    const before = this.entries.length > 1 ? this.saved : this.saved.slice(-99);
    localStorage.setItem(this.savedKey, JSON.stringify([...before, { request, operation }]));
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

/** Whether two edits write the same fields of one observation.
 *
 * @param {Edit} first
 * @param {Edit} second
 */
function writesTheSame(first, second) {
  if (!("observation_id" in first) || !("observation_id" in second)) return false;
  if (first.kind !== second.kind || first.observation_id !== second.observation_id) return false;
  /** @param {object} edit */
  const written = (edit) => Object.entries(edit).filter(([, value]) => value !== null).map(([name]) => name).sort().join();
  return written({ ...first, seen: 0 }) === written({ ...second, seen: 0 });
}
