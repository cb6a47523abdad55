/* The list of frames, worst first. */

import { byId, el, fixed } from "/static/dom.js";
import { statusMark } from "/static/glyphs.js";

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
  rows.forEach((row, position) => {
    const last = groups.at(-1);
    if (last && last.at(-1).verdict === row.verdict && last[0].status === row.status && row.verdict !== "healthy") {
      last.push({ ...row, position });
    } else {
      groups.push([{ ...row, position }]);
    }
  });
  const worst = (group) => group.reduce((a, b) => (badness(b) > badness(a) ? b : a));
  return groups.map((group) => ({ ...worst(group), members: group.map((row) => row.position) }));
}

export class FrameList {
  constructor(page) {
    this.page = page;
    this.filter = null;
    this.groups = [];
    byId("frame-list").addEventListener("click", (event) => {
      const row = event.target.closest("[data-position]");
      if (row) page.go(Number(row.dataset.position));
    });
  }

  showRun(run) {
    this.run = run;
    this.filter = null;
    this.fill();
  }

  showFrame(frame) {
    this.pointAt(frame.position);
  }

  pointAt(position) {
    for (const row of byId("frame-list").children) {
      const current = row.members.includes(position);
      row.setAttribute("aria-current", current);
      if (current) row.scrollIntoView({ block: "nearest" });
    }
  }

  step(by) {
    const now = this.groups.findIndex((group) => group.members.includes(this.page.wanted));
    const next = this.groups[Math.min(Math.max(now + by, 0), this.groups.length - 1)];
    if (next) this.page.go(next.position);
  }

  fill() {
    const kept = this.run.frames.map((row) => (this.filter && row.status !== this.filter ? null : row));
    const groups = grouped(this.run.frames).filter((group) => kept[group.position]);
    this.groups = groups.sort((a, b) => badness(b) - badness(a) || a.position - b.position);
    byId("frame-list").replaceChildren(...this.groups.map(listRow));
    byId("filters").replaceChildren(this.chip(null), ...STATUSES.map((status) => this.chip(status)));
    this.pointAt(this.page.wanted);
  }

  chip(status) {
    const rows = this.run.frames.filter((row) => !status || row.status === status);
    const chip = el("button", {
      class: "chip",
      title: status ?? "all frames",
      "aria-pressed": this.filter === status,
      onclick: () => { this.filter = status; this.fill(); },
    });
    chip.append(status ? statusMark(status) : el("span", { text: "All" }), el("span", { text: rows.length }));
    return chip;
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
