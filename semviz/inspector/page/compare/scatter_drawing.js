/* The error of every frame in A against that in B, on log scales. Frames without a pose have no
 * error: they stand in a margin of their own. */

import { cssColor } from "/static/canvas.js";
import { drawChange } from "./marks.js";

const FONT = 'Inter, "Liberation Sans", Arial, sans-serif';
const LEFT = 54; // room for the scale of B
const BOTTOM = 36; // and of A
const EDGE = 12;
const MARGIN = 60; // for frames without a pose in A
const NO_POSE = 44; // of it, the strip itself
const ABOVE = 32; // and in B
const GOOD_BELOW_M = 1;
const LEAST_M = 1e-4;
const ORDER = { same: 0, fixed: 1, broken: 2 }; // the last drawn is on top

/** What there is to draw: frames with an error or, in A or B, no pose. */
export class Scatter {
  constructor(frames) {
    this.frames = frames
      .filter(({ a, b }) => [a, b].every(({ status, errorM }) => errorM !== null || status === "cannot"))
      .sort((one, two) => ORDER[one.change] - ORDER[two.change]);
    const errors = this.frames.flatMap(({ a, b }) => [a.errorM, b.errorM]).filter((one) => one !== null);
    const decade = (error, round) => round(Math.log10(Math.max(error, LEAST_M)) + (round === Math.ceil ? -1e-9 : 1e-9));
    this.low = errors.length ? decade(errors.reduce((a, b) => Math.min(a, b)), Math.floor) : -2;
    this.high = Math.max(this.low + 1, errors.length ? decade(errors.reduce((a, b) => Math.max(a, b)), Math.ceil) : 0);
    this.hasErrors = errors.length > 0;
    this.lacks = { a: this.frames.some(({ a }) => a.errorM === null), b: this.frames.some(({ b }) => b.errorM === null) };
  }

  /** Where things are in an area of `width` x `height`. */
  layout(width, height) {
    const right = width - EDGE - (this.lacks.a ? MARGIN : 0);
    const top = EDGE + (this.lacks.b ? ABOVE : 0);
    return new Layout(this, { left: LEFT, right, top, bottom: height - BOTTOM, width });
  }
}

class Layout {
  constructor({ low, high }, box) {
    Object.assign(this, { low, high }, box);
  }

  /** Pixels of an error in A; in the margin for none. */
  x(error) {
    return error === null ? this.width - EDGE - NO_POSE / 2 : this.left + this.#share(error) * (this.right - this.left);
  }

  /** Pixels of an error in B. */
  y(error) {
    return error === null ? EDGE : this.bottom - this.#share(error) * (this.bottom - this.top);
  }

  at({ a, b }) {
    return [this.x(a.errorM), this.y(b.errorM)];
  }

  #share(error) {
    return Math.max(0, (Math.log10(Math.max(error, LEAST_M)) - this.low) / (this.high - this.low));
  }
}

/** `current` and `pointed` are frames of the scatter or null; `names` are those of A and B. */
export function drawScatter(context, scatter, width, height, { current, pointed }) {
  const layout = scatter.layout(width, height);
  drawGround(context, layout);
  drawMargins(context, scatter, layout);
  for (const frame of scatter.frames) drawChange(context, frame.change, ...layout.at(frame), frame.change === "same" ? 4 : 5);
  drawCounts(context, scatter, layout);
  for (const frame of new Set([current, pointed])) if (frame) drawNamed(context, layout, frame, frame === current);
}

/** Decades, the diagonal, and the lines at one metre between good and not. */
function drawGround(context, layout) {
  const { left, right, top, bottom, low, high } = layout;
  for (let power = low; power <= high; power += 1) {
    const text = `${Number((10 ** power).toPrecision(1))}`;
    const [x, y] = [layout.x(10 ** power), layout.y(10 ** power)];
    line(context, [x, top], [x, bottom], "--hairline");
    line(context, [left, y], [right, y], "--hairline");
    write(context, text, x, bottom + 11, { align: "center" });
    write(context, text, left - 7, y, { align: "right" });
  }
  line(context, [left, bottom], [right, top], "--border", [4, 4]);
  if (low < 0 && high > 0) {
    line(context, [layout.x(GOOD_BELOW_M), top], [layout.x(GOOD_BELOW_M), bottom], "--faint", [2, 3]);
    line(context, [left, layout.y(GOOD_BELOW_M)], [right, layout.y(GOOD_BELOW_M)], "--faint", [2, 3]);
  }
  write(context, "error in A, m", right, bottom + 26, { align: "right" });
  write(context, "B, m", left - 7, (layout.y(10 ** high) + layout.y(10 ** (high - 1))) / 2, { align: "right" });
}

function drawMargins(context, { lacks }, { left, top, bottom, width }) {
  if (lacks.a) {
    const x = width - EDGE - NO_POSE;
    line(context, [x, EDGE / 2], [x, bottom], "--hairline");
    write(context, "no pose", width - EDGE - NO_POSE / 2, bottom + 11, { align: "center" });
    write(context, "in A", width - EDGE - NO_POSE / 2, bottom + 24, { align: "center" });
  }
  if (lacks.b) {
    const y = top - 0.4 * ABOVE;
    line(context, [left, y], [width - EDGE, y], "--hairline");
    write(context, "no pose", left - 7, EDGE - 4, { align: "right" });
    write(context, "in B", left - 7, EDGE + 9, { align: "right" });
  }
}

/** Frames without a pose in both lie on one point: how many there are stands beside it. */
function drawCounts(context, { frames }, layout) {
  const both = frames.filter(({ a, b }) => a.errorM === null && b.errorM === null).length;
  if (both) write(context, `×${both}`, layout.x(null) + 7, layout.y(null));
}

function drawNamed(context, layout, frame, isCurrent) {
  const [x, y] = layout.at(frame);
  context.beginPath();
  context.arc(x, y, 8, 0, 2 * Math.PI);
  context.strokeStyle = cssColor(isCurrent ? "--accent" : "--text");
  context.lineWidth = isCurrent ? 2.2 : 1.2;
  context.stroke();
  const onLeft = x > (layout.left + layout.right) / 2;
  const text = isCurrent ? `frame ${frame.index}` : `frame ${frame.index}: ${told(frame.a)} → ${told(frame.b)}`;
  write(context, text, x + (onLeft ? -13 : 13), y, { align: onLeft ? "right" : "left", color: "--text", weight: 600, cased: true });
}

const told = ({ status, errorM }) => (errorM === null ? status : `${errorM.toFixed(2)} m`);

function line(context, from, to, color, dash = []) {
  context.beginPath();
  context.moveTo(...from);
  context.lineTo(...to);
  context.setLineDash(dash);
  context.strokeStyle = cssColor(color);
  context.lineWidth = 1;
  context.stroke();
  context.setLineDash([]);
}

function write(context, text, x, y, { align = "left", color = "--faint", weight = 400, cased = false } = {}) {
  context.font = `${weight} 11px ${FONT}`;
  context.textAlign = align;
  context.textBaseline = "middle";
  if (cased) {
    context.lineJoin = "round";
    context.lineWidth = 3;
    context.strokeStyle = cssColor("--panel");
    context.strokeText(text, x, y);
  }
  context.fillStyle = cssColor(color);
  context.fillText(text, x, y);
}
