// @ts-check
/* The table of elements and passes: who saw each, who should have, and the probability that it exists. */

import { byId, el, fill, svg } from "/static/dom.js";
import { VirtualList } from "/static/virtual_list.js";
import { cell, passName } from "./model.js";

/** @typedef {import("/static/protocol").inspector.OverTimeChange} OverTimeChange */
/** @typedef {import("/static/protocol").inspector.PassRow} PassRow */
/** @typedef {import("/static/protocol").inspector.PassView} PassView */
/** @typedef {import("./over_time.js").OverTime} OverTime */

const ROW_PX = 30;
const LINE = { width: 96, height: 22 };

/** @typedef {{row: PassRow, change: OverTimeChange | null}} TableRow without a change: a standing element beside one */

export class PassTable {
  /** @param {OverTime} view */
  constructor(view) {
    this.view = view;
    /** @type {TableRow[]} */
    this.rows = [];
    this.passes = 0;
    this.list = new VirtualList(byId("pass-rows"), ROW_PX, (index) => this.row(this.rows[index]));
  }

  /** Shows changes, and below the selected one the standing elements beside it.
   *
   * @param {OverTimeChange[]} changes
   * @param {PassView[]} passes
   */
  show(changes, passes) {
    this.passes = passes.length;
    byId("pass-table").style.setProperty("--passes", String(passes.length));
    const names = passes.map((pass) => el("span", { class: "pass", title: `${pass.run}: ${pass.sure} of ${pass.frames} frames are sure` }, passName(pass, passes)));
    fill(byId("pass-head"), [el("span", { class: "what", text: "pass" }), ...names, el("span", { class: "line", text: "exists, 0 to 1" }), el("span", { text: "now" })]);
    this.rows = changes.flatMap((change) => {
      const near = change.name === this.view.selected ? change.near.map((row) => ({ row, change: null })) : [];
      return [{ row: change, change }, ...near];
    });
    this.list.show(this.rows.length);
    this.list.mark(this.rows.findIndex(({ change }) => change !== null && change.name === this.view.selected));
  }

  /** @param {TableRow} row */
  row({ row, change }) {
    const cells = Array.from({ length: this.passes }, (_, at) => {
      const { state, text } = cell(change ?? row, at);
      return el("span", { class: `cell ${state}`, text, title: cellTitle(row, at) });
    });
    const now = row.probability[this.passes - 1] ?? 0;
    const select = change ? () => this.view.select(change.name) : undefined;
    return el("li", { class: change ? "pass-row" : "pass-row near", onclick: select },
      el("span", { class: "what" }, this.view.glyph(row.class_id), row.name),
      ...cells, probabilityLine(row.probability), el("b", { class: "now", text: (change?.existence ?? now).toFixed(2) }));
  }
}

/**
 * @param {PassRow} row
 * @param {number} at
 */
function cellTitle({ seen, chances }, at) {
  if (!chances[at]) return "Not in view in this pass";
  return `${seen[at]} of ${chances[at]} frames with a view of it detect it`;
}

/** The probability after each pass, as steps.
 *
 * @param {number[]} probability
 */
function probabilityLine(probability) {
  const { width, height } = LINE;
  const step = width / Math.max(probability.length, 1);
  const y = (/** @type {number} */ value) => 2 + (height - 4) * (1 - value);
  const path = probability.map((value, at) => `${at ? "V" : "M0 "}${y(value).toFixed(1)}H${((at + 1) * step).toFixed(1)}`).join("");
  const line = svg("svg", { class: "line", viewBox: `0 0 ${width} ${height}`, width, height, "aria-label": `${probability.join(", ")}` },
    svg("path", { class: "zero", d: `M0 ${height - 1}H${width}` }), svg("path", { class: "steps", d: path }));
  return line;
}
