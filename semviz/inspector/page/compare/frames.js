// @ts-check
/* The frames that are broken, fixed or the same in B, worst first, with the results of A and B. */

import { byId, el, fixed } from "/static/dom.js";
import { statusMark } from "/static/glyphs.js";
import { severity, goToClicked } from "../frames.js";
import { Tabs } from "../tabs.js";

/** @typedef {import("/static/protocol").inspector.ComparedAnswer} ComparedAnswer */
/** @typedef {import("/static/protocol").inspector.ComparedFrame} ComparedFrame */
/** @typedef {import("/static/protocol").inspector.ComparisonView} ComparisonView */
/** @typedef {import("/static/protocol").inspector.FrameView} FrameView */
/** @typedef {import("../main.js").Page} Page */

/** The run whose error ranks a frame.
 *
 * @type {Record<Change, "a" | "b">} */
const RANKED_BY = { broken: "b", fixed: "a", same: "b" };
const NONE = {
  broken: "No frame is good in A and bad in B.",
  fixed: "No frame is bad in A and good in B.",
  same: "All frames are fixed or broken.",
};
/** @type {Change[]} */
const CHANGES = ["broken", "fixed", "same"];

/** @typedef {ComparedFrame["change"]} Change */

export class ChangedFrames {
  /** @param {Page} page */
  constructor(page) {
    this.page = page;
    /** @type {ComparisonView | null} */
    this.comparison = null;
    /** @type {ComparedFrame[]} */
    this.rows = [];
    /** @type {Element | null} */
    this.current = null;
    this.tabs = new Tabs(byId("changes"), () => this.fill());
    page.socket.on("comparison", ({ comparison }) => this.showComparison(comparison));
    byId("change-list").addEventListener("click", (event) => goToClicked(page, event));
  }

  /** @param {ComparisonView} comparison */
  showComparison(comparison) {
    this.comparison = comparison;
    for (const change of CHANGES) byId(`count-${change}`).textContent = String(this.of(change).length);
    const alone = comparison.only_base.length + comparison.only_other.length;
    byId("tab-alone").hidden = !alone;
    byId("count-alone").textContent = String(alone);
    const first = CHANGES.find((change) => this.of(change).length) ?? "same";
    this.tabs.show(first);
  }

  /** @param {ComparedFrame["change"]} change */
  of(change) {
    return (this.comparison?.frames ?? []).filter((frame) => frame.change === change);
  }

  /** @param {FrameView} frame */
  showFrame(frame) {
    this.pointAt(frame.position);
  }

  /** @param {number} position */
  pointAt(position) {
    this.current?.setAttribute("aria-current", "false");
    this.current = byId("change-list").querySelector(`[data-position="${position}"]`);
    this.current?.setAttribute("aria-current", "true");
    this.current?.scrollIntoView({ block: "nearest" });
  }

  /** @param {number} by */
  step(by) {
    if (!this.rows.length) return;
    const now = this.rows.findIndex((frame) => frame.position === this.page.store.target);
    const next = this.rows[Math.min(Math.max(now + by, 0), this.rows.length - 1)];
    this.page.go(next.position);
  }

  fill() {
    const change = CHANGES.find((name) => name === this.tabs.shown);
    byId("change-head").hidden = !change;
    if (!change) {
      this.rows = [];
      byId("change-list").replaceChildren(...(this.comparison ? this.alone(this.comparison) : []));
      return;
    }
    const side = RANKED_BY[change];
    this.rows = this.of(change).sort((a, b) => severity(b[side]) - severity(a[side]) || a.position - b.position);
    byId("change-list").replaceChildren(...this.rows.map(listRow));
    if (!this.rows.length) byId("change-list").append(el("li", { class: "none dim", text: NONE[change] }));
    this.pointAt(this.page.store.target);
  }

  /** Frames of only one run; those of B can be opened.
   *
   * @param {ComparisonView} comparison
   */
  alone({ only_base: onlyBase, only_other: onlyOther }) {
    const inBase = onlyBase.map((index) =>
      el("li", { class: "row one-sided", title: "Run B does not have this frame" }, el("span", { class: "index", text: index }), el("span", { class: "dim", text: "only in A" })));
    const positions = new Map(this.page.store.run.frames.map((row, position) => [row.index, position]));
    const inOther = onlyOther.map((index) =>
      el("li", { class: "row one-sided", data: { position: positions.get(index) } }, el("span", { class: "index", text: index }), el("span", { class: "dim", text: "only in B" })));
    return [...inBase, ...inOther];
  }
}

/** @param {ComparedFrame} frame */
function listRow({ index, position, a, b }) {
  return el("li", { class: "row", data: { position } },
    el("span", { class: "index", text: index }), ...side(a), ...side(b));
}

/** @param {ComparedAnswer} answer */
function side(answer) {
  const text = answer.status === "cannot" ? "none" : answer.error_m === null ? "—" : `${fixed(answer.error_m, 2)} m`;
  const title = answer.overconfident ? "ok, but over 1 m off" : answer.status;
  return [statusMark(answer.status), el("span", { class: answer.overconfident ? "wrong" : "", title, text })];
}
