// @ts-check
// The whole drive above the matrix: one pixel column for a frame, the worst residual of a pixel wins.
/** @import {Tracks} from "./tracks.js" */
import { Surface, pointerAt } from "/static/canvas.js";
import { byId } from "/static/dom.js";
import { NAMES, levelOf, theme } from "./track_matrix.js";
import { NOTHING, PROPOSED, UNPLACED } from "./track_table.js";

const TOP = 16, BOTTOM = 10; // CSS pixels: numbers of frames, reviewed frames

/** @typedef {CanvasRenderingContext2D} Context */

export class TrackOverview {
  /** @param {Tracks} tracks */
  constructor(tracks) {
    this.tracks = tracks;
    this.key = ""; // what the picture shows
    this.picture = document.createElement("canvas");
    this.canvas = byId("track-overview", HTMLCanvasElement);
    this.surface = new Surface(this.canvas, (context, width, height) => this.#draw(context, width, height));
    this.canvas.addEventListener("pointerdown", (event) => {
      this.canvas.setPointerCapture(event.pointerId);
      this.#lookAt(event);
    });
    this.canvas.addEventListener("pointermove", (event) => { if (event.buttons & 1) this.#lookAt(event); });
    this.canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      tracks.matrix.zoom(Math.exp(event.deltaY * 0.0016));
      this.surface.redraw();
    }, { passive: false });
  }

  get #size() {
    return [Math.max(1, this.surface.width - NAMES - 8), Math.max(1, this.surface.height - TOP - BOTTOM)];
  }

  /** @param {PointerEvent} event */
  #lookAt(event) {
    const { tracks } = this, { matrix, places, shown } = tracks;
    const [x, y] = pointerAt(event), [width, height] = this.#size;
    const place = ((x - NAMES) / width) * places, row = ((y - TOP) / height) * shown.length;
    matrix.look(place - matrix.columns / 2, matrix.columns, row - matrix.visibleRows / 2);
    this.surface.redraw();
  }

  /**
   * @param {Context} context
   * @param {number} width
   * @param {number} height
   */
  #draw(context, width, height) {
    const { tracks } = this, { matrix, places, shown } = tracks;
    if (!tracks.isShown) return;
    const [across, down] = this.#size, look = theme();
    this.#paint(across, down, look);
    context.imageSmoothingEnabled = false;
    context.drawImage(this.picture, NAMES, TOP, across, down);
    context.font = "11px Inter, \"Liberation Sans\", Arial, sans-serif";
    context.textBaseline = "middle";
    context.textAlign = "center";
    context.fillStyle = look.dim;
    const step = Math.max(1, Math.ceil(places / 10));
    for (let place = 0; place < places; place += step) context.fillText(`${tracks.frameAt(place)}`, NAMES + ((place + 0.5) / places) * across, 8);
    const reviewed = tracks.state.labels.frames;
    context.fillStyle = look.accent;
    reviewed.forEach(({ state }, place) => {
      if (state.startsWith("reviewed")) context.fillRect(NAMES + (place / places) * across, height - 7, Math.max(across / places, 0.6), 4);
    });
    context.strokeStyle = look.accent;
    const y = TOP + (matrix.top / Math.max(shown.length, 1)) * down;
    context.strokeRect(NAMES + (matrix.first / places) * across, y, (matrix.columns / places) * across, Math.min(down, Math.max(3, (matrix.visibleRows / Math.max(shown.length, 1)) * down)));
    this.#words(context, width, look);
  }

  /**
   * @param {Context} context
   * @param {number} width
   * @param {ReturnType<typeof theme>} look
   */
  #words(context, width, look) {
    const { tracks } = this;
    context.textAlign = "left";
    context.fillStyle = look.text;
    context.fillText("Whole drive", 12, 10);
    context.fillStyle = look.dim;
    tracks.summary().forEach((text, at) => context.fillText(text, 12, 28 + 15 * at));
  }

  /** Paints all cells, unless nothing has changed since.
   *
   * @param {number} width
   * @param {number} height
   * @param {ReturnType<typeof theme>} look
   */
  #paint(width, height, look) {
    const { tracks } = this, { places, shown, table } = tracks;
    const [columns, rows] = [Math.max(1, Math.min(Math.round(width), places)), Math.max(1, Math.min(Math.round(height), shown.length))];
    const key = [table.version, tracks.filterKey, columns, rows, tracks.state.theme].join(" ");
    if (key === this.key) return;
    this.key = key;
    const worst = new Int8Array(columns * rows).fill(-1); // 0 proposed, 1 without position, 2.. levels
    shown.forEach((row, at) => {
      const y = Math.floor((at / shown.length) * rows);
      const put = (/** @type {number} */ place, /** @type {number} */ level) => {
        const pixel = y * columns + Math.floor((place / places) * columns);
        if (level > worst[pixel]) worst[pixel] = level;
      };
      for (const side of [row.left, row.right]) side.forEach((code, step) => {
        if (code !== NOTHING) put(row.first + step, code >= 0 ? 2 + levelOf(code / 10) : code === UNPLACED ? 1 : code === PROPOSED ? 0 : -1);
      });
      for (const place of table.expected.get(row.number)?.keys() ?? []) put(place, 0);
    });
    this.picture.width = columns;
    this.picture.height = rows;
    const context = /** @type {Context} */ (this.picture.getContext("2d"));
    const colours = [look.hairline, look.faint, ...look.residual];
    worst.forEach((level, pixel) => {
      if (level < 0) return;
      context.fillStyle = colours[level];
      context.fillRect(pixel % columns, Math.floor(pixel / columns), 1, 1);
    });
  }
}
