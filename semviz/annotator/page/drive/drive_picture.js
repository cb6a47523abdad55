// @ts-check
// Two images one above the other: matches and how far they are off their line, long edges and their bend, or
// depths of matches.
/** @import {annotator} from "/static/protocol" */
/** @import {Pictures} from "../images/pictures.js" */
/** @import {State} from "../state.js" */
import { cssColor } from "/static/canvas.js";
import { byId, el, fill } from "/static/dom.js";

const LIMITS = { rows: [0, 1, 2, 3, 5], lines: [0, 0.3, 0.6, 1, 2], depth: [0, 5, 10, 20, 40] };
const ROWS = 8; // lines in a picture of rows
const MAGNIFIED = 8;
const LEAST_OFF_PX = 0.5; // with a line
const LEAST_APART_PX = 90; // between depths in figures

/** @typedef {"rows" | "lines" | "depth"} Kind */

export class DrivePicture {
  /**
   * @param {State} state
   * @param {Pictures} pictures
   */
  constructor(state, pictures) {
    this.state = state;
    this.pictures = pictures;
    this.canvas = byId("drive-picture", HTMLCanvasElement);
    /** @type {Kind} */
    this.kind = "rows";
    /** @type {annotator.DrivePair | null} */
    this.found = null;
    /** @type {(ImageBitmap | null)[]} */
    this.bitmaps = [null, null];
    this.loading = "";
    new ResizeObserver(() => this.#draw()).observe(this.canvas);
  }

  /** @param {annotator.DrivePair} pair */
  received(pair) {
    this.found = pair;
    this.state.set({});
  }

  /** @param {number | null} frame */
  async show(frame) {
    const { found } = this;
    const isNow = found?.frame === frame;
    const about = byId("drive-about");
    about.textContent = about.title = isNow && found ? this.#about(found) : `frame ${frame}: matching …`;
    this.#key();
    if (!isNow || !found || frame === null) return;
    const side = this.state.hasRight ? "right" : "left";
    const loading = `${frame} ${found.second}`;
    if (loading !== this.loading) {
      this.loading = loading;
      const [first, second] = await Promise.all([this.pictures.get(frame, "left"), this.pictures.get(found.second, side)]);
      this.bitmaps = [first.bitmap, second.bitmap];
    }
    this.#draw();
  }

  /** @param {annotator.DrivePair} pair */
  #about({ frame, second, matches, edges, note }) {
    if (this.kind === "lines") {
      const bends = edges.flat().map(({ bend_px: px }) => Math.abs(px));
      return `frame ${frame}: ${bends.length} long edges, median bend ${median(bends).toFixed(2)} px`;
    }
    if (note) return note;
    if (this.kind === "depth") return `frame ${frame}: depth of ${matches.filter(({ depth_m: depth }) => depth !== null).length} matches`;
    const off = matches.map(({ off_px: px }) => Math.abs(px));
    const [pair, line] = this.state.hasRight ? ["left and right", "their row"] : [`and ${second}`, "their line by the poses"];
    return `frame ${frame} ${pair}: ${matches.length} matches${off.length ? `, median ${median(off).toFixed(2)} px off ${line}` : ""}`;
  }

  /** What the colours mean. */
  #key() {
    const unit = this.kind === "depth" ? "m" : "px";
    const texts = LIMITS[this.kind].map((limit, at, all) => (at === all.length - 1 ? `${limit} ${unit}` : `${limit}`));
    fill(byId("drive-scale"), texts.map((text) => el("span", { text })));
    const line = this.state.hasRight ? "row" : "epipolar line";
    byId("drive-explains").textContent = {
      rows: `matches; off their ${line}, ${MAGNIFIED}×`,
      lines: `bends of long edges, ${MAGNIFIED}×; many are curved in the world. The check: what distortion explains`,
      depth: this.state.hasRight ? "metres, from left and right" : "metres, from the poses of both",
    }[this.kind];
  }

  #draw() {
    const { canvas, bitmaps: [upper, lower] } = this;
    const { clientWidth: width, clientHeight: height } = canvas;
    const context = canvas.getContext("2d");
    if (!context || !width || !height || !upper || !lower) return;
    const ratio = devicePixelRatio;
    Object.assign(canvas, { width: width * ratio, height: height * ratio });
    context.scale(ratio, ratio);
    const scale = Math.min(width / upper.width, (height - 6) / (upper.height + lower.height));
    const left = (width - scale * upper.width) / 2;
    const tops = [(height - 6 - scale * (upper.height + lower.height)) / 2, 0];
    tops[1] = tops[0] + scale * upper.height + 6;
    [upper, lower].forEach((bitmap, at) => context.drawImage(bitmap, left, tops[at], scale * bitmap.width, scale * bitmap.height));
    const place = (/** @type {number} */ at, /** @type {[number, number]} */ [u, v]) => /** @type {[number, number]} */ ([left + scale * (u + 0.5), tops[at] + scale * (v + 0.5)]);
    if (this.kind === "rows" && this.state.hasRight) this.#rows(context, left, tops, scale, upper);
    [upper, lower].forEach((bitmap, at) => {
      context.save();
      context.beginPath();
      context.rect(left, tops[at], scale * bitmap.width, scale * bitmap.height);
      context.clip();
      if (this.kind === "lines") this.#edges(context, at, place);
      else if (this.kind === "depth") this.#depths(context, at, place);
      else this.#matches(context, at, place, scale);
      context.restore();
    });
  }

  /**
   * @param {CanvasRenderingContext2D} context
   * @param {number} left
   * @param {number[]} tops
   * @param {number} scale
   * @param {ImageBitmap} image
   */
  #rows(context, left, tops, scale, image) {
    context.strokeStyle = "rgba(255, 255, 255, .55)";
    context.lineWidth = 1;
    for (const top of tops) {
      for (let row = 1; row < ROWS; row += 1) {
        const y = top + (scale * image.height * row) / ROWS;
        context.beginPath();
        context.moveTo(left, y);
        context.lineTo(left + scale * image.width, y);
        context.stroke();
      }
    }
  }

  /** The colour of a value on the scale.
   *
   * @param {number} value
   */
  #color(value) {
    return cssColor(`--residual-${Math.max(0, LIMITS[this.kind].filter((limit) => value >= limit).length - 1)}`);
  }

  /** Crosses in both images; in the lower one a line shows how far a match is off, magnified.
   *
   * @param {CanvasRenderingContext2D} context
   * @param {number} at
   * @param {(at: number, pixel: [number, number]) => [number, number]} place
   * @param {number} scale
   */
  #matches(context, at, place, scale) {
    context.lineWidth = 1.5;
    for (const { here, there, off_px: off } of this.found?.matches ?? []) {
      const [x, y] = place(at, at ? there : here);
      context.strokeStyle = this.#color(Math.abs(off));
      context.beginPath();
      context.moveTo(x - 4, y);
      context.lineTo(x + 4, y);
      context.moveTo(x, y - 4);
      context.lineTo(x, y + 4);
      if (at === 1 && Math.abs(off) > LEAST_OFF_PX) {
        context.moveTo(x, y);
        context.lineTo(x, y + MAGNIFIED * scale * off);
      }
      context.stroke();
    }
  }

  /** Edges with their bend magnified, over the lines between their ends.
   *
   * @param {CanvasRenderingContext2D} context
   * @param {number} at
   * @param {(at: number, pixel: [number, number]) => [number, number]} place
   */
  #edges(context, at, place) {
    for (const { first, middle, last, bend_px: bend } of this.found?.edges[at] ?? []) {
      const [from, over, to] = [first, middle, last].map((pixel) => place(at, pixel));
      context.lineWidth = 1;
      context.strokeStyle = "rgba(255, 255, 255, .6)";
      context.beginPath();
      context.moveTo(...from);
      context.lineTo(...to);
      context.stroke();
      const [x, y] = [0, 1].map((axis) => (from[axis] + to[axis]) / 2 + 2 * MAGNIFIED * (over[axis] - (from[axis] + to[axis]) / 2));
      context.lineWidth = 2;
      context.strokeStyle = this.#color(Math.abs(bend));
      context.beginPath();
      context.moveTo(...from);
      context.quadraticCurveTo(x, y, ...to);
      context.stroke();
    }
  }

  /** Matches in the colour of their depth, some with figures.
   *
   * @param {CanvasRenderingContext2D} context
   * @param {number} at
   * @param {(at: number, pixel: [number, number]) => [number, number]} place
   */
  #depths(context, at, place) {
    const figures = /** @type {[number, number, string][]} */ ([]);
    context.font = "600 11px Inter, \"Liberation Sans\", Arial, sans-serif";
    for (const { here, there, depth_m: depth } of this.found?.matches ?? []) {
      if (depth === null) continue;
      const [x, y] = place(at, at ? there : here);
      context.fillStyle = this.#color(depth);
      context.beginPath();
      context.arc(x, y, 3.5, 0, 2 * Math.PI);
      context.fill();
      if (at === 1 || figures.some(([fx, fy]) => Math.hypot(fx - x, fy - y) < LEAST_APART_PX)) continue;
      figures.push([x, y, `${depth < 10 ? depth.toFixed(1) : depth.toFixed(0)} m`]);
    }
    context.lineWidth = 3;
    context.strokeStyle = "rgba(0, 0, 0, .75)";
    context.fillStyle = "#fff";
    const highest = place(at, [0, 0])[1] + 11;
    for (const [x, y, text] of figures) {
      const below = Math.max(y + 4, highest);
      context.strokeText(text, x + 6, below);
      context.fillText(text, x + 6, below);
    }
  }
}

/** @param {number[]} values */
function median(values) {
  return values.length ? [...values].sort((a, b) => a - b)[Math.floor(values.length / 2)] : 0;
}
