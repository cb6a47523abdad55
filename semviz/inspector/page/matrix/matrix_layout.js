// @ts-check
/* Positions of rows and columns of the matrix, in CSS pixels, and the cell under a point.
 *
 * Names stay at the left and the top; dustbins, sums and entropies at the right and the bottom. The
 * blocks of classes scroll between them. */

/** @typedef {import("/static/canvas.js").Point} Point */
/** @typedef {import("./matrix_model.js").MatrixModel} MatrixModel */

export const MIN_CELL = 4;
export const BIN = 12; // dustbins
export const SUM = { across: 28, down: 10 }; // numbers of rows, bars of columns
export const ENTROPY = { across: 22, down: 16 }; // bars
const MAX_CELL = 48;
const ROW_NAMES = 30;
const GLYPHS = 20;
const COLUMN_NAMES = 36;
const COMFORTABLE = 14; // smaller rows leave no room for column names
const VALUE = { width: 27, height: 14 }; // larger cells show their value
const GAP = 5; // between class blocks, and before the dustbins

/** @typedef {"names" | "cells" | "bin" | "sum" | "entropy" | "none"} Zone */
/** @typedef {{class: number, start: number, end: number, first: number, count: number}} Block */
/** What is under a point; null stands for the dustbin.
 *
 * @typedef {{of: "cell", observed: number | null, mapped: number | null}
 *   | {of: "row", observed: number | null, measure?: "sum" | "entropy"}
 *   | {of: "column", mapped: number | null, measure?: "sum" | "entropy"}} MatrixPlace
 */

/** The measure of a zone; names have none.
 *
 * @param {Zone} zone
 */
const measureOf = (zone) => (zone === "sum" || zone === "entropy" ? zone : undefined);

/** Positions along one direction: cells of equal size in blocks of one class. */
export class Axis {
  /**
   * @param {number[]} order
   * @param {(index: number) => number} classOf
   * @param {number} room
   */
  constructor(order, classOf, room) {
    const changes = order.filter((index, k) => k && classOf(index) !== classOf(order[k - 1])).length;
    const fitting = (room - GAP * changes) / Math.max(1, order.length);
    this.order = order;
    this.size = Math.max(MIN_CELL, Math.min(MAX_CELL, fitting));
    /** @type {Map<number, number>} */
    this.at = new Map(); // start by index
    /** @type {Block[]} */
    this.blocks = [];
    let end = 0;
    for (const [k, index] of order.entries()) {
      const kind = classOf(index);
      let block = this.blocks.at(-1);
      if (!block || block.class !== kind) {
        if (block) end += GAP;
        block = { class: kind, start: end, end, first: k, count: 0 };
        this.blocks.push(block);
      }
      this.at.set(index, end);
      end += this.size;
      block.end = end;
      block.count += 1;
    }
    this.length = end;
    this.shown = Math.min(room, end);
  }

  /** The index at a position; null in gaps and outside.
   *
   * @param {number} position
   */
  find(position) {
    return this.order.find((index) => position >= this.start(index) && position < this.start(index) + this.size) ?? null;
  }

  /** Start of an index.
   *
   * @param {number} index
   */
  start(index) {
    return this.at.get(index) ?? 0;
  }

  /** Indices that are visible, at least in part.
   *
   * @param {number} scroll
   */
  visible(scroll) {
    return this.order.filter((index) => this.start(index) + this.size > scroll && this.start(index) < scroll + this.shown);
  }
}

export class MatrixLayout {
  /**
   * @param {MatrixModel} model
   * @param {number} width
   * @param {number} height
   */
  constructor(model, width, height) {
    this.left = ROW_NAMES;
    const right = GAP + BIN + SUM.across + ENTROPY.across + 4;
    this.below = GAP + BIN + SUM.down + ENTROPY.down + 4;
    /** @param {number} j */
    const column = (j) => model.mapped[j].class_id;
    /** @param {number} i */
    const row = (i) => model.observed[i].class_id;
    this.columns = new Axis(model.columns, column, width - this.left - right);
    const named = new Axis(model.rows, row, height - GLYPHS - COLUMN_NAMES - this.below);
    this.hasColumnNames = named.size >= COMFORTABLE;
    this.top = GLYPHS + (this.hasColumnNames ? COLUMN_NAMES : 0);
    this.rows = this.hasColumnNames ? named : new Axis(model.rows, row, height - this.top - this.below);
    this.glyphY = GLYPHS / 2;
    this.hasValues = this.columns.size >= VALUE.width && this.rows.size >= VALUE.height;
    this.end = { x: this.left + this.columns.shown, y: this.top + this.rows.shown }; // end of the blocks
    this.bin = { x: this.end.x + GAP, y: this.end.y + GAP };
    this.sum = { x: this.bin.x + BIN + 4, y: this.bin.y + BIN + 3 };
    this.entropy = { x: this.sum.x + SUM.across, y: this.sum.y + SUM.down + 3 };
    this.scroll = { x: 0, y: 0 };
    this.needs = {
      width: Math.floor(this.left + this.columns.length + right),
      height: Math.floor(this.top + this.rows.length + this.below),
    };
  }

  /** Sets the scroll position of the blocks.
   *
   * @param {number} x
   * @param {number} y
   */
  scrollTo(x, y) {
    this.scroll = { x, y };
  }

  /** @param {number} column */
  x(column) {
    return this.left + this.columns.start(column) - this.scroll.x;
  }

  /** @param {number} row */
  y(row) {
    return this.top + this.rows.start(row) - this.scroll.y;
  }

  /** What is under a point.
   *
   * @param {Point} point
   * @returns {MatrixPlace | null}
   */
  find([x, y]) {
    const across = this.zone(x, this.left, this.end.x, "x", ENTROPY.across);
    const down = this.zone(y, this.top, this.end.y, "y", ENTROPY.down);
    const mapped = across === "cells" ? this.columns.find(x - this.left + this.scroll.x) : null;
    const observed = down === "cells" ? this.rows.find(y - this.top + this.scroll.y) : null;
    const isColumn = mapped !== null || across === "bin";
    const isRow = observed !== null || down === "bin";
    if (isRow && isColumn) return observed === null && mapped === null ? null : { of: "cell", observed, mapped };
    if (isRow && across !== "none" && across !== "cells") return { of: "row", observed, measure: measureOf(across) };
    if (isColumn && down !== "none" && down !== "cells") return { of: "column", mapped, measure: measureOf(down) };
    return null;
  }

  /**
   * @param {number} at
   * @param {number} start
   * @param {number} end
   * @param {"x" | "y"} way
   * @param {number} entropy
   * @returns {Zone}
   */
  zone(at, start, end, way, entropy) {
    if (at < start) return "names";
    if (at < end) return "cells";
    if (at >= this.bin[way] && at < this.bin[way] + BIN) return "bin";
    if (at >= this.sum[way] && at < this.entropy[way]) return "sum";
    return at >= this.entropy[way] && at < this.entropy[way] + entropy ? "entropy" : "none";
  }
}
