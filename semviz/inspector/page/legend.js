// @ts-check
/* The legend on the image: lines, marks, residual colours and lengths. */

import { ON_IMAGE, RESIDUAL_LIMITS_PX, drawArrow, drawFalse, drawHandle, drawMissed } from "/static/glyphs.js";
import { endState } from "./image/image_model.js";

/** @typedef {import("./panel.js").Context} Context */
/** @typedef {import("./image/image_model.js").EndState} EndState */
/** @typedef {import("./image/image_model.js").ImageModel} ImageModel */

const WIDTH = 268;
const ROW = 18;
const SMALL = 180; // height of a small image, CSS pixels
const DETECTION_COLOR = "#EFE154";
const TITLES = {
  estimate: "residual, drawn 8×",
  truth: "residual, drawn 8×",
  pairs: "pairs, true length",
  error: "error, true length",
};

/** `scale` is the size of an image pixel in CSS pixels. A small image has room for lengths and
 * colours only.
 *
 * @param {Context} context
 * @param {number} height
 * @param {ImageModel} model
 * @param {number} scale
 */
export function drawLegend(context, height, model, scale) {
  if (height < SMALL) {
    drawSmall(context, height, model);
    return;
  }
  const marks = unknownEnds(model);
  const failed = model.missedDetections.length + model.falsePositives.length > 0;
  const total = 44 + (marks.size ? ROW : 0) + (failed ? ROW : 0);
  const [x, y] = [8, height - total - 8];
  drawGround(context, x, y, WIDTH, total);
  write(context, TITLES[model.mode], x + 8, y + 12);
  drawBar(context, x + 124, y + 12, model.magnification * scale);
  drawScale(context, x + 8, y + 22);
  drawKey(context, x + 132, y + 30, model);
  drawMarks(context, x + 8, y + 52, marks);
  if (failed) drawFailures(context, x + 8, y + total - 10, model);
}

/**
 * @param {Context} context
 * @param {number} height
 * @param {ImageModel} model
 */
function drawSmall(context, height, model) {
  const [x, y] = [4, height - 28];
  drawGround(context, x, y, 152, 24);
  write(context, `${model.magnification}×`, x + 6, y + 12);
  drawScale(context, x + 28, y + 3);
}

/**
 * @param {Context} context
 * @param {number} x
 * @param {number} y
 * @param {number} width
 * @param {number} height
 */
function drawGround(context, x, y, width, height) {
  context.fillStyle = "rgba(20,21,23,.82)";
  context.beginPath();
  context.roundRect(x, y, width, height, 4);
  context.fill();
}

/**
 * @param {Context} context
 * @param {string} text
 * @param {number} left
 * @param {number} top
 * @param {number} [size]
 * @param {CanvasTextAlign} [align]
 */
function write(context, text, left, top, size = 11, align = "left") {
  context.font = `${size}px Inter, "Liberation Sans", Arial, sans-serif`;
  context.fillStyle = "#E6E7E9";
  context.textAlign = align;
  context.textBaseline = "middle";
  context.fillText(text, left, top);
}

/**
 * @param {Context} context
 * @param {number} x
 * @param {number} y
 * @param {number} pxLength
 */
function drawBar(context, x, y, pxLength) {
  const px = [50, 20, 10, 5, 2, 1, 0.5].find((size) => size * pxLength <= 60) ?? 0.2;
  const length = px * pxLength;
  context.fillStyle = "#FFFFFF";
  context.fillRect(x, y - 1, length, 2);
  context.fillRect(x, y - 4, 1.5, 8);
  context.fillRect(x + length - 1.5, y - 4, 1.5, 8);
  write(context, `${px} px`, x + length + 7, y);
}

/**
 * @param {Context} context
 * @param {number} x
 * @param {number} y
 */
function drawScale(context, x, y) {
  const step = 22;
  ON_IMAGE.residual.forEach((color, level) => {
    context.fillStyle = color;
    context.fillRect(x + level * step, y, step, 7);
  });
  [0, ...RESIDUAL_LIMITS_PX].forEach((limit, level) => write(context, String(limit), x + level * step, y + 14, 9.5, level ? "center" : "left"));
  write(context, "px", x + 5 * step, y + 14, 9.5, "right");
}

/**
 * @param {Context} context
 * @param {number} x
 * @param {number} y
 * @param {ImageModel} model
 */
function drawKey(context, x, y, model) {
  /** @type {[string, string, number[]?][]} */
  const entries = model.observed.length ? [[DETECTION_COLOR, "detected"]] : [];
  entries.push([ON_IMAGE[model.pose], model.mode === "error" ? "estimate" : "map"]);
  if (model.mode === "error") entries.push([ON_IMAGE.truth, "truth"]);
  if (model.mode === "pairs" && model.hasVectors) entries.push([ON_IMAGE.cannot, "outlier", [0, 6]]);
  let left = x;
  for (const [color, text, dashes = [0, 3, 6]] of entries) {
    context.fillStyle = color;
    for (const dash of dashes) context.fillRect(left + dash, y - 1, 3, 2);
    write(context, text, left + 12, y);
    left += 20 + context.measureText(text).width;
  }
}

/** The marks of unknown ends of poles.
 *
 * @param {Context} context
 * @param {number} x
 * @param {number} y
 * @param {Set<EndState>} marks
 */
function drawMarks(context, x, y, marks) {
  let left = x;
  if (marks.has("hidden")) {
    drawHandle(context, "bottom", left + 5, y, DETECTION_COLOR, false);
    write(context, "end hidden", left + 15, y);
    left += 90;
  }
  if (!marks.has("cut")) return;
  drawArrow(context, [left, y], [left + 13, y], DETECTION_COLOR, 2);
  write(context, "cut by the border", left + 20, y);
}

/** The marks of missed detections and false positives.
 *
 * @param {Context} context
 * @param {number} x
 * @param {number} y
 * @param {ImageModel} model
 */
function drawFailures(context, x, y, { missedDetections, falsePositives }) {
  let left = x;
  if (missedDetections.length) {
    drawMissed(context, [left + 5, y], [left + 9, y], 5);
    write(context, "missed or occluded", left + 20, y);
    left += 130;
  }
  if (!falsePositives.length) return;
  drawFalse(context, left + 6, y, 4);
  write(context, "false positive", left + 18, y);
}

/** @param {ImageModel} model */
function unknownEnds({ observed, size }) {
  const states = observed.flatMap((detection) => (detection.end ? [endState(detection.anchor_known, detection.anchor, size), endState(detection.end_known, detection.end, size)] : []));
  return new Set(states.filter((state) => state !== "known"));
}
