// @ts-check
// The left image of the frame on screen, with its labels and the comments pinned on them.
/** @import {annotator} from "/static/protocol" */
/** @import {Pictures} from "../images/pictures.js" */
/** @import {State} from "../state.js" */
import { Surface } from "/static/canvas.js";
import { byId } from "/static/dom.js";
import { drawGlyph, drawLine, drawText } from "/static/glyphs.js";

const ZOOM = 8; // at most, of the whole image
const LEAST_PX = 40; // of the image, shown around a sign

export class TeamPicture {
  /**
   * @param {State} state
   * @param {Pictures} pictures
   */
  constructor(state, pictures) {
    this.state = state;
    this.pictures = pictures;
    /** @type {ImageBitmap | null} */
    this.bitmap = null;
    this.frame = -1; // whose image it is
    this.message = "";
    /** @type {annotator.QueueEntry | null} */
    this.entry = null;
    this.element = ""; // to which one zooms
    this.isZoomed = false;
    this.surface = new Surface(byId("team-picture", HTMLCanvasElement), (context, width, height) => this.#draw(context, width, height));
  }

  /**
   * @param {number | null} frame
   * @param {annotator.QueueEntry | null} entry
   * @param {string} element chosen for a comment
   */
  show(frame, entry, element) {
    this.entry = entry;
    this.element = element;
    if (frame !== null && frame !== this.frame) this.#load(frame);
    this.surface.redraw();
  }

  /** Shows the chosen element larger, or the whole image. */
  toggleZoom() {
    this.isZoomed = !this.isZoomed;
    this.surface.redraw();
  }

  /** Scale and place of the image: as large as it fits, or around the chosen element.
   *
   * @param {ImageBitmap} bitmap
   * @param {number} width
   * @param {number} height
   */
  #place(bitmap, width, height) {
    const whole = Math.min(width / bitmap.width, height / bitmap.height);
    const mark = this.state.elements.find(({ id }) => id === this.element)?.observations.left;
    if (!this.isZoomed || !mark) return { scale: whole, left: (width - whole * bitmap.width) / 2, top: 0 };
    const ends = mark.end ?? mark.anchor;
    const [u, v] = [(mark.anchor[0] + ends[0]) / 2, (mark.anchor[1] + ends[1]) / 2];
    const scale = Math.min(ZOOM * whole, height / (1.4 * Math.max(LEAST_PX, Math.abs(mark.anchor[1] - ends[1]))));
    return { scale, left: width / 2 - scale * (u + 0.5), top: height / 2 - scale * (v + 0.5) };
  }

  /** @param {number} frame */
  async #load(frame) {
    this.frame = frame;
    this.bitmap = null;
    this.message = "Loading the image …";
    const { bitmap, message } = await this.pictures.get(frame, "left");
    if (frame !== this.frame) return;
    this.bitmap = bitmap;
    this.message = message;
    if (!bitmap) this.frame = -1; // asked for again when the page changes, for example reconnects
    this.surface.redraw();
  }

  /**
   * @param {CanvasRenderingContext2D} context
   * @param {number} width
   * @param {number} height
   */
  #draw(context, width, height) {
    const { bitmap, state } = this;
    if (!bitmap) drawText(context, this.message, width / 2, height / 2, { align: "center" });
    if (!bitmap || this.frame !== state.frame) return;
    const { scale, left, top } = this.#place(bitmap, width, height);
    context.drawImage(bitmap, left, top, scale * bitmap.width, scale * bitmap.height);
    const at = (/** @type {[number, number]} */ [u, v]) => /** @type {[number, number]} */ ([left + scale * (u + 0.5), top + scale * (v + 0.5)]);
    const names = [];
    for (const element of state.elements) {
      const mark = element.observations.left;
      if (!mark || state.isHidden(element)) continue;
      const kind = state.classOf(element.class_id);
      const [x, y] = at(mark.anchor);
      if (mark.end) drawLine(context, [x, y], at(mark.end), kind.color);
      else drawGlyph(context, kind.shape, x, y, 7, kind.color);
      const notes = this.entry?.notes.filter(({ element: id }) => id === element.id) ?? [];
      names.push({ text: notes.length ? `${element.name} · ${notes.length}` : element.name, x, y, color: notes.length ? "#F5C542" : "#FFFFFF" });
    }
    drawNames(context, names.sort((a, b) => Number(b.color !== "#FFFFFF") - Number(a.color !== "#FFFFFF")), width);
  }
}

const NAME_PX = 13; // height of a name

/** Draws names beside their marks where none lies on another; where there is no room, none.
 *
 * @param {CanvasRenderingContext2D} context
 * @param {{text: string, x: number, y: number, color: string}[]} names the most important first
 * @param {number} width of the picture
 */
export function drawNames(context, names, width) {
  /** @type {[number, number, number][]} left, middle, width */
  const taken = [];
  for (const { text, x, y, color } of names) {
    drawText(context, "", 0, 0); // sets the font that is measured
    const long = context.measureText(text).width;
    const places = [[x + 8, y - 8], [x + 8, y + 9], [x - 8 - long, y - 8], [x - 8 - long, y + 9], [x + 8, y - 22], [x - 8 - long, y - 22]];
    const free = places.find(([left, middle]) => left >= 0 && left + long <= width && middle >= NAME_PX / 2
      && taken.every(([other, at, size]) => left > other + size + 3 || left + long + 3 < other || Math.abs(middle - at) > NAME_PX));
    if (!free) continue;
    taken.push([free[0], free[1], long]);
    drawText(context, text, free[0], free[1], { color });
  }
}
