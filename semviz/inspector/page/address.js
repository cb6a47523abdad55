/* The page's address holds what a colleague needs to see the same; the browser's back and forward
 * go between the frames that were looked at.
 *
 * What of it is a panel's, the panel says in `address()`: a list of `{fields, get, set}`. `fields` are
 * by name, as `oneOf`, `flag`, `known` and `whole` make them. `get()` gives their values by name, as
 * texts, null for none; what is initial is not written. `set(values)` gets all of them at once. */

const SETTLED_MS = 300; // writing is slow in browsers: not while anything is painted
const LOOKED_AT_MS = 1000; // frames that were seen for less are no places to go back to
const OWN = ["run", "frame", "token"];

/** One of some texts; the first is the initial one. */
export const oneOf = (...texts) => ({ initial: texts[0], knows: (text) => texts.includes(text) });
export const flag = (initial = "no") => ({ initial, knows: (text) => text === "yes" || text === "no" });
/** None at first; of those that `names()` gives by then. */
export const known = (names) => ({ initial: null, knows: (text) => names().includes(text) });
/** None at first; a whole number. */
export const whole = () => ({ initial: null, knows: (text) => /^\d{1,15}$/.test(text) });
export const yes = (value) => (value ? "yes" : "no");
export const numberOf = (text) => (text === null ? null : Number(text));
export const textOf = (number) => (number === null ? null : String(number));

export class Address {
  constructor(page, parts) {
    this.page = page;
    this.parts = parts;
    this.wanted = null; // an address that is not shown yet
    this.written = null; // {run, position} of the address as it is
    this.since = 0; // when that frame was come to
    addEventListener("popstate", () => this.follow());
  }

  /** Opens what the address says, among the runs that there are. */
  begin(runs) {
    this.wanted = new URLSearchParams(location.search);
    const run = this.wanted.get("run");
    this.page.open(runs.includes(run) ? run : null, numberOf(this.numberIn("frame")));
  }

  /** Back or forward: to the run and frame of the address that it is by now. */
  follow() {
    const { page } = this;
    if (!page.run) return;
    this.wanted = new URLSearchParams(location.search);
    const frame = numberOf(this.numberIn("frame"));
    const position = page.run.frames.findIndex((row) => row.index === frame);
    if (this.wanted.get("run") !== page.run.name) page.open(this.wanted.get("run"), frame);
    else if (position >= 0 && position !== page.frame.position) page.go(position);
    else this.arrive();
  }

  /** A frame is shown: now the rest of what the address asks for can be. */
  arrive() {
    if (!this.wanted) return;
    const { wanted, page } = this;
    this.wanted = null;
    this.written = { run: page.run.name, position: page.frame.position };
    const strange = this.strangers(wanted);
    for (const { fields, get, set } of this.parts) {
      const values = {};
      for (const [name, { initial, knows }] of Object.entries(fields)) {
        const text = wanted.get(name);
        values[name] = text !== null && knows(text) ? text : initial;
        if (text !== null && !knows(text)) strange.push(`${name}=${text}`);
      }
      const now = get();
      if (Object.entries(values).some(([name, value]) => now[name] !== value)) set(values);
    }
    if (strange.length) page.notice(`Left out of this address, as it is not known here: ${strange.join(", ")}`, true);
    this.changed();
  }

  /** What is in an address but not there: run, frame, or names that nobody has. */
  strangers(wanted) {
    const { run, frame } = this.page;
    const names = [...OWN, ...this.parts.flatMap(({ fields }) => Object.keys(fields))];
    const shown = { run: run.name, frame: String(frame.index) };
    return [...wanted].filter(([name, text]) => !names.includes(name) || (name in shown && shown[name] !== text)).map(([name, text]) => `${name}=${text}`);
  }

  numberIn(name) {
    const text = this.wanted.get(name);
    return text !== null && whole().knows(text) ? text : null;
  }

  /** What was asked for was refused. */
  refused() {
    this.wanted = null;
  }

  /** To be called whenever something of it may be another. */
  changed() {
    clearTimeout(this.writing);
    this.writing = setTimeout(() => this.write(), SETTLED_MS);
  }

  write() {
    const { run, frame, wanted } = this.page;
    if (this.wanted || !frame || wanted !== frame.position) return; // on the way to another frame
    const query = new URLSearchParams({ run: run.name, frame: frame.index });
    for (const { fields, get } of this.parts) {
      for (const [name, value] of Object.entries(get())) if (value !== fields[name].initial) query.set(name, value);
    }
    const address = `?${query}`;
    if (address !== location.search) history[this.isPlace() ? "pushState" : "replaceState"](null, "", address);
    if (this.written?.run !== run.name || this.written.position !== frame.position) this.since = performance.now();
    this.written = { run: run.name, position: frame.position };
    document.title = `Frame ${frame.index} · ${run.name} · semviz inspect`;
  }

  /** Whether the frame before is one to come back to: it was looked at, and left by a jump. */
  isPlace() {
    const { run, frame } = this.page;
    const { written } = this;
    const jumped = written && (written.run !== run.name || Math.abs(written.position - frame.position) > 1);
    return jumped && performance.now() - this.since > LOOKED_AT_MS;
  }
}
