// @ts-check
/* The scatter panel: a click on a mark opens its frame. */

import { pointerAt } from "/static/canvas.js";
import { byId, el } from "/static/dom.js";
import { FrameCanvas } from "../image/frame_canvas.js";
import { changeMark } from "./marks.js";
import { Scatter, drawScatter } from "./scatter_drawing.js";

/** @typedef {import("/static/protocol").inspector.ComparedFrame} ComparedFrame */
/** @typedef {import("/static/protocol").inspector.ComparisonView} ComparisonView */
/** @typedef {import("/static/canvas.js").Point} Point */
/** @typedef {import("../panel.js").Context} Context */
/** @typedef {import("../panel.js").Figure} Figure */
/** @typedef {import("../main.js").Page} Page */

const HIT_PX = 12;
const NO_ERRORS = "No ground truth: fixed and broken are based on the status alone.";
/** @type {ComparedFrame["change"][]} */
const CHANGES = ["broken", "fixed", "same"];

export class ScatterPanel extends FrameCanvas {
  /** @type {Scatter | null} */
  scatter = null;
  /** @type {ComparedFrame | null} */
  pointed = null;

  /** @param {Page} page */
  constructor(page) {
    super(page, "scatter-canvas");
    page.socket.on("comparison", ({ comparison }) => this.showComparison(comparison));
    const { canvas } = this.surface;
    canvas.addEventListener("click", (event) => this.open(this.frameAt(pointerAt(event))));
    canvas.addEventListener("pointermove", (event) => this.point(this.frameAt(pointerAt(event))));
    canvas.addEventListener("pointerleave", () => this.point(null));
  }

  /** @param {ComparisonView} comparison */
  showComparison({ frames }) {
    this.scatter = new Scatter(frames);
    this.pointed = null;
    /** @param {ComparedFrame["change"]} change */
    const count = (change) => frames.filter((frame) => frame.change === change).length;
    byId("scatter-legend").replaceChildren(...CHANGES.flatMap((change) =>
      [changeMark(change), el("span", { text: `${count(change)} ${change}` })]));
    const missing = frames.length - this.scatter.frames.length;
    byId("scatter-about").textContent = missing ? `${missing} frames lack ground truth` : "click to open a frame";
    byId("scatter-none").textContent = this.scatter.hasErrors ? "" : NO_ERRORS;
    this.surface.redraw();
  }

  /** @returns {Figure[]} */
  figures() {
    return this.surface.width && this.scatter?.hasErrors ? [this.surface.figure("scatter", "Error, A against B")] : [];
  }

  /** @param {ComparedFrame | null} frame */
  open(frame) {
    if (frame) this.page.go(frame.position);
  }

  /** @param {ComparedFrame | null} frame */
  point(frame) {
    if (frame === this.pointed) return;
    this.pointed = frame;
    this.surface.canvas.style.cursor = frame ? "pointer" : "default";
    this.surface.redraw();
  }

  /** The frame of the nearest mark, the top one of several. Frames without a pose in both runs share
   * a mark, which leads to the one after the current frame.
   *
   * @param {Point} point
   */
  frameAt([x, y]) {
    if (!this.scatter?.hasErrors) return null;
    const layout = this.scatter.layout(this.surface.width, this.surface.height);
    /** @type {ComparedFrame | null} */
    let best = null;
    let nearestPx = HIT_PX;
    for (const frame of this.scatter.frames) {
      const [u, v] = layout.at(frame);
      const far = Math.hypot(u - x, v - y);
      if (far > nearestPx || (far === nearestPx && best && best.position > this.position)) continue;
      [best, nearestPx] = [frame, far];
    }
    return best;
  }

  /**
   * @param {Context} context
   * @param {number} width
   * @param {number} height
   */
  draw(context, width, height) {
    if (!this.scatter?.hasErrors) return;
    const current = this.scatter.frames.find((frame) => frame.position === this.position) ?? null;
    drawScatter(context, this.scatter, width, height, { current, pointed: this.pointed });
  }
}
