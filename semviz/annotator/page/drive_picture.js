// @ts-check
// Two images one above the other with matches between them, coloured by their distance from their line.
/** @import {annotator} from "/static/protocol" */
/** @import {Pictures} from "./pictures.js" */
/** @import {State} from "./state.js" */
import { byId } from "/static/dom.js";

const LIMITS_PX = [1, 2, 3, 5]; // of the residual scale
const ROWS = 8; // lines in a picture of rows
const MAGNIFIED = 8;
const LEAST_OFF_PX = 0.5; // with a line

export class DrivePicture {
  /**
   * @param {State} state
   * @param {Pictures} pictures
   */
  constructor(state, pictures) {
    this.state = state;
    this.pictures = pictures;
    this.canvas = byId("drive-picture", HTMLCanvasElement);
    /** @type {annotator.DriveFrameEvent | null} */
    this.found = null;
    /** @type {(ImageBitmap | null)[]} */
    this.bitmaps = [null, null];
    this.loading = "";
    new ResizeObserver(() => this.#draw()).observe(this.canvas);
  }

  /** @param {annotator.DriveFrameEvent} event */
  received(event) {
    this.found = event;
    this.state.set({});
  }

  /** @param {number | null} frame */
  async show(frame) {
    const { found } = this;
    const isNow = found?.frame === frame;
    byId("drive-about").textContent = isNow && found ? this.#about(found) : `frame ${frame}: matching …`;
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

  /** @param {annotator.DriveFrameEvent} event */
  #about({ frame, second, matches, note }) {
    if (note) return note;
    const off = matches.map(({ off_px: px }) => Math.abs(px)).sort((a, b) => a - b);
    const median = off.length ? `, median ${off[Math.floor(off.length / 2)].toFixed(2)} px off` : "";
    const [pair, line] = this.state.hasRight ? ["left and right", "their row"] : [`and ${second}`, "their line by the poses"];
    return `frame ${frame} ${pair}: ${matches.length} matches${median} ${line}`;
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
    if (this.state.hasRight) this.#rows(context, left, tops, scale, upper);
    this.#matches(context, left, tops, scale);
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

  /** Crosses in both images; in the lower one a line shows how far a match is off, magnified.
   *
   * @param {CanvasRenderingContext2D} context
   * @param {number} left
   * @param {number[]} tops
   * @param {number} scale
   */
  #matches(context, left, tops, scale) {
    const style = getComputedStyle(document.documentElement);
    context.lineWidth = 1.5;
    this.bitmaps.forEach((bitmap, at) => {
      if (!bitmap) return;
      context.save();
      context.beginPath();
      context.rect(left, tops[at], scale * bitmap.width, scale * bitmap.height);
      context.clip();
      for (const { here, there, off_px: off } of this.found?.matches ?? []) {
        const place = LIMITS_PX.filter((limit) => Math.abs(off) >= limit).length;
        const [u, v] = at ? there : here;
        const [x, y] = [left + scale * (u + 0.5), tops[at] + scale * (v + 0.5)];
        context.strokeStyle = style.getPropertyValue(`--residual-${place}`);
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
      context.restore();
    });
  }
}
