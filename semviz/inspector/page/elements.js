// @ts-check
/* The tab "Elements": faults of priors, map and camera, and each map element over the run. */

import { byId, el, fixed, unbroken } from "/static/dom.js";
import { classGlyph } from "/static/glyphs.js";
import { currentTheme } from "/static/theme.js";
import { VirtualList } from "/static/virtual_list.js";
import { memberOf, oneOf } from "./address.js";

/** @typedef {import("/static/protocol").inspector.ElementClassView} ElementClassView */
/** @typedef {import("/static/protocol").inspector.ElementRow} ElementRow */
/** @typedef {import("/static/protocol").inspector.ElementsEvent} ElementsEvent */
/** @typedef {import("/static/protocol").inspector.RunFaultView} RunFaultView */
/** @typedef {import("/static/protocol").inspector.RunFindings} RunFindings */
/** @typedef {import("./panel.js").AddressPart} AddressPart */
/** @typedef {import("./main.js").Page} Page */

/** @typedef {{name: string, text: string, of: (row: ElementRow) => any, title: string, has?: (row: ElementRow) => boolean}} Column a column with `has` is shown if some element has a value */

/** @type {Column[]} */
const COLUMNS = [
  { name: "name", text: "element", of: (row) => row.name, title: "Element" },
  { name: "sure", text: "sure %", of: (row) => (row.log_odds === null ? null : -row.log_odds), title: "Probability that it exists, judged from its detections. The least sure first", has: (row) => row.log_odds !== null },
  { name: "view", text: "view", of: (row) => row.in_view, title: "Frames with the element in view" },
  { name: "seen", text: "seen", of: (row) => row.seen, title: "Frames that detect it" },
  { name: "used", text: "used", of: (row) => row.used, title: "Frames whose estimate uses it" },
  { name: "out", text: "out", of: (row) => row.outlier, title: "Frames in which it is an outlier at the true pose, or at the estimate without ground truth" },
  { name: "blamed", text: "blamed", of: (row) => blamedFrames(row), title: "Frames whose diagnosis blames it. The list above the table tells as what" },
  { name: "duplicate", text: "duplicate", of: (row) => (row.duplicate_m === null ? null : -row.duplicate_m), title: "The nearest element of its class at the same position, within 1 m: both may be one. The nearest first", has: (row) => row.duplicate_m !== null },
  { name: "px", text: "px", of: (row) => row.median_px, title: "Median residual over the frames that detect it, px" },
  { name: "cost", text: "cost", of: (row) => row.cost_m, title: "Mean error with this element minus error without it (m), over the frames that use it. Negative: the element helps. The pose is refined without it; the search is not repeated" },
];
const BY_NAME = new Map(COLUMNS.map((column) => [column.name, column]));
const WORST = "out";
const BLAMED = "blamed", DUPLICATE = "has a duplicate"; // filters beside the kinds of fault
const MAX_LISTED = 8; // frames listed for a fault
const ROW_PX = 26;

export class ElementList {
  /** @param {Page} page */
  constructor(page) {
    this.page = page;
    /** @type {RunFindings | null} */
    this.findings = null;
    this.progress = "";
    this.sort = WORST;
    /** @type {number | null} */
    this.classId = null;
    /** @type {string | null} */
    this.finding = null; // only elements blamed for this kind of fault, or a filter above
    this.isRequested = false;
    page.socket.on("elements", (event) => this.showElements(event));
    byId("elements-page").replaceChildren(
      el("div", { id: "run-diagnosis" }),
      el("div", { class: "chips", id: "element-classes" }),
      el("div", { class: "chips", id: "element-findings" }),
      el("div", { class: "element row head", id: "element-head" }),
      el("ol", { class: "body list", id: "element-list", tabindex: -1 }));
    /** The rows in the list.
     *
     * @type {ElementRow[]} */
    this.listed = [];
    /** @type {Column[]} */
    this.shown = [];
    this.rowList = new VirtualList(byId("element-list"), ROW_PX, (index) => this.row(this.listed[index]));
  }

  /** @returns {AddressPart[]} */
  address() {
    return [{
      fields: { sort: oneOf(WORST, ...COLUMNS.map((column) => column.name)), class: memberOf(() => this.page.store.run.classes.map((kind) => kind.name)), finding: { initial: null, accepts: () => true } },
      get: () => ({ sort: this.sort, class: this.className(), finding: this.finding }),
      set: ({ sort, class: name, finding }) => this.show({ sort, name, finding }),
    }];
  }

  showRun() {
    this.findings = null;
    this.isRequested = false;
    this.classId = null;
    this.finding = null;
    this.requestFindings();
  }

  showTabs() {
    this.requestFindings();
  }

  /** Only once the tab is shown: the diagnosis takes a while. */
  requestFindings() {
    if (this.page.left.shown !== "elements" || this.isRequested || !this.page.store.isOpen) return;
    this.isRequested = true;
    this.page.socket.send("get_elements");
  }

  /** @param {ElementsEvent} event */
  showElements({ progress, found: findings }) {
    this.progress = progress;
    this.findings = findings;
    this.fill();
  }

  showState() {
    this.mark();
  }

  showTheme() {
    if (this.findings) this.fill();
  }

  className() {
    if (this.classId === null) return null;
    return this.page.store.run.classes.find((kind) => kind.id === this.classId)?.name ?? null;
  }

  /** Sorts by a column, and filters by a class name and a finding; null shows all. What is omitted
   * stays as it is.
   *
   * @param {{sort?: string, name?: string | null, finding?: string | null}} chosen
   */
  show({ sort = this.sort, name = this.className(), finding = this.finding }) {
    Object.assign(this, { sort, finding });
    this.classId = this.page.store.run.classes.find((kind) => kind.name === name)?.id ?? null;
    if (this.findings) this.fill();
    this.page.address.changed();
  }

  fill() {
    const { findings } = this;
    this.shown = this.columns();
    const progress = el("p", { class: "dim", text: `Diagnosing the run: ${this.progress}` });
    byId("run-diagnosis").replaceChildren(...(findings ? this.faults(findings) : [progress]));
    byId("element-classes").replaceChildren(...(findings ? this.chips(findings.rows) : []));
    byId("element-findings").replaceChildren(...(findings ? [this.findingChoice(findings.rows)] : []));
    const { classList } = byId("elements-page");
    for (const name of ["sure", "duplicate"]) classList.toggle(`has-${name}`, this.shown.some((column) => column.name === name));
    byId("element-head").replaceChildren(...(findings ? this.head() : []));
    this.listed = findings ? this.sorted(findings.rows) : [];
    this.rowList.show(this.listed.length);
    this.mark();
  }

  /* The diagnosis of the run */

  /** @param {RunFindings} findings */
  faults({ faults, compared }) {
    const about = `in ${compared} ${compared === 1 ? "frame" : "frames"} with a pose`;
    if (!faults.length) return [el("p", {}, "No faults of priors, map or camera ", el("span", { class: "dim", text: about }), ".")];
    return [el("h4", { text: "Faults over the run", title: about }), ...faults.map((fault) => this.fault(fault))];
  }

  /** @param {RunFaultView} fault */
  fault({ kind, sentence, evidence, frames, element, observed, position }) {
    const goTo = () => this.goTo({ element, observed }, position);
    const indices = frames.length > MAX_LISTED ? [...frames.slice(0, MAX_LISTED), "…"] : frames;
    const numbers = [...evidence.map(([name, value]) => `${name} ${value}`), ...(frames.length ? [`frames ${indices.join(", ")}`] : [])].join(" · ");
    return el("button", { class: "fault", title: "Go to a frame that shows it", onclick: goTo },
      el("b", { text: kind }), el("span", {}, ...unbroken(sentence)), el("span", { class: "dim", text: numbers }));
  }

  /** Selects the target and goes to a frame that shows it. A new frame keeps a selected element only.
   *
   * @param {{element: number | null, observed?: number | null}} target
   * @param {number | null} position
   */
  goTo({ element, observed = null }, position) {
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

  /** @param {ElementRow[]} rows */
  chips(rows) {
    /** @param {ElementClassView | null} kind */
    const chip = (kind) => {
      const count = rows.filter((row) => !kind || row.class_id === kind.id).length;
      const glyph = kind ? classGlyph(kind, this.color(kind)) : el("span", { text: "All" });
      return el("button", { class: "chip", title: kind?.name ?? "all classes", "aria-pressed": this.classId === (kind?.id ?? null), onclick: () => this.show({ name: kind?.name ?? null }) },
        glyph, el("span", { text: count }));
    };
    const present = this.page.store.run.classes.filter((kind) => rows.some((row) => row.class_id === kind.id));
    return [chip(null), ...present.map((kind) => chip(kind))];
  }

  /** The choice of what diagnoses blame elements for, with numbers of elements.
   *
   * @param {ElementRow[]} rows
   */
  findingChoice(rows) {
    /** @type {Map<string, number>} */
    const counts = new Map();
    const count = (/** @type {string} */ name) => counts.set(name, (counts.get(name) ?? 0) + 1);
    for (const row of rows) {
      for (const [kind] of row.blamed) count(kind);
      if (row.blamed.length) count(BLAMED);
      if (row.duplicate) count(DUPLICATE);
    }
    if (this.finding !== null && !counts.has(this.finding)) counts.set(this.finding, 0);
    const sorted = [...counts].sort((a, b) => b[1] - a[1] || a[0].localeCompare(b[0]));
    const choice = el("select", { id: "finding-filter", class: this.finding === null ? "" : "on", title: "Only elements that diagnoses blame, and as what",
      onchange: () => this.show({ finding: choice.value || null }) },
      el("option", { value: "", text: "Blamed or not" }), ...sorted.map(([name, number]) => el("option", { value: name, text: `${name}  ${number}` })));
    choice.value = this.finding ?? "";
    return choice;
  }

  columns() {
    return COLUMNS.filter(({ has }) => !has || this.findings?.rows.some(has));
  }

  head() {
    return this.shown.map(({ name, text, title }) => el("button", {
      class: name, title: `${title}. Click to sort`, "aria-pressed": this.sort === name, text, onclick: () => this.show({ sort: name }) }));
  }

  /** Largest first, names alphabetically, rows without a value last.
   *
   * @param {ElementRow[]} rows
   */
  sorted(rows) {
    const of = BY_NAME.get(this.sort)?.of ?? (() => null);
    const filtered = rows.filter((row) => (this.classId === null || row.class_id === this.classId) && hasFinding(row, this.finding));
    /** @type {(a: ElementRow, b: ElementRow) => number} */
    const order = (a, b) => (this.sort === "name" ? a.name.localeCompare(b.name, "en", { numeric: true }) : (of(b) ?? -Infinity) - (of(a) ?? -Infinity));
    return filtered.sort((a, b) => order(a, b) || (b.cost_m ?? -Infinity) - (a.cost_m ?? -Infinity) || a.id - b.id);
  }

  /** @param {ElementRow} row */
  row(row) {
    const cells = this.shown.slice(1).map((column) => el("span", { class: column.name, text: cellText(column, row) }));
    return el("li", { class: "element row", title: rowTitle(row), data: { element: row.id }, onclick: () => this.choose(row) },
      this.name(row), ...cells);
  }

  /** @param {ElementRow} row */
  name({ name, class_id: id }) {
    const kind = this.page.store.run.classes.find((other) => other.id === id);
    return el("b", { class: "name" }, kind ? classGlyph(kind, this.color(kind)) : null, name);
  }

  /** @param {ElementClassView} kind */
  color(kind) {
    return currentTheme() === "light" ? kind.color_light : kind.color;
  }

  /** @param {ElementRow} row */
  choose(row) {
    const { mapped, observed, pairs } = this.page.store.frame;
    const column = mapped.findIndex(({ id }) => id === row.id);
    const isHere = column >= 0 && (observed.some(({ truth }) => truth === column) || pairs.some((pair) => pair.mapped === column));
    this.goTo({ element: row.id }, isHere ? null : row.position);
  }

  mark() {
    const { element } = this.page.store.state;
    this.rowList.mark(this.listed.findIndex((row) => row.id === element));
  }
}

/** @param {ElementRow} row */
function blamedFrames({ blamed }) {
  return blamed.reduce((sum, [, frames]) => sum + frames, 0);
}

/**
 * @param {ElementRow} row
 * @param {string | null} finding
 */
function hasFinding({ blamed, duplicate }, finding) {
  if (finding === null) return true;
  if (finding === DUPLICATE) return duplicate !== "";
  return finding === BLAMED ? blamed.length > 0 : blamed.some(([kind]) => kind === finding);
}

/**
 * @param {Column} column
 * @param {ElementRow} row
 */
function cellText({ name, of }, row) {
  if (name === "sure") return row.existence.replace(" %", "") || "—";
  if (name === "duplicate") return row.duplicate || "—";
  const value = of(row);
  if (name === "px") return value === null ? "—" : fixed(value, 1);
  if (name === "cost") return value === null ? "—" : `${value > 0 ? "+" : ""}${fixed(value, 2)}`.replace("-", "−");
  return value;
}

/** @param {ElementRow} row */
function rowTitle({ name, in_view: inView, seen, used, outlier, share, median_px: medianPx, cost_m: costM, blamed, duplicate, duplicate_m: duplicateM }) {
  const sentences = [`${name}: in view in ${inView} frames, detected in ${seen}, used in ${used}.`];
  if (seen) sentences.push(`An outlier in ${outlier} of the frames that detect it (${Math.round(100 * (share ?? 0))} %); median residual ${fixed(medianPx, 1)} px.`);
  if (blamed.length) sentences.push(`Blamed as ${blamed.map(([kind, frames]) => `${kind} in ${frames}`).join(", ")} of the frames.`);
  if (duplicateM !== null) sentences.push(`${duplicate} is of its class and ${fixed(duplicateM, 2)} m away.`);
  if (costM !== null) sentences.push(`The mean error is ${fixed(Math.abs(costM), 2)} m ${costM > 0 ? "larger" : "smaller"} with it than without it.`);
  return sentences.join(" ");
}
