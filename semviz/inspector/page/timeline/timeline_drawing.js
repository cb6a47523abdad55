// @ts-check
/* Drawing shared by timelines: the frame axis, the log scale of errors, frame numbers, the cursor. */

import { cssColor } from "/static/canvas.js";

/** @typedef {import("../panel.js").Context} Context */

const AXIS_PX = 34; // room for the scale on the left
const MIN_ERROR_M = 0.01;
const TOP_PX = 10;

/** Positions of frames and errors, in CSS pixels. */
export class TimelineAxes {
  /** For `count` frames in `width`, and errors up to `maxErrorM` above `floor`.
   *
   * @param {number} width
   * @param {number} floor
   * @param {number} count
   * @param {number} maxErrorM
   */
  constructor(width, floor, count, maxErrorM) {
    this.width = width;
    this.floor = floor;
    this.count = count;
    this.left = AXIS_PX;
    this.slot = (width - AXIS_PX) / count;
    this.topM = 10 ** Math.ceil(Math.log10(maxErrorM) - 1e-9);
  }

  /** The middle of a frame's slot.
   *
   * @param {number} position
   */
  x(position) {
    return this.left + (position + 0.5) * this.slot;
  }

  /** @param {number} x */
  positionAt(x) {
    return Math.min(this.count - 1, Math.max(0, Math.floor((x - this.left) / this.slot)));
  }

  /** @param {number} error */
  y(error) {
    const share = Math.log10(Math.max(error, MIN_ERROR_M) / MIN_ERROR_M) / Math.log10(this.topM / MIN_ERROR_M);
    return this.floor - share * (this.floor - TOP_PX);
  }
}

/**
 * @param {Context} context
 * @param {string | number} text
 * @param {number} x
 * @param {number} y
 * @param {CanvasTextAlign} align
 * @param {CanvasTextBaseline} baseline
 */
function write(context, text, x, y, align, baseline) {
  context.font = '9.5px Inter, "Liberation Sans", Arial, sans-serif';
  context.fillStyle = cssColor("--faint");
  context.textAlign = align;
  context.textBaseline = baseline;
  context.fillText(String(text), x, y);
}

/** Decades of the error.
 *
 * @param {Context} context
 * @param {TimelineAxes} axes
 */
export function drawScale(context, axes) {
  for (let tick = MIN_ERROR_M; tick <= axes.topM * 1.001; tick *= 10) {
    const at = Math.round(axes.y(tick)) + 0.5;
    context.fillStyle = cssColor("--hairline");
    context.fillRect(axes.left, at - 0.5, axes.width - axes.left, 1);
    write(context, `${Number(tick.toPrecision(1))}${tick >= 0.999 ? " m" : ""}`, axes.left - 6, at, "right", "middle");
  }
}

/**
 * @param {Context} context
 * @param {TimelineAxes} axes
 * @param {{index: number}[]} frames
 * @param {number} y
 */
export function drawFrameNumbers(context, axes, frames, y) {
  const step = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000, 20_000].find((count) => count * axes.slot > 56) ?? 50_000;
  for (let position = 0; position < frames.length; position += step) {
    write(context, frames[position].index, axes.x(position), y, "center", "alphabetic");
  }
}

/** The mark of the current frame, down to `bottom`.
 *
 * @param {Context} context
 * @param {number} x
 * @param {number} bottom
 */
export function drawCursor(context, x, bottom) {
  context.fillStyle = cssColor("--text");
  context.fillRect(x - 0.75, 0, 1.5, bottom);
  context.beginPath();
  context.moveTo(x - 5, 0);
  context.lineTo(x + 5, 0);
  context.lineTo(x, 6);
  context.fill();
}
