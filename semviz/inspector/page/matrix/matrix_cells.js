// @ts-check
/* Colours and cells of the matrix.
 *
 * On the screen, cells are drawn from a bitmap with one pixel a cell: 40,000 rectangles take ten times
 * as long. Figures get rectangles, which stay sharp at any size. */

import { cssColor } from "/static/canvas.js";

/** @typedef {import("../panel.js").Context} Context */
/** @typedef {import("./matrix_layout.js").MatrixLayout} MatrixLayout */
/** @typedef {import("./matrix_model.js").MatrixModel} MatrixModel */

const LEVELS = 64; // number of colours
const LOG_FLOOR = 3; // decades of log colours: down to 1e-3
const BRIGHT = 140; // of 255: brighter cells get dark text

/** @typedef {MatrixLayout["columns"]["blocks"][number]} Block */
/** @typedef {(across: Block, down: Block, x: number, y: number, width: number, height: number) => void} DrawBlock */

/** Colours of probabilities: linear, or by their logarithm. */
export class Ramp {
  /** @param {boolean} isLog */
  constructor(isLog) {
    this.isLog = isLog;
    const stops = [0, 1, 2, 3].map((stop) => channels(cssColor(`--ramp-${stop}`)));
    this.levels = Array.from({ length: LEVELS }, (_, level) => mixed(stops, (3 * level) / (LEVELS - 1)));
    this.colors = this.levels.map((level) => `rgb(${level})`);
  }

  /** @param {number} value */
  level(value) {
    const share = this.isLog ? 1 + Math.log10(Math.max(value, 1e-9)) / LOG_FLOOR : value;
    return Math.round((LEVELS - 1) * Math.min(1, Math.max(0, share)));
  }

  /** @param {number} value */
  color(value) {
    return this.colors[this.level(value)];
  }

  /** The text colour on a cell.
   *
   * @param {number} value
   */
  ink(value) {
    const [red, green, blue] = this.levels[this.level(value)];
    return 0.3 * red + 0.6 * green + 0.1 * blue > BRIGHT ? "#1B1C1E" : "#FFFFFF";
  }
}

/** One pixel a cell, in the order shown.
 *
 * @param {MatrixModel} model
 * @param {Ramp} ramp
 */
export function bitmapOf(model, ramp) {
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [model.n, model.m];
  if (!model.n || !model.m) return canvas;
  const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  const image = context.createImageData(model.n, model.m);
  let at = 0;
  for (const i of model.rows) {
    for (const j of model.columns) {
      image.data.set(ramp.levels[ramp.level(model.probability[i][j])], at);
      image.data[at + 3] = 255;
      at += 4;
    }
  }
  context.putImageData(image, 0, 0);
  return canvas;
}

/** Draws block by block: there are gaps between them.
 *
 * @param {Context} context
 * @param {MatrixLayout} layout
 * @param {HTMLCanvasElement} bitmap
 */
export function drawBitmap(context, layout, bitmap) {
  context.imageSmoothingEnabled = false;
  eachBlock(layout, (across, down, x, y, width, height) =>
    context.drawImage(bitmap, across.first, down.first, across.count, down.count, x, y, width, height));
}

/** Draws blocks in the colour of 0, and rectangles for larger values.
 *
 * @param {Context} context
 * @param {MatrixModel} model
 * @param {MatrixLayout} layout
 * @param {Ramp} ramp
 */
export function drawRectangles(context, model, layout, ramp) {
  context.fillStyle = ramp.color(0);
  eachBlock(layout, (_across, _down, x, y, width, height) => context.fillRect(x, y, width, height));
  for (const i of model.rows) {
    for (const j of model.columns) {
      const level = ramp.level(model.probability[i][j]);
      if (!level) continue;
      context.fillStyle = ramp.colors[level];
      context.fillRect(layout.x(j), layout.y(i), layout.columns.size, layout.rows.size);
    }
  }
}

/**
 * @param {MatrixLayout} layout
 * @param {DrawBlock} draw
 */
function eachBlock(layout, draw) {
  for (const across of layout.columns.blocks) {
    for (const down of layout.rows.blocks) {
      const [x, y] = [layout.left + across.start - layout.scroll.x, layout.top + down.start - layout.scroll.y];
      draw(across, down, x, y, across.end - across.start, down.end - down.start);
    }
  }
}

/** @param {string} hex */
function channels(hex) {
  return [1, 3, 5].map((at) => Number.parseInt(hex.slice(at, at + 2), 16));
}

/** The colour at `place` along stops, as whole numbers.
 *
 * @param {number[][]} stops
 * @param {number} place
 */
function mixed(stops, place) {
  const low = Math.min(stops.length - 2, Math.floor(place));
  return stops[low].map((value, band) => Math.round(value + (place - low) * (stops[low + 1][band] - value)));
}
