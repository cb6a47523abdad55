// @ts-check
/* Draws the matrix of a frame on a canvas or into an SVG. */

import { cssColor } from "/static/canvas.js";
import { traceGlyph } from "/static/glyphs.js";
import { drawBitmap, drawRectangles } from "./matrix_cells.js";
import { BIN, ENTROPY, SUM } from "./matrix_layout.js";

/** @typedef {import("../panel.js").ClassMap} ClassMap */
/** @typedef {import("../panel.js").Context} Context */
/** @typedef {import("./matrix_model.js").Mark} Mark */
/** @typedef {import("./matrix_layout.js").MatrixLayout} MatrixLayout */
/** @typedef {import("./matrix_model.js").MatrixModel} MatrixModel */
/** @typedef {import("./matrix_layout.js").MatrixPlace} MatrixPlace */
/** @typedef {import("./matrix_cells.js").Ramp} Ramp */

const NAME = 11; // width of a line of text
const GLYPH = 13; // width of a class glyph
const MAX_BITS = 4; // a full bar: 16 equally likely candidates
const SUM_TOLERANCE = 0.01; // a sum that differs more from 1 is marked
const TICKS_FROM = 14; // minimum height of rows with ticks
const FONT = '11px Inter, "Liberation Sans", Arial, sans-serif';

/** @typedef {{observed: number | null, mapped: number | null}} MatrixSelection */
/** Colours, selection and hovered cell; `bitmap` is null for figures.
 *
 * @typedef {object} MatrixStyle
 * @property {Ramp} ramp
 * @property {ClassMap} classes
 * @property {HTMLCanvasElement | null} bitmap
 * @property {MatrixSelection} selected
 * @property {MatrixPlace | null} hovered
 */

/** Draws the whole matrix.
 *
 * @param {Context} context
 * @param {MatrixModel} model
 * @param {MatrixLayout} layout
 * @param {MatrixStyle} look
 */
export function drawMatrix(context, model, layout, { ramp, classes, bitmap, selected, hovered }) {
  const rows = layout.rows.visible(layout.scroll.y);
  const columns = layout.columns.visible(layout.scroll.x);
  clipped(context, layout, "both", () => {
    if (bitmap) drawBitmap(context, layout, bitmap);
    else drawRectangles(context, model, layout, ramp);
    drawSeams(context, layout, rows, columns);
    if (layout.hasValues) drawValues(context, model, layout, ramp, rows, columns);
    drawMarks(context, model, layout, ramp, rows, columns);
    if (hovered?.of === "cell") outline(context, layout, hovered, "--text", 1);
  });
  drawBinFrames(context, layout);
  clipped(context, layout, "rows", () => drawRowEnds(context, model, layout, ramp, rows, selected));
  clipped(context, layout, "columns", () => drawColumnEnds(context, model, layout, ramp, columns, selected));
  drawHeadings(context, layout);
  clipped(context, layout, "columns", () => drawGlyphs(context, layout, classes));
  drawSelection(context, layout, selected);
}

/* Blocks */

/** Clips what scrolls to its zone: the blocks, all rows, or all columns.
 *
 * @param {Context} context
 * @param {MatrixLayout} layout
 * @param {"both" | "rows" | "columns"} zone
 * @param {() => void} draw
 */
function clipped(context, layout, zone, draw) {
  const { left, top, end } = layout;
  const [x, right] = zone === "rows" ? [0, layout.needs.width] : [left - 2, end.x + 2];
  const [y, bottom] = zone === "columns" ? [0, layout.needs.height] : [top - 2, end.y + 2];
  context.save();
  context.beginPath();
  context.rect(x, y, right - x, bottom - y);
  context.clip();
  draw();
  context.restore();
}

/** Lines between cells, if the cells are large enough.
 *
 * @param {Context} context
 * @param {MatrixLayout} layout
 * @param {number[]} rows
 * @param {number[]} columns
 */
function drawSeams(context, layout, rows, columns) {
  context.fillStyle = cssColor("--hairline");
  const [across, down] = [layout.columns, layout.rows];
  if (down.size >= 8) for (const i of rows) context.fillRect(layout.left, layout.y(i) + down.size - 1, across.shown, 1);
  if (across.size >= 6) for (const j of columns) context.fillRect(layout.x(j) + across.size - 1, layout.top, 1, down.shown);
}

/**
 * @param {Context} context
 * @param {MatrixModel} model
 * @param {MatrixLayout} layout
 * @param {Ramp} ramp
 * @param {number[]} rows
 * @param {number[]} columns
 */
function drawValues(context, model, layout, ramp, rows, columns) {
  for (const i of rows) {
    for (const j of columns) {
      const value = model.probability[i][j];
      if (value < 0.005) continue;
      write(context, value.toFixed(2).replace(/^0/, ""), layout.x(j) + layout.columns.size - 4, layout.y(i) + 8, ramp.ink(value), "right");
    }
  }
}

/* Marks: a ring is the true pair, a dot an inlier, a cross an outlier; one to three ticks are the
 * likeliest of a row. */

/**
 * @param {Context} context
 * @param {MatrixModel} model
 * @param {MatrixLayout} layout
 * @param {Ramp} ramp
 * @param {number[]} rows
 * @param {number[]} columns
 */
function drawMarks(context, model, layout, ramp, rows, columns) {
  const shown = new Set(columns);
  const size = Math.min(4, layout.columns.size / 2, layout.rows.size / 2);
  for (const i of rows) {
    for (const { mapped: j, place, isTrue, fit } of model.marks.get(i) ?? []) {
      if (!shown.has(j)) continue;
      const ink = ramp.ink(model.probability[i][j]);
      const [x, y] = [layout.x(j) + layout.columns.size / 2, layout.y(i) + layout.rows.size / 2];
      if (place) drawTicks(context, layout, i, j, place, ink);
      if (isTrue) drawRing(context, x, y, size, ink);
      if (fit) drawDot(context, x, y, isTrue ? size / 2.5 : size / 1.6, ink);
      else if (fit === false) drawCross(context, x, y, size * 0.8, ink);
    }
  }
}

/**
 * @param {Context} context
 * @param {number} x
 * @param {number} y
 * @param {number} radius
 * @param {string} color
 */
function drawRing(context, x, y, radius, color) {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.lineWidth = radius > 3 ? 1.4 : 1;
  context.strokeStyle = color;
  context.stroke();
}

/**
 * @param {Context} context
 * @param {number} x
 * @param {number} y
 * @param {number} radius
 * @param {string} color
 */
function drawDot(context, x, y, radius, color) {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
  context.fillStyle = color;
  context.fill();
}

/**
 * @param {Context} context
 * @param {number} x
 * @param {number} y
 * @param {number} size
 * @param {string} color
 */
function drawCross(context, x, y, size, color) {
  context.beginPath();
  for (const way of [1, -1]) {
    context.moveTo(x - size, y - way * size);
    context.lineTo(x + size, y + way * size);
  }
  context.lineWidth = 1.4;
  context.strokeStyle = color;
  context.stroke();
}

/**
 * @param {Context} context
 * @param {MatrixLayout} layout
 * @param {number} i
 * @param {number} j
 * @param {number} count
 * @param {string} ink
 */
function drawTicks(context, layout, i, j, count, ink) {
  const { size } = layout.columns;
  if (layout.rows.size < TICKS_FROM) return;
  context.fillStyle = ink;
  const width = Math.min(7, size - 2.5);
  for (let tick = 0; tick < count; tick += 1) {
    context.fillRect(layout.x(j) + (size - 1 - width) / 2, layout.y(i) + layout.rows.size - 4 - 2 * tick, width, 1);
  }
}

/* Beside and below */

/** Frames of the dustbins, which have the panel's colour at 0.
 *
 * @param {Context} context
 * @param {MatrixLayout} layout
 */
function drawBinFrames(context, { left, top, end, bin }) {
  const color = cssColor("--hairline");
  fill(context, color, bin.x - 1, top - 1, BIN + 2, end.y - top + 1);
  fill(context, color, left - 1, bin.y - 1, end.x - left + 1, BIN + 2);
}

/**
 * @param {Context} context
 * @param {MatrixModel} model
 * @param {MatrixLayout} layout
 * @param {Ramp} ramp
 * @param {number[]} rows
 * @param {MatrixSelection} selected
 */
function drawRowEnds(context, model, layout, ramp, rows, selected) {
  const height = layout.rows.size;
  let free = -Infinity; // names of thin rows would overlap
  for (const i of rows) {
    const [y, isSelected] = [layout.y(i), i === selected.observed];
    fill(context, ramp.color(model.at(i, null)), layout.bin.x, y, BIN, Math.max(1, height - 1));
    const middle = y + height / 2;
    const thin = Math.min(6, height - 2);
    drawBar(context, layout.entropy.x, middle - thin / 2, ENTROPY.across * shareOf(model.row[i].entropy), thin);
    if (middle < free && !isSelected) continue;
    free = middle + NAME;
    write(context, `#${i}`, layout.left - 5, middle, isSelected ? cssColor("--text") : cssColor("--dim"), "right");
    const { sum } = model.row[i];
    write(context, sum.toFixed(2), layout.sum.x, middle, colorOfSum(sum), "left");
  }
}

/**
 * @param {Context} context
 * @param {MatrixModel} model
 * @param {MatrixLayout} layout
 * @param {Ramp} ramp
 * @param {number[]} columns
 * @param {MatrixSelection} selected
 */
function drawColumnEnds(context, model, layout, ramp, columns, selected) {
  const width = layout.columns.size;
  const seam = width >= 6 ? 1 : 0;
  for (const j of columns) {
    const x = layout.x(j);
    const { sum, entropy } = model.column[j];
    fill(context, ramp.color(model.at(null, j)), x, layout.bin.y, width - seam, BIN);
    const bar = SUM.down * Math.min(1, sum);
    fill(context, colorOfSum(sum), x + seam, layout.sum.y + SUM.down - bar, width - 2 * seam - 0.5, bar);
    drawBar(context, x + seam, layout.entropy.y, width - 2 * seam - 0.5, ENTROPY.down * shareOf(entropy));
  }
  if (layout.hasColumnNames) drawColumnNames(context, model, layout, columns, selected);
}

/** Upright, as many as fit: first the selected one, then those of pairs.
 *
 * @param {Context} context
 * @param {MatrixModel} model
 * @param {MatrixLayout} layout
 * @param {number[]} columns
 * @param {MatrixSelection} selected
 */
function drawColumnNames(context, model, layout, columns, selected) {
  /** @param {(mark: Mark) => boolean} of */
  const marked = (of) => new Set([...model.marks.values()].flat().filter(of).map((mark) => mark.mapped));
  const [paired, known] = [marked(({ fit }) => fit !== undefined), marked(({ isTrue }) => isTrue)];
  /** @param {number} j */
  const weight = (j) => 4 * Number(j === selected.mapped) + 2 * Number(paired.has(j)) + Number(known.has(j));
  /** @type {number[]} */
  const centers = [];
  for (const j of [...columns].sort((a, b) => weight(b) - weight(a))) {
    const x = layout.x(j) + layout.columns.size / 2;
    if (centers.some((other) => Math.abs(other - x) < NAME)) continue;
    centers.push(x);
    context.save();
    context.translate(x, layout.top - 4);
    context.rotate(-Math.PI / 2);
    write(context, model.mapped[j].name, 0, 0, cssColor(j === selected.mapped ? "--text" : "--dim"), "left");
    context.restore();
  }
}

/** A glyph above each block of columns, shifted if blocks are narrower than glyphs.
 *
 * @param {Context} context
 * @param {MatrixLayout} layout
 * @param {ClassMap} classes
 */
function drawGlyphs(context, layout, classes) {
  let free = -Infinity;
  for (const { class: id, start, end } of layout.columns.blocks) {
    const middle = layout.left + (start + end) / 2 - layout.scroll.x;
    const x = Math.max(middle, free);
    free = x + GLYPH;
    const kind = classes.get(id);
    if (!kind) continue;
    traceGlyph(context, kind.shape, x, layout.glyphY, 4.6);
    context.strokeStyle = kind.color;
    context.lineWidth = 1.6;
    context.stroke();
  }
}

/**
 * @param {Context} context
 * @param {MatrixLayout} layout
 */
function drawHeadings(context, { bin, sum, entropy, left, glyphY }) {
  const color = cssColor("--dim");
  write(context, "∅", bin.x + BIN / 2, glyphY, color, "center");
  write(context, "Σ", sum.x + 2, glyphY, color, "left");
  write(context, "H", entropy.x, glyphY, color, "left");
  write(context, "∅", left - 5, bin.y + BIN / 2, color, "right");
  write(context, "Σ", left - 5, sum.y + SUM.down / 2, color, "right");
  write(context, "H", left - 5, entropy.y + ENTROPY.down / 2, color, "right");
}

/**
 * @param {Context} context
 * @param {MatrixLayout} layout
 * @param {MatrixSelection} selected
 */
function drawSelection(context, layout, { observed, mapped }) {
  const hasRow = observed !== null && layout.rows.at.has(observed);
  const hasColumn = mapped !== null && layout.columns.at.has(mapped);
  context.strokeStyle = cssColor("--accent");
  context.lineWidth = 1;
  const { left, top, bin } = layout;
  if (hasRow) {
    clipped(context, layout, "rows", () =>
      context.strokeRect(left - 1.5, layout.y(observed) - 0.5, bin.x + BIN - left + 3, layout.rows.size));
  }
  if (hasColumn) {
    clipped(context, layout, "columns", () =>
      context.strokeRect(layout.x(mapped) - 0.5, top - 1.5, layout.columns.size, bin.y + BIN - top + 3));
  }
  if (hasRow && hasColumn) clipped(context, layout, "both", () => outline(context, layout, { observed, mapped }, "--accent", 2.2));
}

/**
 * @param {Context} context
 * @param {MatrixLayout} layout
 * @param {MatrixSelection} cell
 * @param {string} color
 * @param {number} width
 */
function outline(context, layout, { observed, mapped }, color, width) {
  if (observed === null || mapped === null) return;
  context.strokeStyle = cssColor(color);
  context.lineWidth = width;
  context.strokeRect(layout.x(mapped) - 0.5, layout.y(observed) - 0.5, layout.columns.size, layout.rows.size);
}

/* Helpers */

/** @param {number} bits */
const shareOf = (bits) => Math.min(1, bits / MAX_BITS);
/** @param {number} sum */
const colorOfSum = (sum) => cssColor(Math.abs(sum - 1) > SUM_TOLERANCE ? "--cannot" : "--faint");

/**
 * @param {Context} context
 * @param {number} x
 * @param {number} y
 * @param {number} width
 * @param {number} height
 */
function drawBar(context, x, y, width, height) {
  fill(context, cssColor("--dim"), x, y, width, height);
}

/**
 * @param {Context} context
 * @param {string} color
 * @param {number} x
 * @param {number} y
 * @param {number} width
 * @param {number} height
 */
function fill(context, color, x, y, width, height) {
  context.fillStyle = color;
  context.fillRect(x, y, width, height);
}

/**
 * @param {Context} context
 * @param {string} text
 * @param {number} x
 * @param {number} y
 * @param {string} color
 * @param {CanvasTextAlign} align
 */
function write(context, text, x, y, color, align) {
  context.font = FONT;
  context.textAlign = align;
  context.textBaseline = "middle";
  context.fillStyle = color;
  context.fillText(text, x, y);
}
