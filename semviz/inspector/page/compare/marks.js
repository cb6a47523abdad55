// @ts-check
/* Marks of a frame that is fixed, broken or the same in run B: on a canvas, and in lists. */

import { cssColor } from "/static/canvas.js";
import { svg } from "/static/dom.js";

/** @typedef {import("/static/protocol").inspector.ComparedFrame} ComparedFrame */
/** @typedef {import("../panel.js").Context} Context */

const TIP = { broken: 1, fixed: -1, same: 0 }; // down or up
const COLOR = { broken: "--cannot", fixed: "--ok", same: "--faint" };

/** @typedef {ComparedFrame["change"]} Change */

/** A triangle down for broken, up for fixed; a small disc for the same.
 *
 * @param {Context} context
 * @param {Change} change
 * @param {number} x
 * @param {number} y
 * @param {number} radius
 */
export function drawChange(context, change, x, y, radius) {
  const tip = TIP[change];
  context.beginPath();
  if (tip) {
    context.moveTo(x, y + tip * radius);
    context.lineTo(x + radius, y - tip * radius * 0.8);
    context.lineTo(x - radius, y - tip * radius * 0.8);
    context.closePath();
  } else {
    context.arc(x, y, radius / 2, 0, 2 * Math.PI);
  }
  context.fillStyle = cssColor(COLOR[change]);
  context.fill();
}

/** The mark for lists and legends.
 *
 * @param {Change} change
 */
export function changeMark(change) {
  const shape = {
    broken: () => svg("path", { d: "M1 2H11L6 10.5Z" }),
    fixed: () => svg("path", { d: "M1 10H11L6 1.5Z" }),
    same: () => svg("circle", { cx: 6, cy: 6, r: 2 }),
  }[change];
  return svg("svg", { class: `mark change-${change}`, viewBox: "0 0 12 12", "aria-label": change }, shape());
}
