/* Error over the run, on a log scale; a click or a drag goes to a frame. */

import { cssColor } from "/static/canvas.js";
import { byId, fixed } from "/static/dom.js";
import { drawMark } from "/static/glyphs.js";
import { drawChanges } from "./compare/error_lines.js";
import { ClockCanvas } from "./frame_canvas.js";
import { Clock, drawCursor, drawFrameNumbers, drawScale } from "./timeline_drawing.js";

const STATUS_PX = 26; // from the bottom: status line
const FLOOR_PX = 40; // from the bottom: foot of the bars
const AGAINST_PX = 18; // the line of fixed and broken frames takes so much more

export class Timeline extends ClockCanvas {
  constructor(page) {
    super(page, "timeline-canvas");
    this.changed = null; // a frame of both runs, or null, for each position, where there is another run
  }

  says(position) {
    const row = this.run?.frames[position];
    return row ? `Frame ${row.index}: ${row.verdict}` : "";
  }

  showRun(run) {
    if (run.name !== this.run?.name) this.compareWith("");
    this.run = run;
    this.forecast = null;
    this.mostM = run.frames.reduce((most, row) => Math.max(most, row.errorM ?? 0), 1);
    byId("median").textContent = run.medianM === null ? "no truth" : `median ${fixed(run.medianM, 2)} m`;
    byId("ok-share").textContent = `${Math.round(100 * (run.okShare ?? 0))} % ok`;
    this.surface.redraw();
  }

  figures() {
    return this.run && this.surface.width ? [this.surface.figure("timeline", "Timeline")] : [];
  }

  showState(state) {
    if (this.changed && state.base !== this.against) this.compareWith("");
    if (state.forecast === this.withForecast) return;
    this.withForecast = state.forecast;
    this.drawAgain();
  }

  showForecast(forecast) {
    this.forecast = forecast.ready ? forecast : null;
    this.drawAgain();
  }

  showComparison({ frames, base }) {
    const changed = Array(this.run.frames.length).fill(null);
    for (const one of frames) changed[one.position] = one;
    this.compareWith(base.name, changed);
  }

  /** Another line, of the frames that are fixed or broken against another run. */
  compareWith(name, changed = null) {
    this.changed = changed;
    this.against = name;
    const count = (change) => changed.filter((one) => one?.change === change).length;
    byId("timeline").classList.toggle("against", Boolean(changed));
    byId("against").textContent = byId("against").title = changed ? `Against ${name}` : "";
    byId("against-counts").textContent = changed ? `+${count("fixed")} fixed, −${count("broken")}` : "";
    byId("against-counts").title = "fixed and broken frames";
    this.surface.redraw();
  }

  drawAgain() {
    const shown = this.withForecast && this.forecast;
    byId("forecast-mean").textContent = shown ? `forecast ${fixed(this.forecast.meanM, 2)} m` : "";
    this.surface.redraw();
  }

  draw(context, width, height) {
    if (!this.run) return;
    const { frames } = this.run;
    const more = this.changed ? AGAINST_PX : 0;
    const statusY = height - STATUS_PX - more;
    const clock = new Clock(width, height - FLOOR_PX - more, frames.length, this.mostM);
    this.clock = clock;
    drawScale(context, clock);
    const colors = Object.fromEntries(["ok", "ambiguous", "cannot"].map((one) => [one, cssColor(`--${one}`)]));
    drawBars(context, clock, frames, colors);
    if (this.withForecast && this.forecast) drawForecast(context, clock, this.forecast.expectedM);
    drawStatus(context, clock, frames, statusY, colors);
    if (this.changed) drawChanges(context, clock, this.changed, statusY + AGAINST_PX);
    drawFrameNumbers(context, clock, frames, height - 4);
    drawCursor(context, clock.x(this.position), height - STATUS_PX + 6);
  }
}

/** The errors; a wide pale bar where there is none. */
function drawBars(context, clock, frames, colors) {
  const { slot, floor } = clock;
  const bar = Math.min(18, Math.max(1, slot - (slot > 3 ? 1 : 0)));
  frames.forEach((row, position) => {
    const x = clock.x(position);
    context.fillStyle = colors[row.status];
    if (row.errorM === null) {
      context.globalAlpha = row.status === "cannot" ? 0.22 : 0.1;
      context.fillRect(x - slot / 2, 4, slot, floor - 4);
    } else {
      context.globalAlpha = row.status === "ok" ? 0.62 : 1;
      const top = Math.min(clock.y(row.errorM), floor - 1);
      context.fillRect(x - bar / 2, top, bar, floor - top);
      context.globalAlpha = 1;
      context.fillStyle = colors.cannot;
      if (row.sureAndWrong) context.fillRect(x - bar / 2, top - 4, bar, 3);
    }
    context.globalAlpha = 1;
  });
}

/** A line over the bars: the error that the map alone lets one expect. */
function drawForecast(context, clock, expectedM) {
  context.beginPath();
  let before = null;
  expectedM.forEach((error, position) => {
    const at = [clock.x(position), error === null ? null : clock.y(error)];
    if (error !== null && before !== null) context.lineTo(...at);
    else if (error !== null) context.moveTo(...at);
    before = error;
  });
  context.strokeStyle = cssColor("--text");
  context.lineWidth = 1.2;
  context.stroke();
}

function drawStatus(context, clock, frames, y, colors) {
  context.fillStyle = colors.ok;
  context.fillRect(clock.left, y - 0.75, clock.width - clock.left, 1.5);
  frames.forEach(({ status }, position) => {
    if (status !== "ok") drawMark(context, status, clock.x(position), y, Math.min(3.5, Math.max(2, clock.slot / 2)), colors[status]);
  });
}
