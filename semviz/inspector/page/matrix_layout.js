/* Where rows and columns of the matrix lie, in CSS pixels, and what is under a point.
 *
 * Names stay at the left and the top, dustbins, sums and entropies at the right and the bottom, while
 * the blocks of classes scroll between them. */

export const LEAST_CELL = 4;
export const BIN = 12; // dustbins
export const SUM = { across: 28, down: 10 }; // numbers of rows, bars of columns
export const ENTROPY = { across: 22, down: 16 }; // bars
const MOST_CELL = 48;
const ROW_NAMES = 30;
const GLYPHS = 20;
const COLUMN_NAMES = 36;
const COMFORTABLE = 14; // rows give room to the columns' names, but not below this
const VALUE = { width: 27, height: 14 }; // cells as large show their value
const GAP = 5; // between class blocks, and before the dustbins
const MEASURE = { sum: "sum", entropy: "entropy" }; // names have none

/** Positions along one direction: cells of equal size in blocks of one class. */
class Axis {
  constructor(order, classOf, room) {
    const changes = order.filter((one, k) => k && classOf(one) !== classOf(order[k - 1])).length;
    const fair = (room - GAP * changes) / Math.max(1, order.length);
    this.order = order;
    this.size = Math.max(LEAST_CELL, Math.min(MOST_CELL, fair));
    this.at = new Map(); // start of each index
    this.blocks = []; // {class, start, end, first, count}
    let end = 0;
    for (const [k, one] of order.entries()) {
      const kind = classOf(one);
      if (this.blocks.at(-1)?.class !== kind) {
        if (this.blocks.length) end += GAP;
        this.blocks.push({ class: kind, start: end, first: k, count: 0 });
      }
      this.at.set(one, end);
      end += this.size;
      this.blocks.at(-1).end = end;
      this.blocks.at(-1).count += 1;
    }
    this.length = end;
    this.shown = Math.min(room, end);
  }

  /** The index at a position, null in gaps and outside. */
  find(position) {
    return this.order.find((one) => position >= this.at.get(one) && position < this.at.get(one) + this.size) ?? null;
  }

  /** Indices that are seen, wholly or in part. */
  visible(scroll) {
    return this.order.filter((one) => this.at.get(one) + this.size > scroll && this.at.get(one) < scroll + this.shown);
  }
}

export class MatrixLayout {
  constructor(model, width, height) {
    this.left = ROW_NAMES;
    const right = GAP + BIN + SUM.across + ENTROPY.across + 4;
    this.below = GAP + BIN + SUM.down + ENTROPY.down + 4;
    const column = (j) => model.mapped[j].class;
    const row = (i) => model.observed[i].class;
    this.columns = new Axis(model.columns, column, width - this.left - right);
    const named = new Axis(model.rows, row, height - GLYPHS - COLUMN_NAMES - this.below);
    this.hasColumnNames = named.size >= COMFORTABLE;
    this.top = GLYPHS + (this.hasColumnNames ? COLUMN_NAMES : 0);
    this.rows = this.hasColumnNames ? named : new Axis(model.rows, row, height - this.top - this.below);
    this.glyphY = GLYPHS / 2;
    this.hasValues = this.columns.size >= VALUE.width && this.rows.size >= VALUE.height;
    this.end = { x: this.left + this.columns.shown, y: this.top + this.rows.shown }; // of the blocks
    this.bin = { x: this.end.x + GAP, y: this.end.y + GAP };
    this.sum = { x: this.bin.x + BIN + 4, y: this.bin.y + BIN + 3 };
    this.entropy = { x: this.sum.x + SUM.across, y: this.sum.y + SUM.down + 3 };
    this.scroll = { x: 0, y: 0 };
    this.needs = {
      width: Math.floor(this.left + this.columns.length + right),
      height: Math.floor(this.top + this.rows.length + this.below),
    };
  }

  /** Where the blocks are scrolled to. */
  scrollTo(x, y) {
    this.scroll = { x, y };
  }

  x(column) {
    return this.left + this.columns.at.get(column) - this.scroll.x;
  }

  y(row) {
    return this.top + this.rows.at.get(row) - this.scroll.y;
  }

  /** What is under a point: {of: "cell", observed, mapped}, either of them null in the dustbins; of
   * names, sums and entropies {of: "row", observed, measure} or {of: "column", mapped, measure}. */
  find([x, y]) {
    const across = this.zone(x, this.left, this.end.x, "x", ENTROPY.across);
    const down = this.zone(y, this.top, this.end.y, "y", ENTROPY.down);
    const mapped = across === "cells" ? this.columns.find(x - this.left + this.scroll.x) : null;
    const observed = down === "cells" ? this.rows.find(y - this.top + this.scroll.y) : null;
    const isColumn = mapped !== null || across === "bin";
    const isRow = observed !== null || down === "bin";
    if (isRow && isColumn) return observed === null && mapped === null ? null : { of: "cell", observed, mapped };
    if (isRow && across !== "none" && across !== "cells") return { of: "row", observed, measure: MEASURE[across] };
    if (isColumn && down !== "none" && down !== "cells") return { of: "column", mapped, measure: MEASURE[down] };
    return null;
  }

  zone(at, start, end, way, entropy) {
    if (at < start) return "names";
    if (at < end) return "cells";
    if (at >= this.bin[way] && at < this.bin[way] + BIN) return "bin";
    if (at >= this.sum[way] && at < this.entropy[way]) return "sum";
    return at >= this.entropy[way] && at < this.entropy[way] + entropy ? "entropy" : "none";
  }
}
