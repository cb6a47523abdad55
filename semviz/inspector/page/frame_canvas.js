/* Canvases that mark the frame on screen: what the panels that draw all frames of a run share. */

import { Surface, pointerAt } from "/static/canvas.js";
import { byId } from "/static/dom.js";

export class FrameCanvas {
  /** `draw(context, width, height)` is the panel's own. */
  constructor(page, id) {
    this.page = page;
    this.position = 0;
    this.surface = new Surface(byId(id), (...size) => this.draw(...size));
  }

  showFrame(frame) {
    this.pointAt(frame.position);
  }

  pointAt(position) {
    if (position === this.position) return;
    this.position = position;
    this.surface.redraw();
  }

  showTheme() {
    this.surface.redraw();
  }
}

/** On a frame clock: a press or a drag goes to a frame. `draw` keeps the `clock` it draws on, `says(position)`
 * is what the pointer is told. */
export class ClockCanvas extends FrameCanvas {
  constructor(page, id) {
    super(page, id);
    const { canvas } = this.surface;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.goTo(event);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (event.buttons & 1) this.goTo(event);
      if (this.clock) canvas.title = this.says(this.clock.positionAt(pointerAt(event)[0]));
    });
  }

  goTo(event) {
    if (!this.clock) return;
    const position = this.clock.positionAt(pointerAt(event)[0]);
    if (position !== this.page.wanted) this.page.go(position);
  }
}
