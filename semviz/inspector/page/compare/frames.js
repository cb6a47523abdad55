/* The frames that are broken, fixed or the same in B, worst first, with what A and B made of them. */

import { byId, el, fixed } from "/static/dom.js";
import { statusMark } from "/static/glyphs.js";
import { badness } from "../frames.js";
import { Tabs } from "../tabs.js";

const JUDGED = { broken: "b", fixed: "a", same: "b" }; // whose error says how bad it is
const NONE = {
  broken: "No frame that was good in A is not in B.",
  fixed: "No frame that was not good in A is in B.",
  same: "Every frame is fixed or broken.",
};

export class ChangedFrames {
  constructor(page) {
    this.page = page;
    this.comparison = { frames: [] };
    this.rows = [];
    this.tabs = new Tabs(byId("changes"), () => this.fill());
    byId("change-list").addEventListener("click", (event) => {
      const row = event.target.closest("[data-position]");
      if (row) page.go(Number(row.dataset.position));
    });
  }

  showComparison(comparison) {
    this.comparison = comparison;
    for (const change of ["broken", "fixed", "same"]) byId(`count-${change}`).textContent = this.of(change).length;
    const alone = comparison.onlyBase.length + comparison.onlyOther.length;
    byId("tab-alone").hidden = !alone;
    byId("count-alone").textContent = alone;
    const first = ["broken", "fixed", "same"].find((change) => this.of(change).length) ?? "same";
    this.tabs.show(first);
  }

  of(change) {
    return this.comparison.frames.filter((one) => one.change === change);
  }

  showFrame(frame) {
    this.pointAt(frame.position);
  }

  pointAt(position) {
    this.current?.setAttribute("aria-current", false);
    this.current = byId("change-list").querySelector(`[data-position="${position}"]`);
    this.current?.setAttribute("aria-current", true);
    this.current?.scrollIntoView({ block: "nearest" });
  }

  step(by) {
    if (!this.rows.length) return;
    const now = this.rows.findIndex((one) => one.position === this.page.wanted);
    const next = this.rows[Math.min(Math.max(now + by, 0), this.rows.length - 1)];
    this.page.go(next.position);
  }

  fill() {
    const change = this.tabs.shown;
    byId("change-head").hidden = change === "alone";
    if (change === "alone") {
      this.rows = [];
      byId("change-list").replaceChildren(...this.alone());
      return;
    }
    const judged = JUDGED[change];
    this.rows = this.of(change).sort((one, two) => badness(two[judged]) - badness(one[judged]) || one.position - two.position);
    byId("change-list").replaceChildren(...this.rows.map(listRow));
    if (!this.rows.length) byId("change-list").append(el("li", { class: "none dim", text: NONE[change] }));
    this.pointAt(this.page.wanted);
  }

  /** Frames that only one of the runs has: those of B can be opened. */
  alone() {
    const { onlyBase, onlyOther } = this.comparison;
    const inBase = onlyBase.map((index) =>
      el("li", { class: "row one-sided", title: "Run B, which is open, does not have it" }, el("span", { class: "index", text: index }), el("span", { class: "dim", text: "only in A" })));
    const positions = new Map(this.page.run.frames.map((row, position) => [row.index, position]));
    const inOther = onlyOther.map((index) =>
      el("li", { class: "row one-sided", data: { position: positions.get(index) } }, el("span", { class: "index", text: index }), el("span", { class: "dim", text: "only in B" })));
    return [...inBase, ...inOther];
  }
}

function listRow({ index, position, a, b }) {
  return el("li", { class: "row", data: { position } },
    el("span", { class: "index", text: index }), ...side(a), ...side(b));
}

function side(answer) {
  const text = answer.status === "cannot" ? "none" : answer.errorM === null ? "—" : `${fixed(answer.errorM, 2)} m`;
  const title = answer.sureAndWrong ? "ok, and yet over 1 m off" : answer.status;
  return [statusMark(answer.status), el("span", { class: answer.sureAndWrong ? "wrong" : "", title, text })];
}
