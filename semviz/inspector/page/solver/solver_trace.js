// @ts-check
/* The iterations of the refinement: cost after each step, and its length. */

import { el, fixed } from "/static/dom.js";
import { table, tableRow } from "./solver_table.js";

/** @typedef {import("/static/protocol").inspector.PoseDifference} PoseDifference */
/** @typedef {import("/static/protocol").inspector.TraceView} TraceView */

/** The text above the table, and the table.
 *
 * @param {TraceView} trace
 */
export function traceTable({ cost, steps, moved }) {
  const movement = moved === null ? "" : `The pose moved ${length(moved.m)} and turned ${angle(moved.deg)} from the best pose of the search. `;
  const maxCost = Math.max(...cost.map((value) => value ?? 0));
  const rows = cost.map((value, at) => tableRow([at || "start", costBar(value, maxCost), ...stepCells(at, steps)]));
  return [
    el("p", { class: "dim", text: `${movement}Cost: robust squared residuals, weighted by their covariance, plus the prior.` }),
    table("trace", ["step", "cost", "moved", "turned"], rows),
  ];
}

/**
 * @param {number | null} value
 * @param {number} maxCost
 */
function costBar(value, maxCost) {
  const bar = el("i", {});
  bar.style.width = `${maxCost > 0 ? (100 * (value ?? 0)) / maxCost : 0}%`;
  return el("span", { class: "cost" }, el("span", { class: "bar" }, bar), el("b", { text: fixed(value, 2) }));
}

/**
 * @param {number} at
 * @param {PoseDifference[]} steps
 */
function stepCells(at, steps) {
  if (at === 0) return ["", ""];
  const step = steps[at - 1];
  if (!step) return ["—", "—"];
  return step.m === 0 && step.deg === 0 ? ["rejected", ""] : [length(step.m), angle(step.deg)];
}

/** @param {number} metres */
function length(metres) {
  if (metres >= 0.995) return `${fixed(metres, 2)} m`;
  return metres >= 0.00095 ? `${fixed(1000 * metres, metres < 0.01 ? 1 : 0)} mm` : `${fixed(1e6 * metres, metres < 1e-5 ? 1 : 0)} µm`;
}

/** @param {number} degrees */
function angle(degrees) {
  return degrees >= 0.0005 ? `${fixed(degrees, 3)}°` : "<0.001°";
}
