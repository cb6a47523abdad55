// @ts-check
/* The errors in A and B of all frames, on log scales. Frames without a pose have no error: they are
 * in a margin. */

import { cssColor } from "/static/canvas.js";
import { drawChange } from "./marks.js";

/** @typedef {import("/static/protocol").inspector.ComparedAnswer} ComparedAnswer */
/** @typedef {import("/static/protocol").inspector.ComparedFrame} ComparedFrame */
/** @typedef {import("/static/canvas.js").Point} Point */
/** @typedef {import("../panel.js").Context} Context */

const FONT = 'Inter, "Liberation Sans", Arial, sans-serif';
const LEFT = 54; // room for the scale of B
const BOTTOM = 36; // room for the scale of A
const EDGE = 12;
const MARGIN = 60; // for frames without a pose in A
const NO_POSE = 44; // width of the strip in it
const ABOVE = 32; // margin of frames without a pose in B
const GOOD_BELOW_M = 1;
const MIN_ERROR_M = 1e-4;
const ORDER = { same: 0, fixed: 1, broken: 2 }; // the last one is on top

/** Frames with an error, or without a pose, in each run. */
export class Scatter {
  /** @param {ComparedFrame[]} frames */
  constructor(frames) {
    this.frames = frames
      .filter(({ a, b }) => [a, b].every(({ status, error_m: errorM }) => errorM !== null || status === "cannot"))
      .sort((first, second) => ORDER[first.change] - ORDER[second.change]);
    const errors = this.frames.flatMap(({ a, b }) => [a.error_m ?? [], b.error_m ?? []].flat());
    /** @type {(error: number, round: (value: number) => number) => number} */
    const decade = (error, round) => round(Math.log10(Math.max(error, MIN_ERROR_M)) + (round === Math.ceil ? -1e-9 : 1e-9));
    this.low = errors.length ? decade(errors.reduce((a, b) => Math.min(a, b)), Math.floor) : -2;
    this.high = Math.max(this.low + 1, errors.length ? decade(errors.reduce((a, b) => Math.max(a, b)), Math.ceil) : 0);
    this.hasErrors = errors.length > 0;
    this.lacks = { a: this.frames.some(({ a }) => a.error_m === null), b: this.frames.some(({ b }) => b.error_m === null) };
  }

  /** The layout in an area of `width` x `height`.
   *
   * @param {number} width
   * @param {number} height
   */
  layout(width, height) {
    const right = width - EDGE - (this.lacks.a ? MARGIN : 0);
    const top = EDGE + (this.lacks.b ? ABOVE : 0);
    return new Layout(this, { left: LEFT, right, top, bottom: height - BOTTOM, width });
  }
}

/** @typedef {{left: number, right: number, top: number, bottom: number, width: number}} Box */

export class Layout {
  /**
   * @param {Scatter} scatter
   * @param {Box} box
   */
  constructor({ low, high }, { left, right, top, bottom, width }) {
    this.low = low;
    this.high = high;
    this.left = left;
    this.right = right;
    this.top = top;
    this.bottom = bottom;
    this.width = width;
  }

  /** Position of an error in A; in the margin for null.
   *
   * @param {number | null} error
   */
  x(error) {
    return error === null ? this.width - EDGE - NO_POSE / 2 : this.left + this.#share(error) * (this.right - this.left);
  }

  /** Position of an error in B; in the margin for null.
   *
   * @param {number | null} error
   */
  y(error) {
    return error === null ? EDGE : this.bottom - this.#share(error) * (this.bottom - this.top);
  }

  /**
   * @param {ComparedFrame} frame
   * @returns {Point}
   */
  at({ a, b }) {
    return [this.x(a.error_m), this.y(b.error_m)];
  }

  /** @param {number} error */
  #share(error) {
    return Math.max(0, (Math.log10(Math.max(error, MIN_ERROR_M)) - this.low) / (this.high - this.low));
  }
}

/**
 * @param {Context} context
 * @param {Scatter} scatter
 * @param {number} width
 * @param {number} height
 * @param {{current: ComparedFrame | null, pointed: ComparedFrame | null}} marked
 */
export function drawScatter(context, scatter, width, height, { current, pointed }) {
  const layout = scatter.layout(width, height);
  drawGrid(context, layout);
  drawMargins(context, scatter, layout);
  for (const frame of scatter.frames) drawChange(context, frame.change, ...layout.at(frame), frame.change === "same" ? 4 : 5);
  drawCounts(context, scatter, layout);
  for (const frame of new Set([current, pointed])) if (frame) drawNamed(context, layout, frame, frame === current);
}

/** Decades, the diagonal, and the 1 m lines between good and bad.
 *
 * @param {Context} context
 * @param {Layout} layout
 */
function drawGrid(context, layout) {
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

/**
 * @param {Context} context
 * @param {Scatter} scatter
 * @param {Layout} layout
 */
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

/** Frames without a pose in both runs share one mark, with their number beside it.
 *
 * @param {Context} context
 * @param {Scatter} scatter
 * @param {Layout} layout
 */
function drawCounts(context, { frames }, layout) {
  const both = frames.filter(({ a, b }) => a.error_m === null && b.error_m === null).length;
  if (both) write(context, `×${both}`, layout.x(null) + 7, layout.y(null));
}

/**
 * @param {Context} context
 * @param {Layout} layout
 * @param {ComparedFrame} frame
 * @param {boolean} isCurrent
 */
function drawNamed(context, layout, frame, isCurrent) {
  const [x, y] = layout.at(frame);
  context.beginPath();
  context.arc(x, y, 8, 0, 2 * Math.PI);
  context.strokeStyle = cssColor(isCurrent ? "--accent" : "--text");
  context.lineWidth = isCurrent ? 2.2 : 1.2;
  context.stroke();
  const onLeft = x > (layout.left + layout.right) / 2;
  const text = isCurrent ? `frame ${frame.index}` : `frame ${frame.index}: ${errorText(frame.a)} → ${errorText(frame.b)}`;
  write(context, text, x + (onLeft ? -13 : 13), y, { align: onLeft ? "right" : "left", color: "--text", weight: 600, cased: true });
}

/** @param {ComparedAnswer} answer */
const errorText = ({ status, error_m: errorM }) => (errorM === null ? status : `${errorM.toFixed(2)} m`);

/**
 * @param {Context} context
 * @param {Point} from
 * @param {Point} to
 * @param {string} color
 * @param {number[]} [dash]
 */
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

/**
 * @param {Context} context
 * @param {string} text
 * @param {number} x
 * @param {number} y
 * @param {{align?: CanvasTextAlign, color?: string, weight?: number, cased?: boolean}} [style]
 */
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
