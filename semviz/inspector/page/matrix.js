/* Probabilities of all pairs: classes in blocks, dustbins, true pairs ringed. */

import { Surface, cssColor, pointerAt } from "/static/canvas.js";
import { byId } from "/static/dom.js";
import { currentTheme } from "/static/theme.js";

const LEFT = 34; // row names
const TOP = 22; // class glyphs
const GAP = 5; // between class blocks
const BIN = 9; // dustbin row and column
const SUM = 34; // sums on the right
const LEAST_CELL = 4;
const NAME = 12; // height of a row's name
const LOG_FLOOR = 3; // log scale goes down to 1e-3

export class MatrixPanel {
  constructor(page) {
    this.page = page;
    this.log = false;
    this.state = {};
    this.hovered = null;
    const canvas = byId("matrix-canvas");
    this.surface = new Surface(canvas, (...size) => this.draw(...size));
    this.surface.onresize = () => this.layOut();
    canvas.addEventListener("pointermove", (event) => this.hover(this.cellAt(pointerAt(event))));
    canvas.addEventListener("pointerleave", () => this.hover(null));
    canvas.addEventListener("click", (event) => this.pick(this.cellAt(pointerAt(event))));
    byId("matrix-log").addEventListener("click", () => this.toggleLog());
    new ResizeObserver(() => this.reserve()).observe(canvas.parentElement.parentElement);
  }

  commands() {
    return [{ key: "m", group: "Image and matrix", title: "Matrix linear, log", run: () => this.toggleLog() }];
  }

  showRun(run) {
    this.classes = new Map(run.classes.map((one) => [one.id, one]));
    this.showTheme();
  }

  showFrame(frame) {
    this.frame = frame;
    this.hovered = null;
    const { observed, mapped } = frame;
    byId("matrix-about").textContent = frame.matrix ? `${observed.length} seen × ${mapped.length} mapped` : "";
    this.reserve();
    this.layOut();
    this.surface.redraw();
  }

  showState(state) {
    this.state = state;
    this.surface.redraw();
    this.showValue();
  }

  showTheme() {
    this.ramp = [0, 1, 2, 3].map((stop) => rgb(cssColor(`--ramp-${stop}`)));
    this.surface.redraw();
  }

  toggleLog() {
    this.log = !this.log;
    byId("matrix-log").setAttribute("aria-pressed", this.log);
    this.surface.redraw();
  }

  /* Geometry: where rows and columns lie */

  /** Widens the sheet where cells would get too small; the panel then scrolls. */
  reserve() {
    if (!this.frame?.matrix) return;
    const sheet = this.surface.canvas.parentElement;
    const { observed, mapped } = this.frame;
    const blocks = this.classes.size - 1;
    sheet.style.minWidth = `${LEFT + SUM + BIN + GAP + LEAST_CELL * mapped.length + GAP * blocks}px`;
    sheet.style.minHeight = `${TOP + 2 * BIN + 2 * GAP + 8 * observed.length + GAP * blocks}px`;
  }

  layOut() {
    if (!this.frame?.matrix) return;
    const { rows, columns } = this.frame.matrix;
    const { observed, mapped } = this.frame;
    const { width, height } = this.surface;
    this.columns = spread(columns, (j) => mapped[j].class, LEFT, width - LEFT - SUM - BIN - GAP, 22);
    this.rows = spread(rows, (i) => observed[i].class, TOP, height - TOP - 2 * BIN - 3 * GAP, 26);
    this.binX = this.columns.end + GAP;
    this.binY = this.rows.end + GAP;
  }

  /** {observed, mapped} under a point; one of them null in the dustbins, null outside. */
  cellAt([x, y]) {
    if (!this.frame?.matrix || !this.rows) return null;
    const observed = this.rows.find(y);
    const mapped = this.columns.find(x);
    if (observed !== null && (mapped !== null || x < LEFT || x >= this.binX)) return { observed, mapped };
    return mapped !== null && y >= this.binY && y < this.binY + BIN ? { observed: null, mapped } : null;
  }

  /* Selection */

  hover(cell) {
    this.hovered = cell;
    this.showValue();
  }

  pick(cell) {
    if (!cell) this.page.select();
    else this.page.select({ observed: cell.observed, element: cell.mapped === null ? null : this.frame.mapped[cell.mapped].id });
  }

  selectedCell() {
    const column = this.frame.mapped.findIndex((one) => one.id === this.state.element);
    return { observed: this.state.observed, mapped: column < 0 ? null : column };
  }

  showValue() {
    if (!this.frame) return;
    const { observed, mapped } = this.hovered ?? this.selectedCell();
    byId("matrix-value").textContent = this.frame.matrix ? this.valueOf(observed, mapped) : "";
  }

  valueOf(observed, mapped) {
    if (observed === null && mapped === null) return "";
    const { probability } = this.frame.matrix;
    const row = observed ?? this.frame.observed.length;
    const column = mapped ?? this.frame.mapped.length;
    const seen = observed === null ? "not seen" : `#${observed}`;
    const name = mapped === null ? "not in the map" : this.frame.mapped[mapped].name;
    const truth = observed !== null && mapped !== null && this.frame.observed[observed].truth === mapped ? ", true" : "";
    return `${seen} × ${name}  p ${probability[row][column].toFixed(3)}${truth}`;
  }

  /* Drawing */

  draw(context, width, height) {
    if (!this.frame) return;
    if (!this.frame.matrix) {
      write(context, "No probabilities in this frame.", width / 2, height / 2, "--faint", "center");
      return;
    }
    if (!this.rows) this.layOut();
    this.drawCells(context);
    this.drawNames(context);
    this.drawTruth(context);
    this.drawSelection(context);
  }

  drawCells(context) {
    const { probability } = this.frame.matrix;
    const [m, n] = [this.frame.observed.length, this.frame.mapped.length];
    const cell = (value, x, y, w, h) => {
      context.fillStyle = this.color(value);
      context.fillRect(x, y, w, h);
    };
    context.fillStyle = cssColor("--raised"); // shows between the cells
    for (const across of [...this.columns.blocks, { start: this.binX, end: this.binX + BIN }]) {
      for (const down of this.rows.blocks) {
        context.fillRect(across.start - 1, down.start - 1, across.end - across.start + 1, down.end - down.start + 1);
      }
    }
    const seam = this.columns.size > 6 ? 1 : 0;
    for (const [i, y] of this.rows.at) {
      for (const [j, x] of this.columns.at) cell(probability[i][j], x, y, this.columns.size - seam, this.rows.size - 1);
      cell(probability[i][n], this.binX, y, BIN, this.rows.size - 1);
    }
    for (const [j, x] of this.columns.at) cell(probability[m][j], x, this.binY, this.columns.size - seam, BIN);
  }

  drawNames(context) {
    const { probability } = this.frame.matrix;
    let free = 0; // names of thin rows would cover each other
    for (const [i, y] of this.rows.at) {
      const middle = y + this.rows.size / 2;
      const chosen = i === this.state.observed;
      if (middle < free && !chosen) continue;
      free = middle + NAME;
      write(context, `#${i}`, LEFT - 6, middle, chosen ? "--text" : "--dim", "right");
      const sum = probability[i].reduce((a, b) => a + b, 0);
      write(context, sum.toFixed(2), this.binX + BIN + 6, middle, "--faint", "left");
    }
    const light = currentTheme() === "light";
    for (const block of this.columns.blocks) {
      const one = this.classes.get(block.class);
      drawIcon(context, one, light ? one.colorLight : one.color, (block.start + block.end) / 2, TOP / 2);
    }
    write(context, "∅", this.binX + BIN / 2, TOP / 2, "--dim", "center");
    write(context, "Σ", this.binX + BIN + 6, TOP / 2, "--dim", "left");
    write(context, "∅", LEFT - 6, this.binY + BIN / 2, "--dim", "right");
  }

  drawTruth(context) {
    this.frame.observed.forEach(({ truth }, i) => {
      if (truth === null) return;
      const [x, y] = [this.columns.at.get(truth) + this.columns.size / 2, this.rows.at.get(i) + this.rows.size / 2];
      const bright = this.brightness(this.frame.matrix.probability[i][truth]) > 0.55;
      context.beginPath();
      context.arc(x, y, Math.min(3.2, this.columns.size / 2), 0, 2 * Math.PI);
      context.lineWidth = 1.5;
      context.strokeStyle = bright ? "#1B1C1E" : "#FFFFFF";
      context.stroke();
    });
  }

  drawSelection(context) {
    const { observed, mapped } = this.selectedCell();
    context.strokeStyle = cssColor("--accent");
    context.lineWidth = 1;
    const right = this.binX + BIN;
    const bottom = this.binY + BIN;
    if (observed !== null && this.rows.at.has(observed)) {
      context.strokeRect(LEFT - 1.5, this.rows.at.get(observed) - 1, right - LEFT + 3, this.rows.size + 1);
    }
    if (mapped !== null) {
      context.strokeRect(this.columns.at.get(mapped) - 1, TOP - 1.5, this.columns.size + 1, bottom - TOP + 3);
    }
    if (observed !== null && mapped !== null && this.rows.at.has(observed)) {
      context.lineWidth = 2.2;
      context.strokeRect(this.columns.at.get(mapped) - 1, this.rows.at.get(observed) - 1, this.columns.size + 1, this.rows.size + 1);
    }
  }

  scaled(value) {
    return this.log ? Math.max(0, 1 + Math.log10(Math.max(value, 1e-9)) / LOG_FLOOR) : value;
  }

  color(value) {
    const at = 3 * Math.min(1, Math.max(0, this.scaled(value)));
    const low = Math.min(2, Math.floor(at));
    const mixed = this.ramp[low].map((one, band) => Math.round(one + (at - low) * (this.ramp[low + 1][band] - one)));
    return `rgb(${mixed})`;
  }

  brightness(value) {
    const [red, green, blue] = this.color(value).match(/\d+/g).map(Number);
    return (0.3 * red + 0.6 * green + 0.1 * blue) / 255;
  }
}

/** Lays indices out along an axis, with gaps between classes: positions, blocks, and the way back. */
function spread(order, classOf, start, room, largest) {
  const changes = order.filter((one, k) => k && classOf(one) !== classOf(order[k - 1])).length;
  const size = Math.max(LEAST_CELL, Math.min(largest, (room - GAP * changes) / Math.max(1, order.length)));
  const at = new Map();
  const blocks = [];
  let x = start;
  order.forEach((one, k) => {
    if (k && classOf(one) !== classOf(order[k - 1])) x += GAP;
    if (!blocks.length || blocks.at(-1).class !== classOf(one)) blocks.push({ class: classOf(one), start: x });
    at.set(one, x);
    x += size;
    blocks.at(-1).end = x;
  });
  const find = (point) => {
    for (const [one, from] of at) if (point >= from && point < from + size) return one;
    return null;
  };
  return { at, blocks, size, end: x, find };
}

function write(context, text, x, y, color, align) {
  context.font = '11px Inter, "Liberation Sans", Arial, sans-serif';
  context.textAlign = align;
  context.textBaseline = "middle";
  context.fillStyle = cssColor(color);
  context.fillText(text, x, y);
}

/** A class glyph without casing: the ground is the panel's. */
function drawIcon(context, { shape }, color, x, y) {
  context.strokeStyle = color;
  context.lineWidth = 1.6;
  context.stroke(glyphPath(shape, x, y));
}

function glyphPath(shape, x, y) {
  const paths = {
    line: `M${x} ${y + 6}V${y - 6}M${x - 3} ${y - 6}h6`,
    triangle: `M${x} ${y - 5}l5.2 9h-10.4Z`,
    square: `M${x - 4.5} ${y - 4.5}h9v9h-9Z`,
    circle: `M${x - 4.8} ${y}a4.8 4.8 0 1 0 9.6 0a4.8 4.8 0 1 0-9.6 0Z`,
    diamond: `M${x} ${y - 5.5}l5.5 5.5l-5.5 5.5l-5.5-5.5Z`,
    pentagon: `M${x} ${y - 5.2}l5 3.6l-1.9 5.9h-6.2l-1.9-5.9Z`,
  };
  return new Path2D(paths[shape] ?? paths.square);
}

function rgb(hex) {
  return [1, 3, 5].map((at) => Number.parseInt(hex.slice(at, at + 2), 16));
}
