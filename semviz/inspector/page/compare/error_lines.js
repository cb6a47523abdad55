/* The errors of A and B over the drive, as two lines on the frame clock of B, and which frames changed. */

import { cssColor } from "/static/canvas.js";
import { byId, el } from "/static/dom.js";
import { ClockCanvas } from "../frame_canvas.js";
import { Clock, drawCursor, drawFrameNumbers, drawScale } from "../timeline_drawing.js";
import { drawChange } from "./marks.js";

const CHANGES_PX = 26; // from the bottom
const FLOOR_PX = 40;
const LOOKS = {
  a: { color: "--dim", width: 1.2, dash: [3, 3], missing: 3 },
  b: { color: "--estimate", width: 1.8, dash: [], missing: 9 },
};

export class ErrorLines extends ClockCanvas {
  constructor(page) {
    super(page, "error-lines-canvas");
    this.rows = null;
  }

  says(position) {
    const row = this.rows?.[position];
    return row ? `Frame ${row.index}: ${row.change}` : "";
  }

  showComparison({ frames, base, other }) {
    this.rows = Array(this.page.run.frames.length).fill(null);
    for (const one of frames) this.rows[one.position] = one;
    const errors = frames.flatMap(({ a, b }) => [a.errorM ?? 0, b.errorM ?? 0]);
    this.mostM = errors.reduce((a, b) => Math.max(a, b), 1);
    const entry = (name, run) => el("span", {}, el("i", { class: `line run-${name}` }), el("span", { text: `${name.toUpperCase()} ${run}`, title: run }));
    byId("error-lines-legend").replaceChildren(entry("a", base.name), entry("b", other),
      el("span", {}, el("i", { class: "no-pose" }), el("span", { text: "no pose" })));
    this.surface.redraw();
  }

  figures() {
    return this.surface.width && this.rows ? [this.surface.figure("errors", "Errors of A and B")] : [];
  }

  draw(context, width, height) {
    if (!this.rows) return;
    const { frames } = this.page.run;
    this.clock = new Clock(width, height - FLOOR_PX, frames.length, this.mostM);
    drawErrorLines(context, this.clock, this.rows, height - CHANGES_PX);
    drawFrameNumbers(context, this.clock, frames, height - 4);
    drawCursor(context, this.clock.x(this.position), height - CHANGES_PX + 6);
  }
}

/** `rows` has a frame of both runs, or null, for each position. */
export function drawErrorLines(context, clock, rows, changesY) {
  drawScale(context, clock);
  for (const side of ["a", "b"]) drawLine(context, clock, rows, side);
  drawChanges(context, clock, rows, changesY);
}

/** One run's errors; where it has no pose a bar at the top says so, instead of an error. */
function drawLine(context, clock, rows, side) {
  const { color, width, dash, missing } = LOOKS[side];
  context.strokeStyle = context.fillStyle = cssColor(color);
  context.lineWidth = width;
  context.setLineDash(dash);
  context.beginPath();
  let before = null;
  rows.forEach((row, position) => {
    const error = row?.[side].errorM ?? null;
    const [x, y] = [clock.x(position), error === null ? null : clock.y(error)];
    if (error === null) {
      if (row?.[side].status === "cannot") context.fillRect(x - clock.slot / 2, missing, Math.max(clock.slot, 1.5), 3);
    } else if (before === null) {
      context.moveTo(x - Math.min(clock.slot / 2, 2), y);
      context.lineTo(x, y);
    } else {
      context.lineTo(x, y);
    }
    before = error;
  });
  context.stroke();
  context.setLineDash([]);
}

/** A thin line on which the frames that are fixed or broken stand out. */
export function drawChanges(context, clock, rows, y) {
  context.fillStyle = cssColor("--hairline");
  context.fillRect(clock.left, y - 0.5, clock.width - clock.left, 1);
  rows.forEach((row, position) => {
    if (row && row.change !== "same") drawChange(context, row.change, clock.x(position), y, Math.min(5, Math.max(3, clock.slot / 2)));
  });
}
