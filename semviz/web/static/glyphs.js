// @ts-check
/* Shapes: class glyphs (outlines), status marks (filled) and lines with a dark casing.
 * Sizes are CSS pixels. On images the dark colours are used in both themes, with a casing. */

import { svg } from "./dom.js";

export const CASING = "rgba(10,11,13,.82)";
const CASING_PX = 1.1;

/** @typedef {[number, number]} Point */
/** @typedef {"line" | "triangle" | "square" | "circle" | "diamond" | "pentagon"} Shape */
/** @typedef {"ok" | "ambiguous" | "cannot"} Status */
/** @typedef {CanvasRenderingContext2D} Context */

/** @type {Partial<Record<Shape, Point>>} number of corners, angle of the first one */
const CORNERS = { triangle: [3, -90], square: [4, -45], diamond: [4, -90], pentagon: [5, -90] };

/**
 * @param {Shape} shape
 * @param {number} radius
 * @returns {Point[]}
 */
function corners(shape, radius) {
  const [count, first] = CORNERS[shape] ?? [4, -45];
  const angles = Array.from({ length: count }, (_, i) => ((first + (360 * i) / count) * Math.PI) / 180);
  return angles.map((angle) => [radius * Math.cos(angle), radius * Math.sin(angle)]);
}

/** Traces a class glyph around (x, y) as the current path: a sign's outline, or a pole with its cap.
 *
 * @param {Context} context
 * @param {Shape} shape
 * @param {number} x
 * @param {number} y
 * @param {number} radius
 */
export function traceGlyph(context, shape, x, y, radius) {
  context.beginPath();
  if (shape === "circle") {
    context.arc(x, y, radius, 0, 2 * Math.PI);
  } else if (shape === "line") {
    context.moveTo(x, y + 1.25 * radius);
    context.lineTo(x, y - 1.15 * radius);
    context.moveTo(x - 0.6 * radius, y - 1.15 * radius);
    context.lineTo(x + 0.6 * radius, y - 1.15 * radius);
  } else {
    corners(shape, radius * 1.15).forEach(([dx, dy], i) =>
      i ? context.lineTo(x + dx, y + dy) : context.moveTo(x + dx, y + dy));
    context.closePath();
  }
}

/** Strokes the current path with a dark casing under it.
 *
 * @param {Context} context
 * @param {string} color
 * @param {number} width
 * @param {number[]} dash
 */
export function strokeCased(context, color, width, dash = []) {
  context.lineJoin = "round";
  context.setLineDash(dash);
  context.strokeStyle = CASING;
  context.lineWidth = width + 2 * CASING_PX;
  context.stroke();
  context.strokeStyle = color;
  context.lineWidth = width;
  context.stroke();
  context.setLineDash([]);
}

/** Draws a class glyph around (x, y).
 *
 * @param {Context} context
 * @param {Shape} shape
 * @param {number} x
 * @param {number} y
 * @param {number} radius
 * @param {string} color
 * @param {number} [width]
 * @param {number[]} [dash]
 */
export function drawGlyph(context, shape, x, y, radius, color, width = 2, dash = []) {
  traceGlyph(context, shape, x, y, radius);
  strokeCased(context, color, width, dash);
}

/** Draws a line from `a` to `b`.
 *
 * @param {Context} context
 * @param {Point} a
 * @param {Point} b
 * @param {string} color
 * @param {number} [width]
 * @param {number[]} [dash]
 */
export function drawLine(context, a, b, color, width = 2, dash = []) {
  context.beginPath();
  context.moveTo(a[0], a[1]);
  context.lineTo(b[0], b[1]);
  strokeCased(context, color, width, dash);
}

/** Draws a line with an arrow head of 5 px at `b`.
 *
 * @param {Context} context
 * @param {Point} a
 * @param {Point} b
 * @param {string} color
 * @param {number} [width]
 */
export function drawArrow(context, a, b, color, width = 2) {
  drawLine(context, a, b, color, width);
  const angle = Math.atan2(b[1] - a[1], b[0] - a[0]);
  context.beginPath();
  for (const turn of [2.6, 0, -2.6]) {
    const length = turn ? 6 : 0;
    context.lineTo(b[0] + length * Math.cos(angle + turn), b[1] + length * Math.sin(angle + turn));
  }
  strokeCased(context, color, width);
}

/** Draws the handle of a pole's end: square at the peak, circle at the bottom, hollow if unknown.
 *
 * @param {Context} context
 * @param {"peak" | "bottom"} kind
 * @param {number} x
 * @param {number} y
 * @param {string} color
 * @param {boolean} [known]
 */
export function drawHandle(context, kind, x, y, color, known = true) {
  context.beginPath();
  if (kind === "peak") context.rect(x - 3.5, y - 3.5, 7, 7);
  else context.arc(x, y, 3.5, 0, 2 * Math.PI);
  if (known) {
    context.fillStyle = color;
    context.fill();
    context.strokeStyle = CASING;
    context.lineWidth = CASING_PX;
    context.stroke();
  } else {
    strokeCased(context, color, 1.5, [2, 2]);
  }
}

/** Traces a ring around a line as the current path; around a point if `from` equals `to`.
 *
 * @param {Context} context
 * @param {Point} from
 * @param {Point} to
 * @param {number} radius
 */
export function traceRing(context, from, to, radius) {
  const angle = Math.atan2(to[1] - from[1], to[0] - from[0]);
  context.beginPath();
  context.arc(...from, radius, angle + Math.PI / 2, angle - Math.PI / 2);
  context.arc(...to, radius, angle - Math.PI / 2, angle + Math.PI / 2);
  context.closePath();
}

/** Draws a dashed ring around a missed detection.
 *
 * @param {Context} context
 * @param {Point} from
 * @param {Point} to
 * @param {number} radius
 */
export function drawMissed(context, from, to, radius) {
  traceRing(context, from, to, radius);
  strokeCased(context, ON_IMAGE.cannot, 1.6, [5, 4]);
}

/** Draws a cross on a false positive.
 *
 * @param {Context} context
 * @param {number} x
 * @param {number} y
 * @param {number} radius
 */
export function drawFalse(context, x, y, radius) {
  for (const turn of [radius, -radius]) drawLine(context, [x - radius, y - turn], [x + radius, y + turn], ON_IMAGE.cannot, 2.2);
}

/** Draws text with a dark outline, for labels on images.
 *
 * @param {Context} context
 * @param {string} text
 * @param {number} x
 * @param {number} y
 * @param {{color?: string, weight?: number, align?: CanvasTextAlign, size?: number}} [look]
 */
export function drawText(context, text, x, y, { color = "#FFFFFF", weight = 600, align = "left", size = 11 } = {}) {
  context.font = `${weight} ${size}px Inter, "Liberation Sans", Arial, sans-serif`;
  context.textAlign = align;
  context.textBaseline = "middle";
  context.lineJoin = "round";
  context.lineWidth = 3;
  context.strokeStyle = CASING;
  context.strokeText(text, x, y);
  context.fillStyle = color;
  context.fillText(text, x, y);
}

/** Draws a filled status mark: disc, diamond or cross.
 *
 * @param {Context} context
 * @param {string} status
 * @param {number} x
 * @param {number} y
 * @param {number} radius
 * @param {string} color
 */
export function drawMark(context, status, x, y, radius, color) {
  context.beginPath();
  if (status === "cannot") {
    context.moveTo(x - radius, y - radius);
    context.lineTo(x + radius, y + radius);
    context.moveTo(x + radius, y - radius);
    context.lineTo(x - radius, y + radius);
    context.strokeStyle = color;
    context.lineWidth = Math.max(1.2, radius * 0.6);
    context.stroke();
    return;
  }
  if (status === "ok") context.arc(x, y, radius, 0, 2 * Math.PI);
  else for (const [dx, dy] of [[0, -1.25], [1.25, 0], [0, 1.25], [-1.25, 0]])
    context.lineTo(x + dx * radius, y + dy * radius);
  context.fillStyle = color;
  context.fill();
}

/** A status mark for lists and buttons.
 *
 * @param {string} status
 */
export function statusMark(status) {
  return svg("svg", { class: `mark mark-${status}`, viewBox: "0 0 12 12", "aria-label": status }, markShape(status));
}

/** @param {string} status */
function markShape(status) {
  if (status === "ok") return svg("circle", { cx: 6, cy: 6, r: 4.2 });
  if (status === "ambiguous") return svg("path", { d: "M6 .6 11.4 6 6 11.4 .6 6Z" });
  if (status !== "cannot") return svg("g");
  return svg("path", { d: "M2.6 1 6 4.4 9.4 1 11 2.6 7.6 6 11 9.4 9.4 11 6 7.6 2.6 11 1 9.4 4.4 6 1 2.6Z" });
}

/** A class glyph for lists and legends.
 *
 * @param {{shape: Shape, color: string}} element
 * @param {string} color
 */
export function classGlyph(element, color = element.color) {
  const icon = svg("svg", { class: "glyph", viewBox: "-8 -8 16 16", stroke: color });
  if (element.shape === "line") icon.append(svg("path", { d: "M0 6.5V-6M-3-6H3" }));
  else if (element.shape === "circle") icon.append(svg("circle", { r: 5.2 }));
  else icon.append(svg("polygon", { points: corners(element.shape, 6.2).join(" ") }));
  return icon;
}

/** Colours on images, the same in both themes. */
export const ON_IMAGE = {
  truth: "#FFFFFF",
  estimate: "#FF7A1A",
  cannot: "#F0532D",
  accent: "#4DABF7",
  residual: ["#4A78C9", "#8CC2E0", "#F2E6A8", "#F29A4A", "#E0402A"],
};

export const RESIDUAL_LIMITS_PX = [1, 2, 3, 5];

/** The colour of a residual; the limits are absolute.
 *
 * @param {number} px
 * @param {string[]} colors
 */
export function residualColor(px, colors = ON_IMAGE.residual) {
  const level = RESIDUAL_LIMITS_PX.findIndex((limit) => px <= limit);
  return colors[level < 0 ? RESIDUAL_LIMITS_PX.length : level];
}
