// @ts-check
// The left image of the frame on screen, with its labels and the comments pinned on them.
/** @import {annotator} from "/static/protocol" */
/** @import {Pictures} from "./pictures.js" */
/** @import {State} from "./state.js" */
import { Surface } from "/static/canvas.js";
import { byId } from "/static/dom.js";
import { drawGlyph, drawLine, drawText } from "/static/glyphs.js";

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
    /** @type {annotator.QueueEntry | null} */
    this.entry = null;
    this.surface = new Surface(byId("team-picture", HTMLCanvasElement), (context, width, height) => this.#draw(context, width, height));
  }

  /**
   * @param {number | null} frame
   * @param {annotator.QueueEntry | null} entry
   */
  show(frame, entry) {
    this.entry = entry;
    if (frame !== null && frame !== this.frame) this.#load(frame);
    this.surface.redraw();
  }

  /** @param {number} frame */
  async #load(frame) {
    this.frame = frame;
    const { bitmap } = await this.pictures.get(frame, "left");
    if (frame !== this.frame) return;
    this.bitmap = bitmap;
    this.surface.redraw();
  }

  /**
   * @param {CanvasRenderingContext2D} context
   * @param {number} width
   * @param {number} height
   */
  #draw(context, width, height) {
    const { bitmap, state } = this;
    if (!bitmap || this.frame !== state.frame) return;
    const scale = Math.min(width / bitmap.width, height / bitmap.height);
    const left = (width - scale * bitmap.width) / 2, top = 0;
    context.drawImage(bitmap, left, top, scale * bitmap.width, scale * bitmap.height);
    const at = (/** @type {[number, number]} */ [u, v]) => /** @type {[number, number]} */ ([left + scale * (u + 0.5), top + scale * (v + 0.5)]);
    for (const element of state.elements) {
      const mark = element.observations.left;
      if (!mark || state.isHidden(element)) continue;
      const kind = state.classOf(element.class_id);
      const [x, y] = at(mark.anchor);
      if (mark.end) drawLine(context, [x, y], at(mark.end), kind.color);
      else drawGlyph(context, kind.shape, x, y, 7, kind.color);
      const notes = this.entry?.notes.filter(({ element: id }) => id === element.id) ?? [];
      drawText(context, notes.length ? `${element.name} · ${notes.length}` : element.name, x + 8, y - 8, { color: notes.length ? "#F5C542" : "#FFFFFF" });
    }
  }
}
