// @ts-check
/* Base classes of the panels that draw all frames of a run and mark the current one. */

import { Surface, pointerAt } from "/static/canvas.js";
import { byId } from "/static/dom.js";

/** @typedef {import("/static/protocol").inspector.FrameView} FrameView */
/** @typedef {import("../timeline/timeline_drawing.js").TimelineAxes} TimelineAxes */
/** @typedef {import("../panel.js").Context} Context */
/** @typedef {import("../main.js").Page} Page */

export class FrameCanvas {
  /**
   * @param {Page} page
   * @param {string} id
   */
  constructor(page, id) {
    this.page = page;
    this.position = 0;
    this.surface = new Surface(byId(id, HTMLCanvasElement), (...size) => this.draw(...size));
  }

  /** Overridden by each panel.
   *
   * @param {Context} _context
   * @param {number} _width
   * @param {number} _height
   */
  draw(_context, _width, _height) {}

  /** @param {FrameView} frame */
  showFrame(frame) {
    this.pointAt(frame.position);
  }

  /** @param {number} position */
  pointAt(position) {
    if (position === this.position) return;
    this.position = position;
    this.surface.redraw();
  }

  showTheme() {
    this.surface.redraw();
  }
}

/** With frames along an axis: a press or a drag goes to a frame. `draw` sets `axes`. */
export class TimelineCanvas extends FrameCanvas {
  /** @type {TimelineAxes | null} */
  axes = null;

  /**
   * @param {Page} page
   * @param {string} id
   */
  constructor(page, id) {
    super(page, id);
    const { canvas } = this.surface;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.goTo(event);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (event.buttons & 1) this.goTo(event);
      if (this.axes) canvas.title = this.titleOf(this.axes.positionAt(pointerAt(event)[0]));
    });
  }

  /** The tooltip of the frame under the pointer.
   *
   * @param {number} _position
   */
  titleOf(_position) {
    return "";
  }

  /** @param {PointerEvent} event */
  goTo(event) {
    if (!this.axes) return;
    const position = this.axes.positionAt(pointerAt(event)[0]);
    if (position !== this.page.store.target) this.page.go(position);
  }
}
