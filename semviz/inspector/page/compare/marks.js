/* Marks of a frame that is fixed, broken or the same in run B: on a canvas, and in lists. */

import { cssColor } from "/static/canvas.js";
import { svg } from "/static/dom.js";

const TURN = { broken: 1, fixed: -1 };
const COLOR = { broken: "--cannot", fixed: "--ok", same: "--faint" };

/** A triangle down where it is broken, up where it is fixed; a small disc where it is the same. */
export function drawChange(context, change, x, y, radius) {
  const tip = TURN[change];
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

/** The same for lists and legends. */
export function changeMark(change) {
  const shape = {
    broken: () => svg("path", { d: "M1 2H11L6 10.5Z" }),
    fixed: () => svg("path", { d: "M1 10H11L6 1.5Z" }),
    same: () => svg("circle", { cx: 6, cy: 6, r: 2 }),
  }[change];
  return svg("svg", { class: `mark change-${change}`, viewBox: "0 0 12 12", "aria-label": change }, shape());
}
