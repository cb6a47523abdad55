// @ts-check
/* The neighbouring images, below the image: whole, or cropped around the selection, at one scale.
 * A click goes to the frame. */

import { Surface, View, cssColor, pointerAt } from "/static/canvas.js";
import { byId, fixed } from "/static/dom.js";
import { ON_IMAGE, drawMark } from "/static/glyphs.js";
import { drawMapped, drawPhoto, drawDetection } from "./image/image_drawing.js";
import { middle } from "./image/image_model.js";

/** @typedef {import("./panel.js").Figure} Figure */
/** @typedef {import("./run_rows.js").FrameRow} FrameRow */
/** @typedef {import("/static/protocol").inspector.NeighbourView} NeighbourView */
/** @typedef {import("/static/protocol").inspector.StateView} StateView */
/** @typedef {import("/static/canvas.js").Point} Point */
/** @typedef {import("./panel.js").ClassMap} ClassMap */
/** @typedef {import("./panel.js").Context} Context */
/** @typedef {import("./main.js").Page} Page */

const GAP = 6;
const CAPTION = 20;
const POLE_SHARE = 0.55; // of the image height that a selected pole fills
const MAX_SCALE = 4; // times the size of the image

/** @typedef {NeighbourView & {row: FrameRow, bitmap: ImageBitmap | null}} ShownNeighbour */

export class Neighbours {
  /** @param {Page} page */
  constructor(page) {
    this.page = page;
    /** @type {ShownNeighbour[]} */
    this.shown = [];
    /** @type {NeighbourView[]} */
    this.coming = [];
    /** @type {ClassMap} */
    this.classes = new Map();
    page.socket.on("neighbours", ({ frames }) => this.showNeighbours(frames));
    const canvas = byId("neighbours-canvas", HTMLCanvasElement);
    this.surface = new Surface(canvas, (...size) => this.draw(...size));
    canvas.addEventListener("click", (event) => this.pick(pointerAt(event)));
    canvas.addEventListener("pointermove", (event) => this.hint(pointerAt(event)));
  }

  showRun() {
    this.shown = [];
    this.classes = new Map(this.run.classes.map((kind) => [kind.id, kind]));
  }

  /** @param {StateView} state */
  showState(state) {
    byId("neighbours").hidden = !state.neighbours;
  }

  showTheme() {
    this.surface.redraw();
  }

  get run() {
    return this.page.store.run;
  }

  /** @param {NeighbourView[]} frames */
  async showNeighbours(frames) {
    this.coming = frames;
    const { images } = this.page.image;
    const loaded = await Promise.all(frames.map((neighbour) => images.get(neighbour.position, "left")));
    if (this.coming !== frames) return;
    this.shown = frames.map((neighbour, k) => ({ ...neighbour, row: this.run.frames[neighbour.position], bitmap: loaded[k].bitmap }));
    this.surface.redraw();
  }

  /** @returns {Figure[]} */
  figures() {
    return this.shown.length && !byId("neighbours").hidden ? [this.surface.figure("around", "Around")] : [];
  }

  /**
   * @param {Point} point
   * @returns {ShownNeighbour | undefined}
   */
  at([x]) {
    const width = this.surface.width / Math.max(1, this.shown.length);
    return this.shown[Math.floor(x / width)];
  }

  /** @param {Point} point */
  pick(point) {
    const neighbour = this.at(point);
    if (neighbour) this.page.go(neighbour.position);
  }

  /** @param {Point} point */
  hint(point) {
    const neighbour = this.at(point);
    if (neighbour) this.surface.canvas.title = `Frame ${neighbour.row.index}: ${neighbour.row.diagnosis}`;
  }

  /* Drawing */

  /**
   * @param {Context} context
   * @param {number} width
   * @param {number} height
   */
  draw(context, width, height) {
    const cell = (width - GAP * (this.shown.length - 1)) / this.shown.length;
    const scale = this.scale(cell, height - CAPTION);
    this.shown.forEach((neighbour, k) => {
      const left = k * (cell + GAP);
      this.drawCell(context, neighbour, [left, cell, height - CAPTION], scale);
      this.drawCaption(context, neighbour, left, height - CAPTION / 2);
    });
  }

  /** One scale for all: whole images, or the selection large enough to see.
   *
   * @param {number} width
   * @param {number} height
   */
  scale(width, height) {
    const [across, down] = [width / this.run.image.width, height / this.run.image.height];
    const places = this.shown.flatMap((neighbour) => {
      const place = placeOf(neighbour);
      return place ? [place] : [];
    });
    if (!places.length) return Math.min(across, down);
    const longest = Math.max(1, ...places.map(([a, b]) => (b ? Math.hypot(a[0] - b[0], a[1] - b[1]) : 12)));
    return Math.max(across, down, Math.min(MAX_SCALE, (POLE_SHARE * height) / longest));
  }

  /**
   * @param {Context} context
   * @param {ShownNeighbour} neighbour
   * @param {[number, number, number]} cell
   * @param {number} scale
   */
  drawCell(context, neighbour, [left, width, height], scale) {
    const { width: w, height: h } = this.run.image;
    const place = placeOf(neighbour);
    const [u, v] = place ? middle(...place) : [w / 2, h / 2];
    const view = new View();
    view.scale = scale;
    view.x = left + covering(width / 2 - scale * u, width, scale * w);
    view.y = covering(height / 2 - scale * v, height, scale * h);
    context.save();
    context.beginPath();
    context.rect(left, 0, width, height);
    context.clip();
    drawPhoto(context, neighbour.bitmap, view, this.run.image);
    /** @param {Point} point */
    const at = (point) => view.toScreen(point);
    const [seen, mapped] = [neighbour.seen, neighbour.mapped].map((element) => element && this.classes.get(element.class_id));
    if (mapped && neighbour.mapped) drawMapped(context, mapped, neighbour.mapped.place, at, ON_IMAGE.estimate, Boolean(neighbour.seen));
    if (seen && neighbour.seen) drawDetection(context, seen, neighbour.seen.place, at);
    context.restore();
    if (!this.isHere(neighbour)) return;
    context.strokeStyle = cssColor("--text");
    context.lineWidth = 2;
    context.strokeRect(left + 1, 1, width - 2, height - 2);
  }

  /** @param {ShownNeighbour} neighbour */
  isHere({ position }) {
    return position === this.page.store.position;
  }

  /**
   * @param {Context} context
   * @param {ShownNeighbour} neighbour
   * @param {number} left
   * @param {number} y
   */
  drawCaption(context, neighbour, left, y) {
    const { row } = neighbour;
    const isHere = this.isHere(neighbour);
    drawMark(context, row.status, left + 8, y, 4, cssColor(`--${row.overconfident ? "cannot" : row.status}`));
    context.font = `${isHere ? 600 : 400} 11px Inter, "Liberation Sans", Arial, sans-serif`;
    context.textAlign = "left";
    context.textBaseline = "middle";
    context.fillStyle = cssColor(isHere ? "--text" : "--dim");
    const error = row.error_m === null ? (row.status === "cannot" ? "no pose" : "") : `${fixed(row.error_m, 2)} m`;
    context.fillText(["frame " + row.index, error].filter(Boolean).join(" · "), left + 18, y);
  }
}

/** The ends of the selected element: as detected, or else as mapped.
 *
 * @param {NeighbourView} neighbour
 */
const placeOf = ({ seen, mapped }) => (seen ?? mapped)?.place;

/** An offset of an image of `size` in `room`, clamped so that the image fills the room, or centred
 * if it is smaller.
 *
 * @param {number} offset
 * @param {number} room
 * @param {number} size
 */
function covering(offset, room, size) {
  return size < room ? (room - size) / 2 : Math.min(0, Math.max(room - size, offset));
}
