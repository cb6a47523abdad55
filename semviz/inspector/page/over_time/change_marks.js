// @ts-check
/* The marks of changes: a filled triangle down (vanished) or up (new), an arrow (moved), a diamond (unsure). */

import { cssColor } from "/static/canvas.js";
import { svg } from "/static/dom.js";

/** @typedef {import("./model.js").Kind} Kind */
/** @typedef {import("../panel.js").Context} Context */

/** @type {Record<Kind, {color: string, path: string}>} paths in a box of 12 */
const MARKS = {
  vanished: { color: "--cannot", path: "M1 2.5h10L6 10.5z" },
  new: { color: "--ok", path: "M1 9.5h10L6 1.5z" },
  moved: { color: "--ambiguous", path: "M1 5h6V2l4.5 4L7 10V7H1z" },
  unsure: { color: "--ambiguous", path: "M6 .6 11.4 6 6 11.4.6 6z" },
};

/** The mark of a kind for lists and legends.
 *
 * @param {Kind} kind
 */
export function changeMark(kind) {
  return svg("svg", { class: `mark change-${kind}`, viewBox: "0 0 12 12", "aria-label": kind }, svg("path", { d: MARKS[kind].path }));
}

/** Draws the mark of a kind around (x, y).
 *
 * @param {Context} context
 * @param {Kind} kind
 * @param {number} x
 * @param {number} y
 */
export function drawChangeMark(context, kind, x, y) {
  context.fillStyle = cssColor(MARKS[kind].color);
  context.beginPath();
  const points = /** @type {Record<Kind, [number, number][]>} */ ({
    vanished: [[-5, -4], [5, -4], [0, 5]],
    new: [[-5, 4], [5, 4], [0, -5]],
    moved: [[-5, -1], [1, -1], [1, -4], [6, 0], [1, 4], [1, 1], [-5, 1]],
    unsure: [[0, -6], [6, 0], [0, 6], [-6, 0]],
  })[kind];
  points.forEach(([dx, dy], at) => (at ? context.lineTo(x + dx, y + dy) : context.moveTo(x + dx, y + dy)));
  context.closePath();
  context.fill();
}
