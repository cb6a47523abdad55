/* Colours of the matrix, and its cells.
 *
 * On the screen they come from a bitmap with a pixel for each cell: 40,000 rectangles take ten times as
 * long. Figures get rectangles, which stay sharp at any size. */

import { cssColor } from "/static/canvas.js";

const LEVELS = 64; // of colour
const LOG_FLOOR = 3; // log colour goes down to 1e-3
const BRIGHT = 140; // of 255: dark ink is read on it

/** Colours of probabilities: linear, or by their logarithm. */
export class Ramp {
  constructor(isLog) {
    this.isLog = isLog;
    const stops = [0, 1, 2, 3].map((stop) => bands(cssColor(`--ramp-${stop}`)));
    this.levels = Array.from({ length: LEVELS }, (_, level) => mixed(stops, (3 * level) / (LEVELS - 1)));
    this.colors = this.levels.map((level) => `rgb(${level})`);
  }

  level(value) {
    const share = this.isLog ? 1 + Math.log10(Math.max(value, 1e-9)) / LOG_FLOOR : value;
    return Math.round((LEVELS - 1) * Math.min(1, Math.max(0, share)));
  }

  color(value) {
    return this.colors[this.level(value)];
  }

  /** What is read on a cell: dark on bright ones. */
  ink(value) {
    const [red, green, blue] = this.levels[this.level(value)];
    return 0.3 * red + 0.6 * green + 0.1 * blue > BRIGHT ? "#1B1C1E" : "#FFFFFF";
  }
}

/** Row and column as they are shown, one pixel for each cell. */
export function bitmapOf(model, ramp) {
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [model.n, model.m];
  if (!model.n || !model.m) return canvas;
  const context = canvas.getContext("2d");
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

/** Block by block, as there are gaps between them. */
export function drawBitmap(context, layout, bitmap) {
  context.imageSmoothingEnabled = false;
  eachBlock(layout, (across, down, ...place) =>
    context.drawImage(bitmap, across.first, down.first, across.count, down.count, ...place));
}

/** Blocks in the colour of 0, and rectangles where there is more. */
export function drawRectangles(context, model, layout, ramp) {
  context.fillStyle = ramp.color(0);
  eachBlock(layout, (across, down, ...place) => context.fillRect(...place));
  for (const i of model.rows) {
    for (const j of model.columns) {
      const level = ramp.level(model.probability[i][j]);
      if (!level) continue;
      context.fillStyle = ramp.colors[level];
      context.fillRect(layout.x(j), layout.y(i), layout.columns.size, layout.rows.size);
    }
  }
}

function eachBlock(layout, draw) {
  for (const across of layout.columns.blocks) {
    for (const down of layout.rows.blocks) {
      const [x, y] = [layout.left + across.start - layout.scroll.x, layout.top + down.start - layout.scroll.y];
      draw(across, down, x, y, across.end - across.start, down.end - down.start);
    }
  }
}

function bands(hex) {
  return [1, 3, 5].map((at) => Number.parseInt(hex.slice(at, at + 2), 16));
}

/** Bands at `place` along stops, as whole numbers. */
function mixed(stops, place) {
  const low = Math.min(stops.length - 2, Math.floor(place));
  return stops[low].map((one, band) => Math.round(one + (place - low) * (stops[low + 1][band] - one)));
}
