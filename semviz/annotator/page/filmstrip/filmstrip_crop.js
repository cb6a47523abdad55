// @ts-check
// A cut-out of one image around a proposed mark, enlarged until an error of 2 px shows.
/** @import {annotator} from "/static/protocol" */
/** @import {Point} from "../values.js" */
import { drawHandle, drawLine, strokeCased } from "/static/glyphs.js";

const LEAST_ZOOM = 3, MOST_ZOOM = 8; // CSS pixels per image pixel, across a pole and around a sign
const AROUND = { pole: 1.3, sign: 2.4 }; // a crop shows so many times the element
const SIGN_M = 0.9;
const FOCAL_WIDTHS = 0.6; // focal length of a usual camera, in image widths
const END_SHARE = 0.25; // of a pole: a drag that begins nearer to an end moves that end alone

/** A mark in a crop.
 * @typedef {Pick<annotator.ProposalMark, "anchor" | "end" | "anchor_known" | "end_known">} CropMark */
/** The part of an image that a crop shows: its middle, px, and the zoom along both axes. A pole's crop is
 * enlarged across the pole more than along it.
 * @typedef {{middle: Point, zoom: Point, size: Point}} Crop */

/** The crop around a mark.
 *
 * @param {CropMark} mark
 * @param {number | null} depth m
 * @param {number} imageWidth px
 * @param {Point} size CSS pixels
 * @returns {Crop}
 */
export function cropOf({ anchor, end }, depth, imageWidth, size) {
  const [width, height] = size;
  if (!end) {
    const tall = (FOCAL_WIDTHS * imageWidth * SIGN_M) / Math.max(depth ?? 20, 1);
    const zoom = Math.min(MOST_ZOOM, Math.max(height / (AROUND.sign * tall), LEAST_ZOOM / 2));
    return { middle: anchor, zoom: [zoom, zoom], size };
  }
  const [du, dv] = [Math.abs(end[0] - anchor[0]), Math.abs(end[1] - anchor[1])];
  const down = Math.min(MOST_ZOOM, height / (AROUND.pole * Math.max(dv, 10)));
  const across = Math.min(Math.max(LEAST_ZOOM, down), width / (AROUND.pole * Math.max(du, 8)));
  return { middle: [(anchor[0] + end[0]) / 2, (anchor[1] + end[1]) / 2], zoom: [across, down], size };
}

/** Where a pixel is in a crop, CSS pixels.
 *
 * @param {Crop} crop
 * @param {Point} pixel
 * @returns {Point}
 */
export function inCrop({ middle, zoom, size }, pixel) {
  return [(pixel[0] - middle[0]) * zoom[0] + size[0] / 2, (pixel[1] - middle[1]) * zoom[1] + size[1] / 2];
}

/** The mark after a drag in a crop: an end of a pole if the drag began near it, else all of the mark.
 *
 * @param {Crop} crop
 * @param {CropMark} mark
 * @param {Point} from CSS pixels
 * @param {Point} to
 * @returns {CropMark}
 */
export function dragged(crop, mark, from, to) {
  const move = /** @type {Point} */ ([(to[0] - from[0]) / crop.zoom[0], (to[1] - from[1]) / crop.zoom[1]]);
  const moved = (/** @type {Point} */ [u, v]) => /** @type {Point} */ ([u + move[0], v + move[1]]);
  if (!mark.end) return { ...mark, anchor: moved(mark.anchor) };
  const [top, bottom] = [inCrop(crop, mark.anchor)[1], inCrop(crop, mark.end)[1]];
  const share = (from[1] - top) / (bottom - top || 1);
  return {
    ...mark,
    anchor: share < 1 - END_SHARE ? moved(mark.anchor) : mark.anchor,
    end: share > END_SHARE ? moved(mark.end) : mark.end,
  };
}

/** Draws an image's part with a mark.
 *
 * @param {CanvasRenderingContext2D} context
 * @param {ImageBitmap} bitmap
 * @param {Crop} crop
 * @param {CropMark} mark
 * @param {string} color
 * @param {boolean} isTaken else it is dashed
 */
export function drawCrop(context, bitmap, crop, mark, color, isTaken) {
  const { middle, zoom, size } = crop;
  const [wide, tall] = [size[0] / zoom[0], size[1] / zoom[1]];
  context.clearRect(0, 0, size[0], size[1]);
  context.imageSmoothingEnabled = zoom[0] < 2;
  context.drawImage(bitmap, middle[0] + 0.5 - wide / 2, middle[1] + 0.5 - tall / 2, wide, tall, 0, 0, size[0], size[1]);
  const anchor = inCrop(crop, mark.anchor);
  const dash = isTaken ? [] : [3, 3];
  if (!mark.end) {
    const [x, y] = anchor;
    context.beginPath();
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) { // open in the middle: the image shows there
      context.moveTo(x + 3 * dx, y + 3 * dy);
      context.lineTo(x + 11 * dx, y + 11 * dy);
    }
    strokeCased(context, color, 1.2, dash);
    return;
  }
  const end = inCrop(crop, mark.end);
  drawLine(context, anchor, end, color, 1, dash);
  drawHandle(context, "peak", ...anchor, color, mark.anchor_known);
  drawHandle(context, "bottom", ...end, color, mark.end_known);
}
