// @ts-check
/* The legend on the image: lines, marks, residual colours and lengths. */

import { ON_IMAGE, RESIDUAL_LIMITS_PX, drawArrow, drawFalse, drawHandle, drawMissed } from "/static/glyphs.js";
import { endState } from "./image_model.js";

/** @typedef {import("../panel.js").Context} Context */
/** @typedef {import("./image_model.js").EndState} EndState */
/** @typedef {import("./image_model.js").ImageModel} ImageModel */

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

const MARK = 20; // from the left of a mark to its text
const GAP = 12;
const KEY = 132; // from the left of the legend to the names of lines
const LINE = 12; // from the left of a line to its name
const TEXT = 11; // CSS pixels
const fontOf = (/** @type {number} */ size) => `${size}px Inter, "Liberation Sans", Arial, sans-serif`;

/** @typedef {{text: string, isShown: (model: ImageModel, ends: Set<EndState>) => boolean, draw: (context: Context, x: number, y: number) => void}} Mark */
/** @type {Mark[]} */
const MARKS = [
  {
    text: "end hidden",
    isShown: (_, ends) => ends.has("hidden"),
    draw: (context, x, y) => drawHandle(context, "bottom", x + 8, y, DETECTION_COLOR, false),
  },
  {
    text: "cut by the border",
    isShown: (_, ends) => ends.has("cut"),
    draw: (context, x, y) => drawArrow(context, [x, y], [x + 13, y], DETECTION_COLOR, 2),
  },
  {
    text: "missed or occluded",
    isShown: ({ missedDetections }) => missedDetections.length > 0,
    draw: (context, x, y) => drawMissed(context, [x + 5, y], [x + 9, y], 5),
  },
  {
    text: "false positive",
    isShown: ({ falsePositives }) => falsePositives.length > 0,
    draw: (context, x, y) => drawFalse(context, x + 8, y, 4),
  },
];

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
  const marks = marksIn(model);
  const total = 44 + (marks.length ? ROW : 0);
  const [x, y] = [8, height - total - 8];
  const names = linesIn(model).map(([, text]) => text);
  const keyWidth = KEY + rowWidth(context, names, LINE, 8);
  const marksWidth = 8 + rowWidth(context, marks.map(({ text }) => text), MARK, GAP);
  drawGround(context, x, y, Math.max(WIDTH, keyWidth, marksWidth), total);
  write(context, TITLES[model.mode], x + 8, y + 12);
  drawBar(context, x + 124, y + 12, model.magnification * scale);
  drawScale(context, x + 8, y + 22);
  drawKey(context, x + KEY, y + 30, model);
  drawMarks(context, x + 8, y + 52, marks);
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
function write(context, text, left, top, size = TEXT, align = "left") {
  context.font = fontOf(size);
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

/** The lines that the image shows: colour, name, and where dashes begin.
 *
 * @param {ImageModel} model
 * @returns {[string, string, number[]?][]}
 */
function linesIn(model) {
  /** @type {[string, string, number[]?][]} */
  const lines = model.observed.length ? [[DETECTION_COLOR, "detected"]] : [];
  lines.push([ON_IMAGE[model.pose], model.mode === "error" ? "estimate" : "map"]);
  if (model.mode === "error") lines.push([ON_IMAGE.truth, "truth"]);
  if (model.mode === "pairs" && model.hasVectors) lines.push([ON_IMAGE.cannot, "outlier", [0, 6]]);
  return lines;
}

/**
 * @param {Context} context
 * @param {number} x
 * @param {number} y
 * @param {ImageModel} model
 */
function drawKey(context, x, y, model) {
  let left = x;
  for (const [color, text, dashes = [0, 3, 6]] of linesIn(model)) {
    context.fillStyle = color;
    for (const dash of dashes) context.fillRect(left + dash, y - 1, 3, 2);
    write(context, text, left + LINE, y);
    left += LINE + 8 + context.measureText(text).width;
  }
}

/** The marks that the image shows beside lines: of unknown ends, missed detections, false positives.
 *
 * @param {ImageModel} model
 */
function marksIn(model) {
  const ends = unknownEnds(model);
  return MARKS.filter(({ isShown }) => isShown(model, ends));
}

/** The width of texts in a row, each with a mark before it and a gap after it.
 *
 * @param {Context} context
 * @param {string[]} texts
 * @param {number} mark
 * @param {number} gap
 */
function rowWidth(context, texts, mark, gap) {
  context.font = fontOf(TEXT);
  return texts.reduce((width, text) => width + mark + context.measureText(text).width + gap, 0);
}

/**
 * @param {Context} context
 * @param {number} x
 * @param {number} y
 * @param {Mark[]} marks
 */
function drawMarks(context, x, y, marks) {
  let left = x;
  for (const { draw, text } of marks) {
    draw(context, left, y);
    write(context, text, left + MARK, y);
    left += MARK + context.measureText(text).width + GAP;
  }
}

/** @param {ImageModel} model */
function unknownEnds({ observed, size }) {
  const states = observed.flatMap((detection) => (detection.end ? [endState(detection.anchor_known, detection.anchor, size), endState(detection.end_known, detection.end, size)] : []));
  return new Set(states.filter((state) => state !== "known"));
}
