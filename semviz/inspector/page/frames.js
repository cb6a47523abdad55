// @ts-check
/* The list of frames, worst first, and its filters: by status, diagnosis and element. */

import { byId, el, fixed, unbroken } from "/static/dom.js";
import { statusMark } from "/static/glyphs.js";
import { VirtualList } from "/static/virtual_list.js";
import { flag, memberOf, numberOf, textOf, wholeNumber, yes } from "./address.js";

/** @typedef {import("/static/protocol").inspector.ElementFramesEvent} ElementFramesEvent */
/** @typedef {import("./run_rows.js").FrameRow} FrameRow */
/** @typedef {import("/static/protocol").inspector.FrameView} FrameView */
/** @typedef {import("/static/protocol").inspector.StoryCause} StoryCause */
/** @typedef {import("./panel.js").AddressPart} AddressPart */
/** @typedef {import("./main.js").Page} Page */

/** @type {Status[]} */
const STATUSES = ["ok", "ambiguous", "cannot"];
const ROW_PX = 36; // two lines of a diagnosis

/** @typedef {FrameRow["status"]} Status */
/** @typedef {import("./run_rows.js").PlacedRow} PlacedRow */
/** @typedef {{row: PlacedRow, severity: number, first: number, last: number}} FrameGroup the worst of consecutive frames, and the positions of all */

/** How bad a frame is: overconfident, over 1 m off, without a pose, ambiguous, then by error.
 *
 * @param {Pick<FrameRow, "overconfident" | "error_m" | "status">} row
 */
export function severity(row) {
  const errorM = row.error_m ?? 0;
  if (row.overconfident) return 3e6 + errorM;
  if (errorM > 1) return 2e6 + errorM;
  if (row.status === "cannot") return 1e6;
  if (row.status === "ambiguous") return 5e5 + errorM;
  return errorM;
}

/** The largest error in pixels that a frame's noticed faults tell; 0 without any.
 *
 * @param {FrameRow} row
 */
function noticedPx({ noticed }) {
  return Math.max(0, ...[...noticed.matchAll(/(\d+) px/g)].map(([, px]) => Number(px)));
}

/** The first of the noticed faults, and how many more there are: lines of the list are short.
 *
 * @param {string} noticed
 */
function firstNoticed(noticed) {
  const [first, ...others] = noticed.split(/; |, /);
  return others.length ? `${first} +${others.length}` : first;
}

/** @param {FrameRow} row */
function errorText(row) {
  if (row.status === "cannot") return "none";
  return row.error_m === null ? "—" : `${fixed(row.error_m, 2)} m`;
}

/** Consecutive frames with the same diagnosis form a group, except healthy ones.
 *
 * @param {PlacedRow[]} rows
 * @returns {FrameGroup[]}
 */
function grouped(rows) {
  /** @type {FrameGroup[]} */
  const groups = [];
  for (const row of rows) {
    const group = groups.at(-1);
    const worse = severity(row);
    if (!group || group.last + 1 !== row.position || !isAlike(group.row, row)) {
      groups.push({ row, severity: worse, first: row.position, last: row.position });
      continue;
    }
    group.last = row.position;
    if (worse > group.severity) Object.assign(group, { row, severity: worse });
  }
  return groups;
}

/**
 * @param {PlacedRow} a
 * @param {PlacedRow} b
 */
function isAlike(a, b) {
  return a.diagnosis === b.diagnosis && a.status === b.status && a.diagnosis !== "healthy";
}

export class FrameList {
  /** @param {Page} page */
  constructor(page) {
    this.page = page;
    /** @type {FrameGroup[]} */
    this.groups = [];
    /** @type {Int32Array} */
    this.groupOf = new Int32Array(0); // by position; -1 where the list has none
    this.rowList = new VirtualList(byId("frame-list"), ROW_PX, (index) => listRow(this.groups[index]));
    /** @type {Status | null} */
    this.status = null;
    /** @type {string | null} */
    this.diagnosis = null;
    /** @type {number | null} */
    this.element = null; // only frames that detect it, or whose estimate uses it
    /** @type {Set<number> | null} */
    this.withElement = null; // their positions
    this.elementName = "";
    /** @type {StoryCause | null} */
    this.cause = null; // only frames that it explains
    this.noticed = false; // only frames with faults that did no harm
    page.socket.on("element_frames", (event) => this.showElementFrames(event));
    byId("frame-list").addEventListener("click", (event) => goToClicked(page, event));
    this.choice = byId("diagnosis-filter", HTMLSelectElement);
    this.choice.addEventListener("change", () => {
      this.filter({ diagnosis: this.choice.value || null });
      this.choice.blur();
    });
    byId("element-filter").addEventListener("click", () => this.toggleElement());
  }

  /** @returns {AddressPart[]} */
  address() {
    const diagnoses = () => this.page.store.run.frames.map((row) => row.diagnosis);
    return [{
      fields: { status: memberOf(() => STATUSES), verdict: memberOf(diagnoses), only: wholeNumber(), noticed: flag() },
      get: () => ({ status: this.status, verdict: this.diagnosis, only: textOf(this.element), noticed: yes(this.noticed) }),
      set: ({ status, verdict, only, noticed }) => this.filter({ status, diagnosis: verdict, element: numberOf(only), noticed: noticed === "yes" }),
    }];
  }

  /** Removes all filters. */
  clear() {
    this.status = null;
    this.diagnosis = null;
    this.element = null;
    this.withElement = null;
    this.cause = null;
    this.noticed = false;
  }

  showRun() {
    const digits = String(this.page.store.run.frames.at(-1)?.index ?? 0).length;
    byId("frames").style.setProperty("--digits", String(Math.max(digits, 4))); // the widest number
    this.clear();
    this.fill();
  }

  /** @param {FrameView} frame */
  showFrame(frame) {
    this.pointAt(frame.position);
  }

  showState() {
    this.fillElement();
  }

  /** The frames with the element of the filter have arrived.
   *
   * @param {ElementFramesEvent} event
   */
  showElementFrames({ element, name, positions }) {
    if (element !== this.element) return;
    this.withElement = new Set(positions);
    this.elementName = name;
    this.fill();
  }

  /** The element of the filter is not in the map. */
  showRefusal() {
    if (this.element !== null && !this.withElement) this.filter({ element: null });
  }

  /** @param {number} position */
  pointAt(position) {
    this.rowList.mark(this.groupOf[position] ?? -1);
  }

  /** @param {number} by */
  step(by) {
    const now = this.groupOf[this.page.store.target] ?? -1;
    const next = this.groups[Math.min(Math.max(now + by, 0), this.groups.length - 1)];
    if (next) this.page.go(next.row.position);
  }

  /** Sets filters; omitted ones stay as they are.
   *
   * @param {{status?: Status | null, diagnosis?: string | null, element?: number | null, noticed?: boolean}} filters
   */
  filter({ status = this.status, diagnosis = this.diagnosis, element = this.element, noticed = this.noticed }) {
    Object.assign(this, { status, diagnosis, noticed });
    if (element !== this.element) {
      this.element = element;
      this.withElement = null;
      if (element !== null) this.page.socket.send("find_frames", { element });
    }
    this.fill();
    this.page.address.changed();
  }

  /** Only frames that a cause of the run's story explains; null shows all.
   *
   * @param {StoryCause | null} cause
   */
  showCause(cause) {
    this.cause = cause;
    this.fill();
  }

  toggleElement() {
    this.filter({ element: this.element === null ? this.page.store.state.element : null });
  }

  /** Frames that pass all filters, except the one named.
   *
   * @param {string} [except]
   * @returns {PlacedRow[]}
   */
  rows(except = "") {
    const explained = this.cause && new Set(this.cause.frames);
    return this.page.store.run.frames.filter((row) =>
      (except === "status" || !this.status || row.status === this.status)
      && (except === "diagnosis" || !this.diagnosis || row.diagnosis === this.diagnosis)
      && (!this.withElement || this.withElement.has(row.position))
      && (except === "noticed" || !this.noticed || row.noticed !== "")
      && (!explained || explained.has(row.position)));
  }

  fill() {
    const first = (/** @type {FrameGroup} */ { row }) => (this.noticed ? noticedPx(row) : 0);
    this.groups = grouped(this.rows()).sort((a, b) => first(b) - first(a) || b.severity - a.severity || a.first - b.first);
    byId("found-head").textContent = this.noticed ? "noticed" : "diagnosis";
    this.groupOf = new Int32Array(this.page.store.run.frames.length).fill(-1);
    this.groups.forEach(({ first, last }, index) => this.groupOf.fill(index, first, last + 1));
    this.rowList.show(this.groups.length);
    if (!this.groups.length) byId("frame-list").append(el("li", { class: "none dim", text: "No frames match these filters." }));
    byId("filters").replaceChildren(this.chip(null), ...STATUSES.map((status) => this.chip(status)), this.noticedChip(), ...this.causeChip());
    this.fillDiagnoses();
    this.fillElement();
    this.pointAt(this.page.store.target);
  }

  /** @param {Status | null} status */
  chip(status) {
    const rows = this.rows("status").filter((row) => !status || row.status === status);
    const chip = el("button", {
      class: "chip",
      title: status ?? "all frames",
      "aria-pressed": this.status === status,
      onclick: () => this.filter({ status }),
    });
    chip.append(status ? statusMark(status) : el("span", { text: "All" }), el("span", { text: rows.length }));
    return chip;
  }

  /** Healthy frames with faults that did no harm yet: a label or a map element worth a look. */
  noticedChip() {
    const count = this.rows("noticed").filter((row) => row.noticed).length;
    return el("button", { class: "chip", title: "Only frames with faults that did no harm", "aria-pressed": this.noticed,
      onclick: () => this.filter({ noticed: !this.noticed }), text: `noticed ${count}` });
  }

  causeChip() {
    if (!this.cause) return [];
    return [el("button", { class: "chip", title: "Only frames that this cause explains. Click to show all", "aria-pressed": true,
      text: `${this.cause.kind} ✕`, onclick: () => this.showCause(null) })];
  }

  /** Most frequent first. */
  fillDiagnoses() {
    const rows = this.rows("diagnosis");
    /** @type {Map<string, number>} */
    const counts = new Map();
    for (const { diagnosis } of this.page.store.run.frames) counts.set(diagnosis, 0);
    for (const { diagnosis } of rows) counts.set(diagnosis, (counts.get(diagnosis) ?? 0) + 1);
    /** @type {(value: string, name: string, count: number) => HTMLOptionElement} */
    const option = (value, name, count) => el("option", { value, text: `${name}  ${count}` });
    const sorted = [...counts].sort((a, b) => b[1] - a[1] || a[0].localeCompare(b[0]));
    this.choice.replaceChildren(el("option", { value: "", text: "Any diagnosis" }), ...sorted.map(([name, count]) => option(name, name, count)));
    this.choice.value = this.diagnosis ?? "";
    this.choice.classList.toggle("on", this.diagnosis !== null);
  }

  fillElement() {
    const button = byId("element-filter", HTMLButtonElement);
    const isOn = this.element !== null;
    button.disabled = !isOn && this.page.store.state.element === null;
    button.setAttribute("aria-pressed", String(isOn));
    const count = this.withElement ? ` ${this.withElement.size}` : "";
    button.textContent = isOn ? `${this.elementName || "…"}${count} ✕` : "With selected";
    button.title = isOn ? "Frames that detect this element or use it. Click to show all frames" : "Show only frames that detect the selected element or use it";
  }
}

/** @param {FrameGroup} group */
function listRow({ row, first, last }) {
  const frames = last + 1 - first;
  return el("li", { class: "row", title: row.noticed ? `${row.reason} Noticed: ${row.noticed}.` : row.reason, data: { position: row.position } },
    statusMark(row.status),
    el("span", { class: "index", text: row.index }),
    el("span", { class: row.overconfident ? "wrong" : "", text: errorText(row) }),
    el("span", { class: "diagnosis" }, ...unbroken(row.noticed ? firstNoticed(row.noticed) : row.diagnosis)),
    el("span", { class: "count", text: frames > 1 ? `${frames}×` : "" }));
}

/** Goes to the frame whose row was clicked.
 *
 * @param {Page} page
 * @param {Event} event
 */
export function goToClicked(page, { target }) {
  const row = target instanceof Element ? target.closest("[data-position]") : null;
  if (row instanceof HTMLElement) page.go(Number(row.dataset.position));
}
