// @ts-check
/* The errors of A and B over the frames of B as two lines, and the changed frames. */

import { cssColor } from "/static/canvas.js";
import { byId, el } from "/static/dom.js";
import { TimelineCanvas } from "../image/frame_canvas.js";
import { TimelineAxes, drawCursor, drawFrameNumbers, drawScale } from "../timeline/timeline_drawing.js";
import { drawChange } from "./marks.js";

/** @typedef {import("/static/protocol").inspector.ComparedFrame} ComparedFrame */
/** @typedef {import("/static/protocol").inspector.ComparisonView} ComparisonView */
/** @typedef {import("../panel.js").Context} Context */
/** @typedef {import("../panel.js").Figure} Figure */
/** @typedef {import("../main.js").Page} Page */

const CHANGES_PX = 26; // from the bottom
const FLOOR_PX = 40;
const STYLES = {
  a: { color: "--dim", width: 1.2, dash: [3, 3], missing: 3 },
  b: { color: "--estimate", width: 1.8, dash: [], missing: 9 },
};

export class ErrorLines extends TimelineCanvas {
  /** Frames of both runs by position; null for frames of one run.
   *
   * @type {(ComparedFrame | null)[] | null} */
  rows = null;
  maxErrorM = 1;

  /** @param {Page} page */
  constructor(page) {
    super(page, "error-lines-canvas");
    page.socket.on("comparison", ({ comparison }) => this.showComparison(comparison));
  }

  /** @param {number} position */
  titleOf(position) {
    const row = this.rows?.[position];
    return row ? `Frame ${row.index}: ${row.change}` : "";
  }

  /** @param {ComparisonView} comparison */
  showComparison({ frames, base, other }) {
    /** @type {(ComparedFrame | null)[]} */
    const rows = Array(this.page.store.run.frames.length).fill(null);
    for (const frame of frames) rows[frame.position] = frame;
    this.rows = rows;
    const errors = frames.flatMap(({ a, b }) => [a.error_m ?? 0, b.error_m ?? 0]);
    this.maxErrorM = errors.reduce((a, b) => Math.max(a, b), 1);
    /** @type {(name: string, run: string) => HTMLElement} */
    const entry = (name, run) => el("span", {}, el("i", { class: `line run-${name}` }), el("span", { text: `${name.toUpperCase()} ${run}`, title: run }));
    byId("error-lines-legend").replaceChildren(entry("a", base.name), entry("b", other),
      el("span", {}, el("i", { class: "no-pose" }), el("span", { text: "no pose" })));
    this.surface.redraw();
  }

  /** @returns {Figure[]} */
  figures() {
    return this.surface.width && this.rows ? [this.surface.figure("errors", "Errors of A and B")] : [];
  }

  /**
   * @param {Context} context
   * @param {number} width
   * @param {number} height
   */
  draw(context, width, height) {
    if (!this.rows) return;
    const { frames } = this.page.store.run;
    this.axes = new TimelineAxes(width, height - FLOOR_PX, frames.length, this.maxErrorM);
    drawErrorLines(context, this.axes, this.rows, height - CHANGES_PX);
    drawFrameNumbers(context, this.axes, frames, height - 4);
    drawCursor(context, this.axes.x(this.position), height - CHANGES_PX + 6);
  }
}

/** Draws both lines and the changed frames; `rows` by position.
 *
 * @param {Context} context
 * @param {TimelineAxes} axes
 * @param {(ComparedFrame | null)[]} rows
 * @param {number} changesY
 */
export function drawErrorLines(context, axes, rows, changesY) {
  drawScale(context, axes);
  drawLine(context, axes, rows, "a");
  drawLine(context, axes, rows, "b");
  drawChanges(context, axes, rows, changesY);
}

/** One run's errors; frames without a pose get a bar at the top.
 *
 * @param {Context} context
 * @param {TimelineAxes} axes
 * @param {(ComparedFrame | null)[]} rows
 * @param {"a" | "b"} side
 */
function drawLine(context, axes, rows, side) {
  const { color, width, dash, missing } = STYLES[side];
  context.strokeStyle = context.fillStyle = cssColor(color);
  context.lineWidth = width;
  context.setLineDash(dash);
  context.beginPath();
  let isDrawn = false; // the frame before
  rows.forEach((row, position) => {
    const error = row?.[side].error_m ?? null;
    const x = axes.x(position);
    if (error !== null) {
      if (!isDrawn) context.moveTo(x - Math.min(axes.slot / 2, 2), axes.y(error));
      context.lineTo(x, axes.y(error));
    } else if (row?.[side].status === "cannot") {
      context.fillRect(x - axes.slot / 2, missing, Math.max(axes.slot, 1.5), 3);
    }
    isDrawn = error !== null;
  });
  context.stroke();
  context.setLineDash([]);
}

/** A thin line with marks at fixed and broken frames.
 *
 * @param {Context} context
 * @param {TimelineAxes} axes
 * @param {(ComparedFrame | null)[]} rows
 * @param {number} y
 */
export function drawChanges(context, axes, rows, y) {
  context.fillStyle = cssColor("--hairline");
  context.fillRect(axes.left, y - 0.5, axes.width - axes.left, 1);
  rows.forEach((row, position) => {
    if (row && row.change !== "same") drawChange(context, row.change, axes.x(position), y, Math.min(5, Math.max(3, axes.slot / 2)));
  });
}
