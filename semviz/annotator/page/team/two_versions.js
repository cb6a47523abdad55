// @ts-check
// Draws two versions of a label beside each other, at one zoom.
/** @import {annotator} from "/static/protocol" */
/** @import {ElementClass} from "../values.js" */
/** @import {Shape} from "/static/glyphs.js" */
import { drawGlyph, drawHandle, drawLine } from "/static/glyphs.js";

const LEAST_PX = 60; // of an image, the least that a picture shows of its height
const AROUND = 1.5;

/** @typedef {Pick<annotator.ObservationView, "anchor" | "end" | "anchor_known" | "end_known">} Mark */
/** A label, or null where one of both has none, in the look of a class.
 * @typedef {{mark: Mark | null, kind: ElementClass}} Version */

/** Draws each of two versions on its half of a canvas, with the other one faintly.
 *
 * @param {CanvasRenderingContext2D} context
 * @param {number} width
 * @param {number} height
 * @param {ImageBitmap} bitmap
 * @param {[Version, Version]} versions
 */
export function drawVersions(context, width, height, bitmap, versions) {
  const half = width / 2 - 2;
  const points = versions.flatMap(({ mark }) => (mark ? [mark.anchor, ...mark.end ? [mark.end] : []] : []));
  const [lowU, lowV] = [0, 1].map((axis) => Math.min(...points.map((point) => point[axis])));
  const [highU, highV] = [0, 1].map((axis) => Math.max(...points.map((point) => point[axis])));
  const tall = Math.max(LEAST_PX, AROUND * (highV - lowV), AROUND * (highU - lowU) * height / half);
  const scale = height / tall;
  const [u, v] = [(lowU + highU) / 2, (lowV + highV) / 2];
  const screen = (/** @type {[number, number]} */ [x, y]) => /** @type {[number, number]} */ ([(x - u) * scale + half / 2, (y - v) * scale + height / 2]);
  for (const [at, { mark, kind }] of versions.entries()) {
    context.save();
    context.beginPath();
    context.rect(at * (width / 2 + 2), 0, half, height);
    context.clip();
    context.translate(at * (width / 2 + 2), 0);
    context.drawImage(bitmap, u + 0.5 - half / scale / 2, v + 0.5 - tall / 2, half / scale, tall, 0, 0, half, height);
    const other = versions[1 - at].mark;
    if (other) drawVersion(context, other, screen, "#FFFFFF80", "");
    if (mark) drawVersion(context, mark, screen, kind.color, kind.shape);
    context.restore();
  }
}

/** Draws a label; without a `shape` faintly, as the other's.
 *
 * @param {CanvasRenderingContext2D} context
 * @param {Mark} mark
 * @param {(pixel: [number, number]) => [number, number]} screen
 * @param {string} color
 * @param {Shape | ""} shape
 */
function drawVersion(context, mark, screen, color, shape) {
  const [x, y] = screen(mark.anchor);
  if (!mark.end) {
    if (shape) drawGlyph(context, shape, x, y, 6, color);
    else drawHandle(context, "bottom", x, y, color, false);
    return;
  }
  const end = screen(mark.end);
  drawLine(context, [x, y], end, color, shape ? 2 : 1, shape ? [] : [4, 3]);
  if (!shape) return;
  drawHandle(context, "peak", x, y, color, mark.anchor_known);
  drawHandle(context, "bottom", ...end, color, mark.end_known);
}

/** What differs between two labels, in words; empty for nothing.
 *
 * @param {Mark} mine
 * @param {Mark} theirs
 */
export function differs(mine, theirs) {
  const away = (/** @type {[number, number]} */ [x, y], /** @type {[number, number]} */ [u, v], /** @type {string} */ what) => {
    const px = Math.hypot(x - u, y - v);
    const where = Math.abs(y - v) > Math.abs(x - u) ? (y > v ? "lower" : "higher") : x > u ? "to the right" : "to the left";
    return px < 0.05 ? [] : [`${what} ${px.toFixed(1)} px ${where}`];
  };
  const known = (/** @type {boolean} */ is, /** @type {boolean} */ was, /** @type {string} */ what, /** @type {string} */ no) =>
    is === was ? [] : [`${what} ${is ? "visible" : no}`];
  return [
    ...away(mine.anchor, theirs.anchor, mine.end ? "peak" : "middle"),
    ...mine.end && theirs.end ? away(mine.end, theirs.end, "bottom") : [],
    ...known(mine.anchor_known, theirs.anchor_known, "peak", "cut off"),
    ...mine.end ? known(mine.end_known, theirs.end_known, "bottom", "hidden") : [],
  ].join(", ");
}
