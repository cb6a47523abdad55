/* The legend on the image: what its lines, marks, and the residual colours and lengths mean. */

import { ON_IMAGE, RESIDUAL_LIMITS_PX, drawArrow, drawFalse, drawHandle, drawMissed } from "/static/glyphs.js";
import { endState } from "./image_model.js";

const WIDTH = 268;
const ROW = 18;
const SMALL = 180; // of a picture, in CSS pixels
const SEEN = "#EFE154";
const TITLES = {
  estimate: "residual, drawn 8×",
  truth: "residual, drawn 8×",
  pairs: "pairs, true length",
  error: "error, true length",
};

/** `scale` is how long one pixel of the image is drawn, in CSS pixels. On a small picture there is
 * room for lengths and colours only. */
export function drawLegend(context, height, sight, scale) {
  if (height < SMALL) {
    drawSmall(context, height, sight);
    return;
  }
  const marks = unknownEnds(sight);
  const failed = sight.missed.length + sight.false.length > 0;
  const tall = 44 + (marks.size ? ROW : 0) + (failed ? ROW : 0);
  const [x, y] = [8, height - tall - 8];
  drawGround(context, x, y, WIDTH, tall);
  write(context, TITLES[sight.mode], x + 8, y + 12);
  drawBar(context, x + 124, y + 12, sight.magnification * scale);
  drawScale(context, x + 8, y + 22);
  drawKey(context, x + 132, y + 30, sight);
  drawMarks(context, x + 8, y + 52, marks);
  if (failed) drawFailures(context, x + 8, y + tall - 10, sight);
}

function drawSmall(context, height, sight) {
  const [x, y] = [4, height - 28];
  drawGround(context, x, y, 152, 24);
  write(context, `${sight.magnification}×`, x + 6, y + 12);
  drawScale(context, x + 28, y + 3);
}

function drawGround(context, x, y, width, height) {
  context.fillStyle = "rgba(20,21,23,.82)";
  context.beginPath();
  context.roundRect(x, y, width, height, 4);
  context.fill();
}

function write(context, words, left, top, size = 11, align = "left") {
  context.font = `${size}px Inter, "Liberation Sans", Arial, sans-serif`;
  context.fillStyle = "#E6E7E9";
  context.textAlign = align;
  context.textBaseline = "middle";
  context.fillText(words, left, top);
}

function drawBar(context, x, y, pxLength) {
  const px = [50, 20, 10, 5, 2, 1, 0.5].find((size) => size * pxLength <= 60) ?? 0.2;
  const length = px * pxLength;
  context.fillStyle = "#FFFFFF";
  context.fillRect(x, y - 1, length, 2);
  context.fillRect(x, y - 4, 1.5, 8);
  context.fillRect(x + length - 1.5, y - 4, 1.5, 8);
  write(context, `${px} px`, x + length + 7, y);
}

function drawScale(context, x, y) {
  const step = 22;
  ON_IMAGE.residual.forEach((color, level) => {
    context.fillStyle = color;
    context.fillRect(x + level * step, y, step, 7);
  });
  [0, ...RESIDUAL_LIMITS_PX].forEach((limit, level) => write(context, String(limit), x + level * step, y + 14, 9.5, level ? "center" : "left"));
  write(context, "px", x + 5 * step, y + 14, 9.5, "right");
}

function drawKey(context, x, y, sight) {
  const entries = sight.observed.length ? [[SEEN, "seen"]] : [];
  entries.push([ON_IMAGE[sight.pose], sight.mode === "error" ? "estimate" : "map"]);
  if (sight.mode === "error") entries.push([ON_IMAGE.truth, "truth"]);
  if (sight.mode === "pairs" && sight.hasVectors) entries.push([ON_IMAGE.cannot, "outlier", [0, 6]]);
  let left = x;
  for (const [color, words, dashes = [0, 3, 6]] of entries) {
    context.fillStyle = color;
    for (const dash of dashes) context.fillRect(left + dash, y - 1, 3, 2);
    write(context, words, left + 12, y);
    left += 20 + context.measureText(words).width;
  }
}

/** How the ends of poles are drawn that are not known. */
function drawMarks(context, x, y, marks) {
  let left = x;
  if (marks.has("hidden")) {
    drawHandle(context, "bottom", left + 5, y, SEEN, false);
    write(context, "end hidden", left + 15, y);
    left += 90;
  }
  if (!marks.has("cut")) return;
  drawArrow(context, [left, y], [left + 13, y], SEEN, 2);
  write(context, "cut by the border", left + 20, y);
}

/** How it is drawn where detection failed. */
function drawFailures(context, x, y, { missed, false: invented }) {
  let left = x;
  if (missed.length) {
    drawMissed(context, [left + 5, y], [left + 9, y], 5);
    write(context, "missed or hidden", left + 20, y);
    left += 118;
  }
  if (!invented.length) return;
  drawFalse(context, left + 6, y, 4);
  write(context, "false: nothing real", left + 18, y);
}

function unknownEnds({ observed, size }) {
  const lines = observed.filter((one) => one.end);
  const states = lines.flatMap((one) => [endState(one.anchorKnown, one.anchor, size), endState(one.endKnown, one.end, size)]);
  return new Set(states.filter((state) => state !== "known"));
}
