// A cursor on the images that keys move: whatever a click draws can be drawn without a mouse.
import { SIDES, other } from "./state.js";

export class Cursor {
  constructor(state, images, tools) {
    this.state = state;
    this.images = images;
    this.tools = tools;
    for (const side of SIDES) images.canvas(side).addEventListener("pointermove", () => this.hide());
  }

  /** Whether the arrows are for the cursor: it is shown, or nothing is in hand that they could nudge. */
  get takesArrows() {
    return Boolean(this.state.cursor) || !this.state.selectedObservation;
  }

  /** Shows the cursor where the pointer was, or in the middle; shown already, it sets a point there. */
  setPoint() {
    const { cursor } = this.state;
    if (cursor) this.tools.setPoint(cursor.side, cursor.pixel);
    else this.#show();
  }

  /** By image pixels. */
  move(du, dv) {
    if (!this.state.cursor) {
      this.#show();
      return;
    }
    const { side, pixel } = this.state.cursor;
    this.#goTo(side, [pixel[0] + du, pixel[1] + dv]);
  }

  /** To the same place in the other image. */
  cross() {
    if (this.state.cursor) this.#goTo(other(this.state.cursor.side), this.state.cursor.pixel);
    else this.#show("right");
  }

  /** Returns whether it was shown. */
  hide() {
    const was = Boolean(this.state.cursor);
    if (was) {
      this.images.pointer = null;
      this.state.set({ cursor: null });
    }
    return was;
  }

  #show(side = "left") {
    const { pointer, view, stage } = this.images;
    const point = pointer?.point ?? stage.map((one) => one / 2);
    this.#goTo(pointer?.side ?? side, view.toImage(point).map(Math.round));
  }

  #goTo(side, [u, v]) {
    const { width, height } = this.state.hello.images[side] ?? {};
    if (!width) return;
    const tenth = (value) => Math.round(10 * value) / 10; // without the dust of many sums
    const pixel = [Math.min(Math.max(tenth(u), 0), width - 1), Math.min(Math.max(tenth(v), 0), height - 1)];
    this.images.reveal(pixel);
    this.images.pointer = { side, point: this.images.view.toScreen(pixel) }; // for the loupe
    this.state.set({ cursor: { side, pixel } });
    this.tools.stretchTo(side, pixel);
  }
}
