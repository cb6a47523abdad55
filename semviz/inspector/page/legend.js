/* The legend on the image: what the residual colours and lengths mean. */

import { ON_IMAGE, RESIDUAL_LIMITS_PX } from "/static/glyphs.js";

const WIDTH = 268;
const HEIGHT = 44;

/** `pxLength` is how long one pixel of residual is drawn, in CSS pixels. */
export function drawLegend(context, height, pxLength, magnification, mode) {
  const [x, y] = [8, height - HEIGHT - 8];
  if (y < 60) return; // a picture this small is not covered
  context.fillStyle = "rgba(20,21,23,.82)";
  context.beginPath();
  context.roundRect(x, y, WIDTH, HEIGHT, 4);
  context.fill();
  const text = (words, left, top, size = 11, align = "left") => {
    context.font = `${size}px Inter, "Liberation Sans", Arial, sans-serif`;
    context.fillStyle = "#E6E7E9";
    context.textAlign = align;
    context.textBaseline = "middle";
    context.fillText(words, left, top);
  };
  text(mode === "pairs" ? "offset, true length" : `residual, drawn ${magnification}×`, x + 8, y + 12);
  drawBar(context, x + 124, y + 12, mode === "pairs" ? pxLength / magnification : pxLength, text);
  drawScale(context, x + 8, y + 22, text);
  drawKey(context, x + 136, y + 30, mode, text);
}

function drawBar(context, x, y, pxLength, text) {
  const px = [50, 20, 10, 5, 2, 1, 0.5].find((size) => size * pxLength <= 60) ?? 0.2;
  const length = px * pxLength;
  context.fillStyle = "#FFFFFF";
  context.fillRect(x, y - 1, length, 2);
  context.fillRect(x, y - 4, 1.5, 8);
  context.fillRect(x + length - 1.5, y - 4, 1.5, 8);
  text(`${px} px`, x + length + 7, y);
}

function drawScale(context, x, y, text) {
  const step = 22;
  ON_IMAGE.residual.forEach((color, level) => {
    context.fillStyle = color;
    context.fillRect(x + level * step, y, step, 7);
  });
  [0, ...RESIDUAL_LIMITS_PX].forEach((limit, level) => text(limit, x + level * step, y + 14, 9.5, level ? "center" : "left"));
  text("px", x + 5 * step, y + 14, 9.5, "right");
}

function drawKey(context, x, y, mode, text) {
  const mapColor = mode === "truth" ? ON_IMAGE.truth : ON_IMAGE.estimate;
  const entries = [["#EFE154", "seen"], [mapColor, "map"]];
  if (mode === "pairs") entries.push([ON_IMAGE.cannot, "outlier"]);
  let left = x;
  for (const [color, words] of entries) {
    context.fillStyle = color;
    context.fillRect(left, y - 1, 9, 2);
    text(words, left + 12, y);
    left += 20 + context.measureText(words).width;
  }
}
