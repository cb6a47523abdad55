/* The tab "Elements": what the run says of its map and camera, and each map element over the run. */

import { byId, el, fixed } from "/static/dom.js";
import { classGlyph } from "/static/glyphs.js";
import { currentTheme } from "/static/theme.js";
import { known, oneOf } from "./address.js";

const COLUMNS = [
  { name: "name", text: "element", of: (row) => row.name, title: "Element" },
  { name: "view", text: "view", of: (row) => row.inView, title: "Frames in whose image it should be", wide: true },
  { name: "seen", text: "seen", of: (row) => row.seen.length, title: "Frames with a detection of it" },
  { name: "used", text: "used", of: (row) => row.used.length, title: "Frames whose answer rests on it", wide: true },
  { name: "out", text: "out", of: (row) => row.outlier.length, title: "Outlier: frames whose detection of it does not fit it, at the true pose where that is known, else under the answer" },
  { name: "px", text: "px", of: (row) => row.medianPx, title: "Residual: the median over the frames that see it, px" },
  { name: "cost", text: "cost", of: (row) => row.costM, title: "Error cost, m: how much larger the error is with it than without, on average over the frames that use it (their answers fitted again to the other pairs, not searched again). Below 0 it helps" },
];
const BY_NAME = new Map(COLUMNS.map((one) => [one.name, one]));
const WORST = "out";
const LISTED = 8; // so many frames of a fault are named

export class ElementList {
  constructor(page) {
    this.page = page;
    this.found = null; // what the server said of the run
    this.sort = WORST;
    this.classId = null;
    this.isAsked = false;
    byId("elements-page").replaceChildren(
      el("div", { id: "run-verdict" }),
      el("div", { class: "chips", id: "element-classes" }),
      el("div", { class: "element row head", id: "element-head" }),
      el("ol", { class: "body list", id: "element-list", tabindex: -1 }));
  }

  address() {
    return [{
      fields: { sort: oneOf(WORST, ...COLUMNS.map((one) => one.name)), class: known(() => this.run.classes.map((one) => one.name)) },
      get: () => ({ sort: this.sort, class: this.className() }),
      set: ({ sort, class: name }) => this.show(sort, name),
    }];
  }

  showRun(run) {
    this.run = run;
    this.found = null;
    this.isAsked = false;
    this.classId = null;
    this.ask();
  }

  showTabs() {
    this.ask();
  }

  /** Only once it is looked at: it takes a while. */
  ask() {
    if (this.page.left.shown !== "elements" || this.isAsked || !this.run) return;
    this.isAsked = true;
    this.page.socket.send({ verb: "elements" });
  }

  showElements(found) {
    this.found = found;
    this.fill();
  }

  showState(state) {
    this.state = state;
    this.mark();
  }

  showTheme() {
    if (this.found) this.fill();
  }

  className() {
    return this.run?.classes.find((one) => one.id === this.classId)?.name ?? null;
  }

  /** Sorted by a column, and only the class of that name, or all where it is null. */
  show(sort, name) {
    this.sort = sort;
    this.classId = this.run.classes.find((one) => one.name === name)?.id ?? null;
    if (this.found?.ready) this.fill();
    this.page.address.changed();
  }

  fill() {
    const { ready, doing } = this.found;
    byId("run-verdict").replaceChildren(...(ready ? this.verdict() : [el("p", { class: "dim", text: `Going through the run: ${doing}` })]));
    byId("element-classes").replaceChildren(...(ready ? this.chips() : []));
    byId("element-head").replaceChildren(...(ready ? this.head() : []));
    byId("element-list").replaceChildren(...(ready ? this.rows().map((row) => this.row(row)) : []));
    this.mark();
  }

  /* The run's verdict */

  verdict() {
    const { verdict, compared } = this.found;
    const about = `in ${compared} ${compared === 1 ? "frame" : "frames"} with a pose to compare with`;
    if (!verdict.length) return [el("p", {}, "Nothing of map or camera is seen to be wrong ", el("span", { class: "dim", text: about }), ".")];
    return [el("h4", { text: "Wrong over the run", title: about }), ...verdict.map((one) => this.fault(one))];
  }

  fault({ kind, sentence, evidence, frames, element, observed, position }) {
    const see = () => this.see({ element, observed }, position);
    const listed = frames.length > LISTED ? [...frames.slice(0, LISTED), "…"] : frames;
    const numbers = [...evidence.map(([name, value]) => `${name} ${value}`), ...(frames.length ? [`frames ${listed.join(", ")}`] : [])].join(" · ");
    return el("button", { class: "fault", title: "Click: see it in a frame", onclick: see },
      el("b", { text: kind }), el("span", { text: sentence }), el("span", { class: "dim", text: numbers }));
  }

  /** Selects it, then goes to a frame that shows it; the frame keeps a selected element. */
  see({ element, observed = null }, position) {
    if (position === null) {
      this.page.select({ element });
    } else if (element !== null) {
      this.page.select({ element });
      this.page.go(position);
    } else {
      this.page.go(position);
      this.page.select({ observed });
    }
  }

  /* The list */

  chips() {
    const chip = (one, name) => {
      const rows = this.found.rows.filter((row) => !one || row.class === one.id);
      const glyph = one ? classGlyph(one, this.color(one)) : el("span", { text: "All" });
      return el("button", { class: "chip", title: one?.name ?? "all classes", "aria-pressed": this.classId === (one?.id ?? null), onclick: () => this.show(this.sort, name) },
        glyph, el("span", { text: rows.length }));
    };
    const there = this.run.classes.filter((one) => this.found.rows.some((row) => row.class === one.id));
    return [chip(null, null), ...there.map((one) => chip(one, one.name))];
  }

  head() {
    return COLUMNS.map(({ name, text, title, wide }) => el("button", {
      class: wide ? "wide" : "", title: `${title}. Click: sort by it`, "aria-pressed": this.sort === name, text, onclick: () => this.show(name, this.className()) }));
  }

  /** The largest first, names by the alphabet; what has no value last. */
  rows() {
    const { of } = BY_NAME.get(this.sort);
    const kept = this.found.rows.filter((row) => this.classId === null || row.class === this.classId);
    const order = (a, b) => (this.sort === "name" ? a.name.localeCompare(b.name, "en", { numeric: true }) : (of(b) ?? -Infinity) - (of(a) ?? -Infinity));
    return kept.sort((a, b) => order(a, b) || (b.costM ?? -Infinity) - (a.costM ?? -Infinity) || a.id - b.id);
  }

  row(row) {
    const cells = COLUMNS.slice(1).map((one) => el("span", { class: one.wide ? "wide" : "", text: cellText(one, row) }));
    return el("li", { class: "element row", title: rowTitle(row), data: { element: row.id }, onclick: () => this.choose(row) },
      this.name(row), ...cells);
  }

  name({ name, class: id }) {
    const one = this.run.classes.find((other) => other.id === id);
    return el("b", {}, classGlyph(one, this.color(one)), name);
  }

  color(one) {
    return currentTheme() === "light" ? one.colorLight : one.color;
  }

  choose(row) {
    const { position } = this.page.frame;
    const isHere = row.seen.includes(position) || row.used.includes(position);
    this.see({ element: row.id }, isHere ? null : row.position);
  }

  mark() {
    for (const row of byId("element-list").children) {
      const current = Number(row.dataset.element) === this.state?.element;
      row.setAttribute("aria-current", current);
      if (current) row.scrollIntoView({ block: "nearest" });
    }
  }
}

function cellText({ name, of }, row) {
  const value = of(row);
  if (name === "px") return value === null ? "—" : fixed(value, 1);
  if (name === "cost") return value === null ? "—" : `${value > 0 ? "+" : ""}${fixed(value, 2)}`.replace("-", "−");
  return value;
}

function rowTitle({ name, inView, seen, used, outlier, share, medianPx, costM }) {
  const said = [`${name}: in view in ${inView} frames, seen in ${seen.length}, used in ${used.length}.`];
  if (seen.length) said.push(`It does not fit in ${outlier.length} of those that see it (${Math.round(100 * share)} %); the residual in the middle is ${fixed(medianPx, 1)} px.`);
  if (costM !== null) said.push(`With it the error is ${fixed(Math.abs(costM), 2)} m ${costM > 0 ? "larger" : "smaller"} than without, on average.`);
  return said.join(" ");
}
