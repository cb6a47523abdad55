/* What timelines have in common: the frame clock, the log scale of errors, frame numbers, the cursor. */

import { cssColor } from "/static/canvas.js";

const AXIS_PX = 34; // room for the scale on the left
const LEAST_M = 0.01;
const TOP_PX = 10;

/** Where frames and errors are, in CSS pixels. */
export class Clock {
  /** For `count` frames in `width`; errors up to `mostM` stand above `floor`. */
  constructor(width, floor, count, mostM) {
    Object.assign(this, { width, floor, count, left: AXIS_PX });
    this.slot = (width - AXIS_PX) / count;
    this.most = 10 ** Math.ceil(Math.log10(mostM) - 1e-9);
  }

  /** The middle of a frame's slot. */
  x(position) {
    return this.left + (position + 0.5) * this.slot;
  }

  positionAt(x) {
    return Math.min(this.count - 1, Math.max(0, Math.floor((x - this.left) / this.slot)));
  }

  y(error) {
    const share = Math.log10(Math.max(error, LEAST_M) / LEAST_M) / Math.log10(this.most / LEAST_M);
    return this.floor - share * (this.floor - TOP_PX);
  }
}

function write(context, text, x, y, align, baseline) {
  context.font = '9.5px Inter, "Liberation Sans", Arial, sans-serif';
  context.fillStyle = cssColor("--faint");
  context.textAlign = align;
  context.textBaseline = baseline;
  context.fillText(text, x, y);
}

/** Decades of the error. */
export function drawScale(context, clock) {
  for (let tick = LEAST_M; tick <= clock.most * 1.001; tick *= 10) {
    const at = Math.round(clock.y(tick)) + 0.5;
    context.fillStyle = cssColor("--hairline");
    context.fillRect(clock.left, at - 0.5, clock.width - clock.left, 1);
    write(context, `${Number(tick.toPrecision(1))}${tick >= 0.999 ? " m" : ""}`, clock.left - 6, at, "right", "middle");
  }
}

export function drawFrameNumbers(context, clock, frames, y) {
  const every = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000].find((step) => step * clock.slot > 56) ?? 2000;
  for (let position = 0; position < frames.length; position += every) {
    write(context, frames[position].index, clock.x(position), y, "center", "alphabetic");
  }
}

/** Where the page is, down to `bottom`. */
export function drawCursor(context, x, bottom) {
  context.fillStyle = cssColor("--text");
  context.fillRect(x - 0.75, 0, 1.5, bottom);
  context.beginPath();
  context.moveTo(x - 5, 0);
  context.lineTo(x + 5, 0);
  context.lineTo(x, 6);
  context.fill();
}
