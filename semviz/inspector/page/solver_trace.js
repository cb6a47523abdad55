/* The way of refinement: cost after each step, and how far the step went. */

import { el, fixed } from "/static/dom.js";
import { table, tableRow } from "./solver_table.js";

/** What is said above the table, and the table. */
export function traceTable({ cost, steps, moved }) {
  const said = moved === null ? "" : `From the best pose of the search it went ${length(moved.m)} and turned ${angle(moved.deg)}. `;
  const most = Math.max(...cost);
  const rows = cost.map((value, at) => tableRow([at || "start", costBar(value, most), ...stepCells(at, steps)]));
  return [
    el("p", { class: "dim", text: `${said}Cost: squared residuals over their covariance, robust, and the prior's.` }),
    table("trace", ["step", "cost", "moved", "turned"], rows),
  ];
}

function costBar(value, most) {
  const bar = el("i", {});
  bar.style.width = `${most > 0 ? (100 * value) / most : 0}%`;
  return el("span", { class: "cost" }, el("span", { class: "bar" }, bar), el("b", { text: fixed(value, 2) }));
}

function stepCells(at, steps) {
  if (at === 0) return ["", ""];
  const step = steps[at - 1];
  if (!step) return ["—", "—"];
  return step.m === 0 && step.deg === 0 ? ["not taken", ""] : [length(step.m), angle(step.deg)];
}

function length(metres) {
  if (metres >= 0.995) return `${fixed(metres, 2)} m`;
  return metres >= 0.00095 ? `${fixed(1000 * metres, metres < 0.01 ? 1 : 0)} mm` : `${fixed(1e6 * metres, metres < 1e-5 ? 1 : 0)} µm`;
}

function angle(degrees) {
  return degrees >= 0.0005 ? `${fixed(degrees, 3)}°` : "<0.001°";
}
