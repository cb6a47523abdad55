/* Shapes that say what something is: class glyphs (outlines), status marks (filled), cased lines.
 * Sizes are CSS pixels. On images the dark colours are used in both themes, with a casing. */

import { svg } from "./dom.js";

export const CASING = "rgba(10,11,13,.82)";
const CASING_PX = 1.1;

const CORNERS = { triangle: [3, -90], square: [4, -45], diamond: [4, -90], pentagon: [5, -90] };

function corners(shape, radius) {
  const [count, first] = CORNERS[shape] ?? CORNERS.square;
  const angles = Array.from({ length: count }, (_, i) => ((first + (360 * i) / count) * Math.PI) / 180);
  return angles.map((angle) => [radius * Math.cos(angle), radius * Math.sin(angle)]);
}

/** A class glyph around (x, y) as the current path: a sign's outline, or a pole with its cap. */
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

/** Strokes the current path with a dark casing under it. */
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

/** A sign's outline around (x, y). */
export function drawGlyph(context, shape, x, y, radius, color, width = 2, dash = []) {
  traceGlyph(context, shape, x, y, radius);
  strokeCased(context, color, width, dash);
}

/** A line from `a` to `b`, both [x, y]. */
export function drawLine(context, a, b, color, width = 2, dash = []) {
  context.beginPath();
  context.moveTo(a[0], a[1]);
  context.lineTo(b[0], b[1]);
  strokeCased(context, color, width, dash);
}

/** A line with an arrow head of 5 px at `b`. */
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

/** A pole's handles: square at the peak, circle at the bottom; hollow where an end is not known. */
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

/** A ring around a line, or around the point that `from` and `to` are, as the current path. */
export function traceRing(context, from, to, radius) {
  const angle = Math.atan2(to[1] - from[1], to[0] - from[0]);
  context.beginPath();
  context.arc(...from, radius, angle + Math.PI / 2, angle - Math.PI / 2);
  context.arc(...to, radius, angle - Math.PI / 2, angle + Math.PI / 2);
  context.closePath();
}

/** Around an element that a detector missed: a dashed ring. */
export function drawMissed(context, from, to, radius) {
  traceRing(context, from, to, radius);
  strokeCased(context, ON_IMAGE.cannot, 1.6, [5, 4]);
}

/** On a detection of nothing: a cross. */
export function drawFalse(context, x, y, radius) {
  for (const turn of [radius, -radius]) drawLine(context, [x - radius, y - turn], [x + radius, y + turn], ON_IMAGE.cannot, 2.2);
}

/** Text with a dark outline, for labels on images. */
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

/** A filled status mark on a canvas: disc, diamond or cross. */
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

/** A status mark for lists and buttons. */
export function statusMark(status) {
  const shape = {
    ok: () => svg("circle", { cx: 6, cy: 6, r: 4.2 }),
    ambiguous: () => svg("path", { d: "M6 .6 11.4 6 6 11.4 .6 6Z" }),
    cannot: () => svg("path", { d: "M2.6 1 6 4.4 9.4 1 11 2.6 7.6 6 11 9.4 9.4 11 6 7.6 2.6 11 1 9.4 4.4 6 1 2.6Z" }),
  }[status] ?? (() => svg("g"));
  return svg("svg", { class: `mark mark-${status}`, viewBox: "0 0 12 12", "aria-label": status }, shape());
}

/** A class glyph for lists and legends; `element` is a class with `shape` and `color`. */
export function classGlyph(element, color = element.color) {
  const icon = svg("svg", { class: "glyph", viewBox: "-8 -8 16 16", stroke: color });
  if (element.shape === "line") icon.append(svg("path", { d: "M0 6.5V-6M-3-6H3" }));
  else if (element.shape === "circle") icon.append(svg("circle", { r: 5.2 }));
  else icon.append(svg("polygon", { points: corners(element.shape, 6.2).join(" ") }));
  return icon;
}

/** Colours on images, which are dark in both themes. */
export const ON_IMAGE = {
  truth: "#FFFFFF",
  estimate: "#FF7A1A",
  cannot: "#F0532D",
  accent: "#4DABF7",
  residual: ["#4A78C9", "#8CC2E0", "#F2E6A8", "#F29A4A", "#E0402A"],
};

export const RESIDUAL_LIMITS_PX = [1, 2, 3, 5];

/** The colour of a residual; the limits are absolute and never adapt. */
export function residualColor(px, colors = ON_IMAGE.residual) {
  const level = RESIDUAL_LIMITS_PX.findIndex((limit) => px <= limit);
  return colors[level < 0 ? RESIDUAL_LIMITS_PX.length : level];
}
