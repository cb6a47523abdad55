// @ts-check
// A cursor on the images that keys move, so that drawing needs no mouse.
/** @import {Images} from "./images.js" */
/** @import {State} from "../state.js" */
/** @import {Tools} from "./tools.js" */
/** @import {Point, Side} from "../values.js" */
import { SIDES, other } from "../values.js";

export class Cursor {
  /**
   * @param {State} state
   * @param {Images} images
   * @param {Tools} tools
   */
  constructor(state, images, tools) {
    this.state = state;
    this.images = images;
    this.tools = tools;
    for (const side of SIDES) images.canvas(side).addEventListener("pointermove", () => this.hide());
  }

  /** Whether the arrow keys move the cursor: it is shown, or no observation is selected. */
  get takesArrows() {
    return Boolean(this.state.cursor) || !this.state.selectedObservation;
  }

  /** Shows the cursor at the last pointer position or in the middle; if it is shown, sets a point. */
  setPoint() {
    const { cursor } = this.state;
    if (cursor) this.tools.setPoint(cursor.side, cursor.pixel);
    else this.#show();
  }

  /** Moves the cursor by image pixels.
   *
   * @param {number} du
   * @param {number} dv
   */
  move(du, dv) {
    if (!this.state.cursor) {
      this.#show();
      return;
    }
    const { side, pixel } = this.state.cursor;
    this.#goTo(side, [pixel[0] + du, pixel[1] + dv]);
  }

  /** Moves the cursor to the same pixel of the other image. */
  cross() {
    if (this.state.cursor) this.#goTo(other(this.state.cursor.side), this.state.cursor.pixel);
    else this.#show("right");
  }

  /** Hides the cursor. Returns whether it was shown. */
  hide() {
    const was = Boolean(this.state.cursor);
    if (was) {
      this.images.pointer = null;
      this.state.set({ cursor: null });
    }
    return was;
  }

  /** @param {Side} side */
  #show(side = "left") {
    const { pointer, view, stage } = this.images;
    const [u, v] = view.toImage(pointer?.point ?? [stage[0] / 2, stage[1] / 2]);
    this.#goTo(pointer?.side ?? side, [Math.round(u), Math.round(v)]);
  }

  /**
   * @param {Side} side
   * @param {Point} pixel
   */
  #goTo(side, [u, v]) {
    const size = this.state.workspace.images[side];
    if (!size) return;
    const { width, height } = size;
    const tenth = (/** @type {number} */ value) => Math.round(10 * value) / 10; // without accumulated rounding errors
    /** @type {Point} */
    const pixel = [Math.min(Math.max(tenth(u), 0), width - 1), Math.min(Math.max(tenth(v), 0), height - 1)];
    this.images.reveal(pixel);
    this.images.pointer = { side, point: this.images.view.toScreen(pixel) }; // for the loupe
    this.state.set({ cursor: { side, pixel } });
    this.tools.stretchTo(side, pixel);
    this.tools.seek(side, pixel);
  }
}
