// @ts-check
/* Error over the run, on a log scale; a click or a drag goes to a frame. */

import { cssColor } from "/static/canvas.js";
import { byId, fixed } from "/static/dom.js";
import { drawMark } from "/static/glyphs.js";
import { drawChanges } from "../compare/error_lines.js";
import { TimelineCanvas } from "../image/frame_canvas.js";
import { severity } from "../frames.js";
import { TimelineAxes, drawCursor, drawFrameNumbers, drawScale } from "./timeline_drawing.js";

/** @typedef {import("/static/protocol").inspector.ComparedFrame} ComparedFrame */
/** @typedef {import("/static/protocol").inspector.ComparisonView} ComparisonView */
/** @typedef {import("/static/protocol").inspector.ForecastEvent} ForecastEvent */
/** @typedef {import("/static/protocol").inspector.ForecastView} ForecastView */
/** @typedef {import("../run_rows.js").FrameRow} FrameRow */
/** @typedef {import("../run_rows.js").OpenRun} OpenRun */
/** @typedef {import("/static/protocol").inspector.StateView} StateView */
/** @typedef {FrameRow["status"]} Status */
/** @typedef {import("../panel.js").Context} Context */
/** @typedef {import("../main.js").Page} Page */

const STATUS_PX = 26; // status line, from the bottom
const FLOOR_PX = 40; // foot of the bars, from the bottom
const CHANGES_PX = 18; // height of the line of fixed and broken frames

/** @typedef {{row: FrameRow, position: number}} Placed a frame at its position */

export class Timeline extends TimelineCanvas {
  /** Frames of both runs by position, null for frames of one; null without a comparison.
   *
   * @type {(ComparedFrame | null)[] | null} */
  changed = null;
  /** @type {OpenRun | null} */
  run = null;
  /** @type {ForecastView | null} */
  forecast = null;
  maxErrorM = 1;
  /** The frames that are drawn for this many pixels a frame.
   *
   * @type {{slot: number, frames: Placed[]}} */
  drawn = { slot: 0, frames: [] };
  withForecast = false;
  base = "";

  /** @param {Page} page */
  constructor(page) {
    super(page, "timeline-canvas");
    page.socket.on("forecast", (event) => this.showForecast(event));
    page.socket.on("comparison", ({ comparison }) => this.showComparison(comparison));
  }

  /** @param {number} position */
  titleOf(position) {
    const row = this.run?.frames[position];
    return row ? `Frame ${row.index}: ${row.diagnosis}` : "";
  }

  /** @param {OpenRun} run */
  showRun(run) {
    if (run.name !== this.run?.name) this.compareWith("");
    this.run = run;
    this.forecast = null;
    this.drawn = { slot: 0, frames: [] };
    this.maxErrorM = run.frames.reduce((most, row) => Math.max(most, row.error_m ?? 0), 1);
    byId("median").textContent = run.median_m === null ? "no ground truth" : `median ${fixed(run.median_m, 2)} m`;
    byId("ok-share").textContent = `${Math.round(100 * run.ok_share)} % ok`;
    this.surface.redraw();
  }

  figures() {
    return this.run && this.surface.width ? [this.surface.figure("timeline", "Timeline")] : [];
  }

  /** @param {StateView} state */
  showState(state) {
    if (this.changed && state.base !== this.base) this.compareWith("");
    if (state.forecast === this.withForecast) return;
    this.withForecast = state.forecast;
    this.showMean();
  }

  /** @param {ForecastEvent} forecast */
  showForecast(forecast) {
    this.forecast = forecast.found;
    this.showMean();
  }

  /** @param {ComparisonView} comparison */
  showComparison({ frames, base }) {
    /** @type {(ComparedFrame | null)[]} */
    const changed = Array(this.page.store.run.frames.length).fill(null);
    for (const frame of frames) changed[frame.position] = frame;
    this.compareWith(base.name, changed);
  }

  /** Adds a line with the frames that are fixed or broken compared with another run.
   *
   * @param {string} name
   * @param {(ComparedFrame | null)[] | null} [changed]
   */
  compareWith(name, changed = null) {
    this.changed = changed;
    this.base = name;
    /** @param {ComparedFrame["change"]} change */
    const count = (change) => (changed ?? []).filter((frame) => frame?.change === change).length;
    byId("timeline").classList.toggle("against", Boolean(changed));
    byId("against").textContent = byId("against").title = changed ? `Against ${name}` : "";
    byId("against-counts").textContent = changed ? `+${count("fixed")} fixed, −${count("broken")}` : "";
    byId("against-counts").title = "fixed and broken frames";
    this.surface.redraw();
  }

  showMean() {
    const shown = this.withForecast ? this.forecast : null;
    byId("forecast-mean").textContent = shown ? `forecast ${fixed(shown.mean_m, 2)} m` : "";
    this.surface.redraw();
  }

  /** The frames to draw, found once for a run and a width.
   *
   * @param {number} slot pixels a frame
   */
  frames(slot) {
    if (this.run && this.drawn.slot !== slot) this.drawn = { slot, frames: worstPerPixel(this.run.frames, slot) };
    return this.drawn;
  }

  /**
   * @param {Context} context
   * @param {number} width
   * @param {number} height
   */
  draw(context, width, height) {
    if (!this.run) return;
    const { frames } = this.run;
    const extra = this.changed ? CHANGES_PX : 0;
    const statusY = height - STATUS_PX - extra;
    const axes = new TimelineAxes(width, height - FLOOR_PX - extra, frames.length, this.maxErrorM);
    this.axes = axes;
    drawScale(context, axes);
    const colors = { ok: cssColor("--ok"), ambiguous: cssColor("--ambiguous"), cannot: cssColor("--cannot") };
    const { frames: shown } = this.frames(axes.slot);
    drawBars(context, axes, shown, colors);
    if (this.withForecast && this.forecast) drawForecast(context, axes, this.forecast.expected_m);
    drawStatus(context, axes, shown, statusY, colors);
    if (this.changed) drawChanges(context, axes, this.changed, statusY + CHANGES_PX);
    drawFrameNumbers(context, axes, frames, height - 4);
    drawCursor(context, axes.x(this.position), height - STATUS_PX + 6);
  }
}

/** All frames, or the worst one of those that share a pixel.
 *
 * @param {FrameRow[]} frames
 * @param {number} slot pixels a frame
 * @returns {Placed[]}
 */
export function worstPerPixel(frames, slot) {
  /** @type {Placed[]} */
  const worst = [];
  let last = -1; // pixel
  frames.forEach((row, position) => {
    const pixel = slot < 1 ? Math.floor(position * slot) : position;
    const before = worst.at(-1);
    if (pixel !== last) worst.push({ row, position });
    else if (before && severity(row) > severity(before.row)) worst[worst.length - 1] = { row, position };
    last = pixel;
  });
  return worst;
}

/** The errors as bars; frames without an error get a wide pale bar.
 *
 * @param {Context} context
 * @param {TimelineAxes} axes
 * @param {Placed[]} frames
 * @param {Record<Status, string>} colors
 */
function drawBars(context, axes, frames, colors) {
  const { slot, floor } = axes;
  const bar = Math.min(18, Math.max(1, slot - (slot > 3 ? 1 : 0)));
  frames.forEach(({ row, position }) => {
    const x = axes.x(position);
    context.fillStyle = colors[row.status];
    if (row.error_m === null) {
      context.globalAlpha = row.status === "cannot" ? 0.22 : 0.1;
      context.fillRect(x - slot / 2, 4, Math.max(slot, 1), floor - 4);
    } else {
      context.globalAlpha = row.status === "ok" ? 0.62 : 1;
      const top = Math.min(axes.y(row.error_m), floor - 1);
      context.fillRect(x - bar / 2, top, bar, floor - top);
      context.globalAlpha = 1;
      context.fillStyle = colors.cannot;
      if (row.overconfident) context.fillRect(x - bar / 2, top - 4, bar, 3);
    }
    context.globalAlpha = 1;
  });
}

/** The expected error as a line over the bars.
 *
 * @param {Context} context
 * @param {TimelineAxes} axes
 * @param {(number | null)[]} expectedM
 */
function drawForecast(context, axes, expectedM) {
  context.beginPath();
  let isDrawn = false; // the frame before
  expectedM.forEach((error, position) => {
    if (error !== null) {
      const [x, y] = [axes.x(position), axes.y(error)];
      if (isDrawn) context.lineTo(x, y);
      else context.moveTo(x, y);
    }
    isDrawn = error !== null;
  });
  context.strokeStyle = cssColor("--text");
  context.lineWidth = 1.2;
  context.stroke();
}

/**
 * @param {Context} context
 * @param {TimelineAxes} axes
 * @param {Placed[]} frames
 * @param {number} y
 * @param {Record<Status, string>} colors
 */
function drawStatus(context, axes, frames, y, colors) {
  context.fillStyle = colors.ok;
  context.fillRect(axes.left, y - 0.75, axes.width - axes.left, 1.5);
  frames.forEach(({ row: { status }, position }) => {
    if (status !== "ok") drawMark(context, status, axes.x(position), y, Math.min(3.5, Math.max(2, axes.slot / 2)), colors[status]);
  });
}
