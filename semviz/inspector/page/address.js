// @ts-check
/* The page's address: a link shows the same view, and the browser's back and forward go between
 * visited frames.
 *
 * Each panel returns its parts by `address()`. `oneOf`, `flag`, `memberOf` and `wholeNumber` make
 * fields. Initial values are not written. */

/** @typedef {import("./panel.js").AddressPart} AddressPart */
/** @typedef {import("./panel.js").Field} Field */
/** @typedef {import("./main.js").Page} Page */

const SETTLED_MS = 300; // writing an address is slow: not while a frame is painted
const VISITED_MS = 1000; // frames shown for less time are not visited
const RESERVED = ["run", "frame", "token"];

/** One of the texts; the first is the initial value.
 *
 * @param {...string} texts
 * @returns {Field}
 */
export const oneOf = (...texts) => ({ initial: texts[0], accepts: (text) => texts.includes(text) });
/**
 * @param {string} initial
 * @returns {Field}
 */
export const flag = (initial = "no") => ({ initial, accepts: (text) => text === "yes" || text === "no" });
/** Initially null; then one of `names()`.
 *
 * @param {() => string[]} names
 * @returns {Field}
 */
export const memberOf = (names) => ({ initial: null, accepts: (text) => names().includes(text) });
/** Initially null; then a whole number.
 *
 * @returns {Field}
 */
export const wholeNumber = () => ({ initial: null, accepts: (text) => /^\d{1,15}$/.test(text) });
/** @param {boolean} value */
export const yes = (value) => (value ? "yes" : "no");
/** @param {string | null} text */
export const numberOf = (text) => (text === null ? null : Number(text));
/** @param {number | null} number */
export const textOf = (number) => (number === null ? null : String(number));

/** The frame number in an address; null without one.
 *
 * @param {URLSearchParams} query
 */
function frameIn(query) {
  const text = query.get("frame");
  return text !== null && wholeNumber().accepts(text) ? Number(text) : null;
}

export class Address {
  /**
   * @param {Page} page
   * @param {AddressPart[]} parts
   */
  constructor(page, parts) {
    this.page = page;
    this.parts = parts;
    /** @type {URLSearchParams | null} */
    this.pending = null; // an address that is not applied yet
    /** @type {{run: string, position: number} | null} */
    this.written = null; // run and frame of the present address
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.writing = undefined;
    this.shownSince = 0; // when that frame was reached
    addEventListener("popstate", () => this.restore());
  }

  /** Opens run and frame of the address, or else the first run. */
  open() {
    this.pending = new URLSearchParams(location.search);
    const run = this.pending.get("run");
    const isKnown = run !== null && this.page.store.names.includes(run);
    this.page.open(isKnown ? run : null, frameIn(this.pending));
  }

  /** Back or forward: goes to run and frame of the new address. */
  restore() {
    const { page } = this;
    const { store } = page;
    if (!store.isOpen) return;
    this.pending = new URLSearchParams(location.search);
    const frame = frameIn(this.pending);
    const position = store.run.frames.findIndex((row) => row.index === frame);
    if (this.pending.get("run") !== store.run.name) page.open(this.pending.get("run"), frame);
    else if (position >= 0 && position !== store.position) page.go(position);
    else this.apply();
  }

  /** A frame is shown: applies the rest of the address. */
  apply() {
    if (!this.pending) return;
    const { pending, page } = this;
    const { run, frame } = page.store;
    this.pending = null;
    this.written = { run: run.name, position: frame.position };
    const unknown = this.unknownParts(pending);
    for (const { fields, get, set } of this.parts) {
      /** @type {{[name: string]: string | null}} */
      const values = {};
      for (const [name, { initial, accepts }] of Object.entries(fields)) {
        const text = pending.get(name);
        values[name] = text !== null && accepts(text) ? text : initial;
        if (text !== null && !accepts(text)) unknown.push(`${name}=${text}`);
      }
      const now = get();
      if (Object.entries(values).some(([name, value]) => now[name] !== value)) set(values);
    }
    if (unknown.length) page.notice(`Unknown parts of this address were ignored: ${unknown.join(", ")}`, true);
    this.changed();
  }

  /** Parts of an address that the page cannot apply: another run or frame, unknown names.
   *
   * @param {URLSearchParams} pending
   */
  unknownParts(pending) {
    const { run, frame } = this.page.store;
    const names = [...RESERVED, ...this.parts.flatMap(({ fields }) => Object.keys(fields))];
    /** @type {{[name: string]: string}} */
    const shown = { run: run.name, frame: String(frame.index) };
    return [...pending].filter(([name, text]) => !names.includes(name) || (name in shown && shown[name] !== text)).map(([name, text]) => `${name}=${text}`);
  }

  /** The server refused a request. */
  cancel() {
    this.pending = null;
  }

  /** To be called whenever a value of the address may have changed. */
  changed() {
    clearTimeout(this.writing);
    this.writing = setTimeout(() => this.write(), SETTLED_MS);
  }

  write() {
    const { store } = this.page;
    if (this.pending || !store.hasFrame || store.target !== store.position) return; // on the way to another frame
    const { run, frame } = store;
    const query = new URLSearchParams({ run: run.name, frame: String(frame.index) });
    for (const { fields, get } of this.parts) {
      for (const [name, value] of Object.entries(get())) if (value !== fields[name].initial) query.set(name, String(value));
    }
    const address = `?${query}`;
    if (address !== location.search) history[this.isVisited() ? "pushState" : "replaceState"](null, "", address);
    if (this.written?.run !== run.name || this.written.position !== frame.position) this.shownSince = performance.now();
    this.written = { run: run.name, position: frame.position };
    document.title = `Frame ${frame.index} · ${run.name} · semviz inspect`;
  }

  /** Whether the last frame is one to go back to: it was visited, and left by a jump. */
  isVisited() {
    const { run, frame } = this.page.store;
    const { written } = this;
    const jumped = written && (written.run !== run.name || Math.abs(written.position - frame.position) > 1);
    return jumped && performance.now() - this.shownSince > VISITED_MS;
  }
}
