/* Error over the run, on a log scale; a click or a drag goes to a frame. */

import { Surface, cssColor, pointerAt } from "/static/canvas.js";
import { byId, fixed } from "/static/dom.js";
import { drawMark } from "/static/glyphs.js";

const AXIS_PX = 34; // room for the scale on the left
const STATUS_PX = 26; // from the bottom: status line
const FLOOR_PX = 40; // from the bottom: foot of the bars
const LEAST_M = 0.01;

export class Timeline {
  constructor(page) {
    this.page = page;
    this.position = 0;
    const canvas = byId("timeline-canvas");
    this.surface = new Surface(canvas, (...size) => this.draw(...size));
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.goTo(event);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (event.buttons & 1) this.goTo(event);
      const row = this.run?.frames[this.positionAt(pointerAt(event)[0])];
      if (row) canvas.title = `Frame ${row.index}: ${row.verdict}`;
    });
  }

  showRun(run) {
    this.run = run;
    this.forecast = null;
    const largest = Math.max(1, ...run.frames.map((row) => row.errorM ?? 0));
    this.most = 10 ** Math.ceil(Math.log10(largest) - 1e-9);
    byId("median").textContent = run.medianM === null ? "no truth" : `median ${fixed(run.medianM, 2)} m`;
    byId("ok-share").textContent = `${Math.round(100 * (run.okShare ?? 0))} % ok`;
    this.surface.redraw();
  }

  figures() {
    return this.run ? [this.surface.figure("timeline", "Timeline")] : [];
  }

  showFrame(frame) {
    this.pointAt(frame.position);
  }

  pointAt(position) {
    this.position = position;
    this.surface.redraw();
  }

  showState(state) {
    if (state.forecast === this.withForecast) return;
    this.withForecast = state.forecast;
    this.drawAgain();
  }

  showForecast(forecast) {
    this.forecast = forecast.ready ? forecast : null;
    this.drawAgain();
  }

  drawAgain() {
    const shown = this.withForecast && this.forecast;
    byId("forecast-mean").textContent = shown ? `forecast ${fixed(this.forecast.meanM, 2)} m` : "";
    this.surface.redraw();
  }

  showTheme() {
    this.surface.redraw();
  }

  positionAt(x) {
    const count = this.run.frames.length;
    const share = (x - AXIS_PX) / (this.surface.width - AXIS_PX);
    return Math.min(count - 1, Math.max(0, Math.floor(share * count)));
  }

  goTo(event) {
    if (!this.run) return;
    const position = this.positionAt(pointerAt(event)[0]);
    if (position !== this.page.wanted) this.page.go(position);
  }

  draw(context, width, height) {
    if (!this.run) return;
    const { frames } = this.run;
    const slot = (width - AXIS_PX) / frames.length;
    const floor = height - FLOOR_PX;
    const y = (error) => floor - (Math.log10(Math.max(error, LEAST_M) / LEAST_M) / Math.log10(this.most / LEAST_M)) * (floor - 10);
    this.drawScale(context, width, y);
    const colors = Object.fromEntries(["ok", "ambiguous", "cannot"].map((one) => [one, cssColor(`--${one}`)]));
    const bar = Math.min(18, Math.max(1, slot - (slot > 3 ? 1 : 0)));
    frames.forEach((row, position) => {
      const x = AXIS_PX + (position + 0.5) * slot;
      context.fillStyle = colors[row.status];
      if (row.errorM === null) {
        context.globalAlpha = row.status === "cannot" ? 0.22 : 0.1;
        context.fillRect(x - slot / 2, 4, slot, floor - 4);
      } else {
        context.globalAlpha = row.status === "ok" ? 0.62 : 1;
        const top = Math.min(y(row.errorM), floor - 1);
        context.fillRect(x - bar / 2, top, bar, floor - top);
        context.globalAlpha = 1;
        context.fillStyle = colors.cannot;
        if (row.sureAndWrong) context.fillRect(x - bar / 2, top - 4, bar, 3);
      }
      context.globalAlpha = 1;
    });
    if (this.withForecast && this.forecast) this.drawForecast(context, slot, y);
    this.drawStatus(context, width, height, slot, colors);
    this.drawFrameNumbers(context, height, slot);
    this.drawCursor(context, height, AXIS_PX + (this.position + 0.5) * slot);
  }

  drawScale(context, width, y) {
    context.font = '9.5px Inter, "Liberation Sans", Arial, sans-serif';
    context.textAlign = "right";
    context.textBaseline = "middle";
    for (let tick = LEAST_M; tick <= this.most * 1.001; tick *= 10) {
      const at = Math.round(y(tick)) + 0.5;
      context.fillStyle = cssColor("--hairline");
      context.fillRect(AXIS_PX, at - 0.5, width - AXIS_PX, 1);
      context.fillStyle = cssColor("--faint");
      context.fillText(`${Number(tick.toPrecision(1))}${tick >= 0.999 ? " m" : ""}`, AXIS_PX - 6, at);
    }
  }

  /** A line over the bars: the error that the map alone lets one expect. */
  drawForecast(context, slot, y) {
    context.beginPath();
    let before = null;
    this.forecast.expectedM.forEach((error, position) => {
      const at = [AXIS_PX + (position + 0.5) * slot, error === null ? null : y(error)];
      if (error !== null && before !== null) context.lineTo(...at);
      else if (error !== null) context.moveTo(...at);
      before = error;
    });
    context.strokeStyle = cssColor("--text");
    context.lineWidth = 1.2;
    context.stroke();
  }

  drawStatus(context, width, height, slot, colors) {
    const y = height - STATUS_PX;
    context.fillStyle = colors.ok;
    context.fillRect(AXIS_PX, y - 0.75, width - AXIS_PX, 1.5);
    this.run.frames.forEach((row, position) => {
      const x = AXIS_PX + (position + 0.5) * slot;
      if (row.status !== "ok") drawMark(context, row.status, x, y, Math.min(3.5, Math.max(2, slot / 2)), colors[row.status]);
    });
  }

  drawFrameNumbers(context, height, slot) {
    const { frames } = this.run;
    const every = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000].find((step) => step * slot > 56) ?? 2000;
    context.fillStyle = cssColor("--faint");
    context.textAlign = "center";
    context.textBaseline = "alphabetic";
    for (let position = 0; position < frames.length; position += every) {
      context.fillText(frames[position].index, AXIS_PX + (position + 0.5) * slot, height - 4);
    }
  }

  drawCursor(context, height, x) {
    context.fillStyle = cssColor("--text");
    context.fillRect(x - 0.75, 0, 1.5, height - STATUS_PX + 6);
    context.beginPath();
    context.moveTo(x - 5, 0);
    context.lineTo(x + 5, 0);
    context.lineTo(x, 6);
    context.fill();
  }
}
