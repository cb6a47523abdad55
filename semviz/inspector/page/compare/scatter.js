/* The panel of the scatter: a mark opens its frame. */

import { pointerAt } from "/static/canvas.js";
import { byId, el } from "/static/dom.js";
import { FrameCanvas } from "../frame_canvas.js";
import { changeMark } from "./marks.js";
import { Scatter, drawScatter } from "./scatter_drawing.js";

const HIT_PX = 12;
const NO_ERRORS = "No true poses, so no errors: fixed and broken go by the status alone.";

export class ScatterPanel extends FrameCanvas {
  constructor(page) {
    super(page, "scatter-canvas");
    this.scatter = null;
    this.pointed = null;
    const { canvas } = this.surface;
    canvas.addEventListener("click", (event) => this.open(this.frameAt(pointerAt(event))));
    canvas.addEventListener("pointermove", (event) => this.point(this.frameAt(pointerAt(event))));
    canvas.addEventListener("pointerleave", () => this.point(null));
  }

  showComparison({ frames }) {
    this.scatter = new Scatter(frames);
    this.pointed = null;
    const count = (change) => frames.filter((one) => one.change === change).length;
    byId("scatter-legend").replaceChildren(...["broken", "fixed", "same"].flatMap((change) =>
      [changeMark(change), el("span", { text: `${count(change)} ${change}` })]));
    const untold = frames.length - this.scatter.frames.length;
    byId("scatter-about").textContent = untold ? `without ${untold} frames of unknown truth` : "click opens a frame";
    byId("scatter-none").textContent = this.scatter.hasErrors ? "" : NO_ERRORS;
    this.surface.redraw();
  }

  figures() {
    return this.surface.width && this.scatter?.hasErrors ? [this.surface.figure("scatter", "Error, A against B")] : [];
  }

  open(frame) {
    if (frame) this.page.go(frame.position);
  }

  point(frame) {
    if (frame === this.pointed) return;
    this.pointed = frame;
    this.surface.canvas.style.cursor = frame ? "pointer" : "default";
    this.surface.redraw();
  }

  /** The frame whose mark is nearest, the one on top where several are. Of those without a pose in
   * both, which are one mark, the one after the current frame. */
  frameAt([x, y]) {
    if (!this.scatter?.hasErrors) return null;
    const layout = this.scatter.layout(this.surface.width, this.surface.height);
    let best = null;
    let least = HIT_PX;
    for (const frame of this.scatter.frames) {
      const [u, v] = layout.at(frame);
      const far = Math.hypot(u - x, v - y);
      if (far > least || (far === least && best && best.position > this.position)) continue;
      [best, least] = [frame, far];
    }
    return best;
  }

  draw(context, width, height) {
    if (!this.scatter?.hasErrors) return;
    const current = this.scatter.frames.find((one) => one.position === this.position) ?? null;
    drawScatter(context, this.scatter, width, height, { current, pointed: this.pointed });
  }
}
