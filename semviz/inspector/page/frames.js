/* The list of frames, worst first, and its filters: by status, verdict and element. */

import { byId, el, fixed } from "/static/dom.js";
import { statusMark } from "/static/glyphs.js";
import { known, numberOf, textOf, whole } from "./address.js";

const STATUSES = ["ok", "ambiguous", "cannot"];

/** Sure and wrong is the worst kind, then wrong, then no answer, then doubt, then by error. */
export function badness(row) {
  if (row.sureAndWrong) return 3e6 + row.errorM;
  if (row.errorM > 1) return 2e6 + row.errorM;
  if (row.status === "cannot") return 1e6;
  if (row.status === "ambiguous") return 5e5 + (row.errorM ?? 0);
  return row.errorM ?? 0;
}

function errorText(row) {
  if (row.status === "cannot") return "none";
  return row.errorM === null ? "—" : `${fixed(row.errorM, 2)} m`;
}

/** Neighbouring frames with the same verdict become one row, but for healthy ones. */
function grouped(rows) {
  const groups = [];
  for (const row of rows) {
    const last = groups.at(-1)?.at(-1);
    const isNext = last && last.position + 1 === row.position;
    if (isNext && last.verdict === row.verdict && last.status === row.status && row.verdict !== "healthy") groups.at(-1).push(row);
    else groups.push([row]);
  }
  const worst = (group) => group.reduce((a, b) => (badness(b) > badness(a) ? b : a));
  return groups.map((group) => ({ ...worst(group), members: group.map((row) => row.position) }));
}

export class FrameList {
  constructor(page) {
    this.page = page;
    this.groups = [];
    this.clear();
    byId("frame-list").addEventListener("click", (event) => {
      const row = event.target.closest("[data-position]");
      if (row) page.go(Number(row.dataset.position));
    });
    byId("verdict-filter").addEventListener("change", (event) => {
      this.filter({ verdict: event.target.value || null });
      event.target.blur();
    });
    byId("element-filter").addEventListener("click", () => this.toggleElement());
  }

  address() {
    const verdicts = () => this.run.frames.map((row) => row.verdict);
    return [{
      fields: { status: known(() => STATUSES), verdict: known(verdicts), only: whole() },
      get: () => ({ status: this.status, verdict: this.verdict, only: textOf(this.element) }),
      set: ({ status, verdict, only }) => this.filter({ status, verdict, element: numberOf(only) }),
    }];
  }

  /** All frames are listed. */
  clear() {
    this.status = null;
    this.verdict = null;
    this.element = null; // only frames that see it, or whose answer rests on it
    this.withElement = null; // their positions
  }

  showRun(run) {
    this.run = run;
    this.clear();
    this.fill();
  }

  showFrame(frame) {
    this.pointAt(frame.position);
  }

  showState({ element }) {
    this.selected = element;
    this.fillElement();
  }

  /** Positions of the frames of the element that is filtered by. */
  showFramesOf({ element, name, positions }) {
    if (element !== this.element) return;
    this.withElement = new Set(positions);
    this.elementName = name;
    this.fill();
  }

  /** The element that was to be filtered by is not in the map. */
  showRefusal() {
    if (this.element !== null && !this.withElement) this.filter({ element: null });
  }

  pointAt(position) {
    for (const row of byId("frame-list").children) {
      const current = row.members?.includes(position) ?? false;
      row.setAttribute("aria-current", current);
      if (current) row.scrollIntoView({ block: "nearest" });
    }
  }

  step(by) {
    const now = this.groups.findIndex((group) => group.members.includes(this.page.wanted));
    const next = this.groups[Math.min(Math.max(now + by, 0), this.groups.length - 1)];
    if (next) this.page.go(next.position);
  }

  /** Filters that are left out stay as they are. */
  filter({ status = this.status, verdict = this.verdict, element = this.element }) {
    Object.assign(this, { status, verdict });
    if (element !== this.element) {
      this.element = element;
      this.withElement = null;
      if (element !== null) this.page.socket.send({ verb: "frames of", element });
    }
    this.fill();
    this.page.address.changed();
  }

  toggleElement() {
    this.filter({ element: this.element === null ? this.selected : null });
  }

  /** Frames that all filters let pass, but for one of them. */
  rows(except = "") {
    return this.run.frames.map((row, position) => ({ ...row, position })).filter((row) =>
      (except === "status" || !this.status || row.status === this.status)
      && (except === "verdict" || !this.verdict || row.verdict === this.verdict)
      && (!this.withElement || this.withElement.has(row.position)));
  }

  fill() {
    this.groups = grouped(this.rows()).sort((a, b) => badness(b) - badness(a) || a.position - b.position);
    const none = el("li", { class: "none dim", text: "No frame passes these filters." });
    byId("frame-list").replaceChildren(...(this.groups.length ? this.groups.map(listRow) : [none]));
    byId("filters").replaceChildren(this.chip(null), ...STATUSES.map((status) => this.chip(status)));
    this.fillVerdicts();
    this.fillElement();
    this.pointAt(this.page.wanted);
  }

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

  /** The most frequent first. */
  fillVerdicts() {
    const rows = this.rows("verdict");
    const counts = new Map();
    for (const { verdict } of this.run.frames) counts.set(verdict, 0);
    for (const { verdict } of rows) counts.set(verdict, counts.get(verdict) + 1);
    const option = (value, name, count) => el("option", { value, text: `${name}  ${count}` });
    const sorted = [...counts].sort((a, b) => b[1] - a[1] || a[0].localeCompare(b[0]));
    byId("verdict-filter").replaceChildren(option("", "Every verdict", rows.length), ...sorted.map(([name, count]) => option(name, name, count)));
    byId("verdict-filter").value = this.verdict ?? "";
    byId("verdict-filter").classList.toggle("on", this.verdict !== null);
  }

  fillElement() {
    const button = byId("element-filter");
    const isOn = this.element !== null;
    button.disabled = !isOn && (this.selected ?? null) === null;
    button.setAttribute("aria-pressed", isOn);
    const count = this.withElement ? ` ${this.withElement.size}` : "";
    button.textContent = isOn ? `${this.elementName ?? "…"}${count} ✕` : "Of the selected";
    button.title = isOn ? "Frames that see it, or whose answer rests on it. Click: all frames again" : "Only frames that see the selected element, or whose answer rests on it";
  }
}

function listRow(group) {
  const row = el("li", { class: "row", title: group.reason, data: { position: group.position } },
    statusMark(group.status),
    el("span", { class: "index", text: group.index }),
    el("span", { class: group.sureAndWrong ? "wrong" : "", text: errorText(group) }),
    el("span", { class: "verdict", text: group.verdict }),
    el("span", { class: "count", text: group.members.length > 1 ? `${group.members.length}×` : "" }));
  row.members = group.members;
  return row;
}
