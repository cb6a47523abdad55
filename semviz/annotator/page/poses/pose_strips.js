// @ts-check
// Three strips over all frames: how far the whole image is shifted, how far it is turned, and what single
// elements do beyond that.
/** @import {Poses} from "./poses.js" */
import { Surface, cssColor, pointerAt } from "/static/canvas.js";
import { byId } from "/static/dom.js";
import { residualColor } from "/static/glyphs.js";

const LEFT = 152, RIGHT = 118, BOTTOM = 20, TOP = 8; // margins, CSS pixels
const ROWS = [{ share: 0.42, title: "All together", about: "shift in the image" }, { share: 0.3, title: "Turn", about: "" }, { share: 0.28, title: "One by one", about: "what stays, median" }];
const GAP = 12;

/** @typedef {CanvasRenderingContext2D} Context */
/** @typedef {{top: number, height: number}} Band */

export class PoseStrips {
  /**
   * @param {Poses} poses
   * @param {(frame: number) => void} go
   */
  constructor(poses, go) {
    this.poses = poses;
    this.canvas = byId("pose-strips", HTMLCanvasElement);
    this.surface = new Surface(this.canvas, (context, width, height) => this.#draw(context, width, height));
    this.canvas.addEventListener("click", (event) => {
      const frame = this.#frameAt(pointerAt(event)[0]);
      if (frame !== null) go(frame);
    });
  }

  redraw() {
    this.surface.redraw();
  }

  get #view() {
    return this.poses.known?.poses ?? null;
  }

  /** Left edge of a frame's column.
   *
   * @param {number} rank
   */
  #x(rank) {
    return LEFT + (rank * (this.surface.width - LEFT - RIGHT)) / Math.max(this.#view?.frames.length ?? 1, 1);
  }

  /** @param {number} x */
  #frameAt(x) {
    const frames = this.#view?.frames ?? [];
    const rank = Math.floor(((x - LEFT) * frames.length) / (this.surface.width - LEFT - RIGHT));
    return frames[rank] ?? null;
  }

  /**
   * @param {Context} context
   * @param {number} width
   * @param {number} height
   */
  #draw(context, width, height) {
    const view = this.#view;
    if (!view) return;
    context.font = '11px Inter, "Liberation Sans", Arial, sans-serif';
    const inner = height - TOP - BOTTOM - GAP * (ROWS.length - 1);
    let top = TOP;
    const bands = ROWS.map(({ share }) => {
      const band = { top, height: share * inner };
      top += band.height + GAP;
      return band;
    });
    this.#stretches(context, height);
    const [together, turn, alone] = bands;
    const words = view.turn_words;
    this.#title(context, together, ROWS[0].title, ROWS[0].about);
    this.#title(context, turn, ROWS[1].title, `${words[0]} +, ${words[1]} −`);
    this.#title(context, alone, ROWS[2].title, ROWS[2].about);
    this.#bars(context, together, view.shift_px, 2);
    this.#lines(context, turn);
    this.#bars(context, alone, view.alone_px, 1);
    this.#summary(context, together, view.shift_px);
    this.#legend(context, turn);
    this.#medianOf(context, alone, view.alone_px);
    this.#axis(context, width, height);
    this.#cursor(context, height);
  }

  /**
   * @param {Context} context
   * @param {Band} band
   * @param {string} title
   * @param {string} about
   */
  #title(context, { top }, title, about) {
    context.textAlign = "left";
    context.textBaseline = "top";
    context.fillStyle = cssColor("--text");
    context.font = '600 12px Inter, "Liberation Sans", Arial, sans-serif';
    context.fillText(title, 12, top);
    context.font = '11px Inter, "Liberation Sans", Arial, sans-serif';
    context.fillStyle = cssColor("--dim");
    context.fillText(about, 12, top + 15);
  }

  /** Bars from the ground of a band, in the colours of residuals. The worst frame of a column wins.
   *
   * @param {Context} context
   * @param {Band} band
   * @param {(number | null)[]} values px
   * @param {number} least upper end of the scale
   */
  #bars(context, { top, height }, values, least) {
    const most = Math.max(least, ...values.map((value) => value ?? 0));
    this.#scale(context, top, height, most, "px");
    const step = this.#x(1) - this.#x(0);
    const columns = new Map();
    const colors = [0, 1, 2, 3, 4].map((level) => cssColor(`--residual-${level}`));
    values.forEach((value, rank) => {
      const x = step >= 1 ? this.#x(rank) : Math.floor(this.#x(rank));
      if (value !== null) columns.set(x, Math.max(columns.get(x) ?? 0, value));
    });
    for (const [x, value] of columns) {
      const tall = Math.max(1, (value / most) * height);
      context.fillStyle = residualColor(value, colors);
      context.fillRect(x + (step > 4 ? 0.5 : 0), top + height - tall, Math.max(1, step - (step > 4 ? 1 : 0)), tall);
    }
  }

  /**
   * @param {Context} context
   * @param {Band} band
   */
  #lines(context, { top, height }) {
    const view = this.#view;
    if (!view) return;
    const known = view.turn_deg.map((value) => value ?? 0);
    const [low, high] = [Math.min(-0.1, ...known), Math.max(0.1, ...known)];
    const y = (/** @type {number} */ value) => top + ((high - value) / (high - low)) * height;
    this.#ticks(context, [low < -0.1 ? low : null, 0, high > 0.1 ? high : null], y, "°");
    const refined = view.frames.map((frame, rank) => (this.#isRefined(frame) ? 0 : view.refined_deg[rank]));
    this.#line(context, view.turn_deg, y, "--estimate", []);
    this.#line(context, refined, y, "--truth", [4, 3]);
  }

  /** Whether a frame is refined in the preview.
   *
   * @param {number} frame
   */
  #isRefined(frame) {
    const { stretch, tried } = this.poses;
    return tried === "refine" && stretch !== null && frame >= stretch.first && frame <= stretch.last;
  }

  /**
   * @param {Context} context
   * @param {(number | null)[]} values
   * @param {(value: number) => number} y
   * @param {string} color
   * @param {number[]} dash
   */
  #line(context, values, y, color, dash) {
    const half = (this.#x(1) - this.#x(0)) / 2;
    context.beginPath();
    let isDown = false;
    values.forEach((value, rank) => {
      if (value === null) isDown = false;
      else if (isDown) context.lineTo(this.#x(rank) + half, y(value));
      else {
        context.moveTo(this.#x(rank) + (values[rank + 1] === null || rank + 1 === values.length ? 0 : half), y(value));
        if (values[rank + 1] === null) context.lineTo(this.#x(rank + 1), y(value));
        isDown = true;
      }
    });
    context.strokeStyle = cssColor(color);
    context.lineWidth = 1.5;
    context.setLineDash(dash);
    context.stroke();
    context.setLineDash([]);
  }

  /**
   * @param {Context} context
   * @param {number} top
   * @param {number} height
   * @param {number} most
   * @param {string} unit
   */
  #scale(context, top, height, most, unit) {
    const y = (/** @type {number} */ value) => top + (1 - value / most) * height;
    this.#ticks(context, height > 40 && most > 3 ? [0, Math.round(most / 2), most] : [0, most], y, unit);
  }

  /**
   * @param {Context} context
   * @param {(number | null)[]} values
   * @param {(value: number) => number} y
   * @param {string} unit
   */
  #ticks(context, values, y, unit) {
    context.textAlign = "right";
    context.textBaseline = "middle";
    const right = this.surface.width - RIGHT;
    for (const value of values) {
      if (value === null) continue;
      context.fillStyle = cssColor("--hairline");
      context.fillRect(LEFT, Math.round(y(value)), right - LEFT, 1);
      context.fillStyle = cssColor("--dim");
      const text = Math.abs(value) >= 1 || value === 0 ? value.toFixed(0) : value.toFixed(1);
      context.fillText(`${text}${unit === "px" ? "" : unit}`, LEFT - 8, y(value));
    }
  }

  /** The frames of the faults: that on screen outlined.
   *
   * @param {Context} context
   * @param {number} height
   */
  #stretches(context, height) {
    const frames = this.#view?.frames ?? [];
    for (const one of this.poses.stretches) {
      if (one.subject !== "frames") continue;
      const first = frames.indexOf(one.first);
      const [x, end] = [this.#x(first), this.#x(frames.indexOf(one.last) + 1)];
      const isShown = one === this.poses.stretch;
      context.globalAlpha = isShown ? 0.55 : 0.2;
      context.fillStyle = cssColor(isShown ? "--accent-ground" : one.chosen ? "--ok" : "--ambiguous");
      context.fillRect(x, 2, Math.max(2, end - x), height - BOTTOM + 2);
      context.globalAlpha = 1;
      if (!isShown) continue;
      context.strokeStyle = cssColor("--accent");
      context.lineWidth = 1;
      context.strokeRect(x - 0.5, 2.5, Math.max(2, end - x) + 1, height - BOTTOM + 1);
      context.fillStyle = cssColor("--text");
      context.font = '600 12px Inter, "Liberation Sans", Arial, sans-serif';
      const isLate = end > this.surface.width - RIGHT - 150;
      context.textAlign = isLate ? "right" : "left";
      context.textBaseline = "top";
      context.fillText(one.where, isLate ? x - 8 : end + 8, TOP);
      context.font = '11px Inter, "Liberation Sans", Arial, sans-serif';
    }
  }

  /** Medians of the frames of the stretch on screen and of the others.
   *
   * @param {Context} context
   * @param {Band} band
   * @param {(number | null)[]} values
   */
  #summary(context, { top }, values) {
    const frames = this.#view?.frames ?? [];
    const { stretch } = this.poses;
    const isIn = (/** @type {number} */ rank) => stretch?.subject === "frames" && frames[rank] >= stretch.first && frames[rank] <= stretch.last;
    const some = (/** @type {boolean} */ inside) => median(values.filter((_, rank) => isIn(rank) === inside));
    const [here, others] = [some(true), some(false)];
    const lines = [here === null ? "" : `${here.toFixed(1)} px here`, others === null ? "" : `${others.toFixed(1)} px ${here === null ? "all along" : "elsewhere"}`];
    this.#aside(context, top, lines.filter(Boolean));
  }

  /**
   * @param {Context} context
   * @param {Band} band
   * @param {(number | null)[]} values
   */
  #medianOf(context, { top }, values) {
    const middle = median(values);
    this.#aside(context, top, [middle === null ? "no labels to tell" : `${middle.toFixed(1)} px all along`]);
  }

  /**
   * @param {Context} context
   * @param {Band} band
   */
  #legend(context, { top }) {
    const x = this.surface.width - RIGHT + 10;
    for (const [place, [text, color, dash]] of /** @type {const} */ ([["given", "--estimate", []], ["refined", "--truth", [4, 3]]]).entries()) {
      context.beginPath();
      context.moveTo(x, top + 6 + 16 * place);
      context.lineTo(x + 18, top + 6 + 16 * place);
      context.strokeStyle = cssColor(color);
      context.setLineDash([...dash]);
      context.stroke();
      context.setLineDash([]);
      context.textAlign = "left";
      context.textBaseline = "middle";
      context.fillStyle = cssColor("--dim");
      context.fillText(text, x + 25, top + 6 + 16 * place);
    }
  }

  /**
   * @param {Context} context
   * @param {number} top
   * @param {string[]} lines
   */
  #aside(context, top, lines) {
    context.textAlign = "left";
    context.textBaseline = "top";
    context.fillStyle = cssColor("--dim");
    lines.forEach((line, place) => context.fillText(line, this.surface.width - RIGHT + 10, top + 16 * place));
  }

  /** Numbers of frames below the strips.
   *
   * @param {Context} context
   * @param {number} width
   * @param {number} height
   */
  #axis(context, width, height) {
    const frames = this.#view?.frames ?? [];
    const wide = width - LEFT - RIGHT;
    const each = [1, 2, 5, 10, 25, 50, 100, 250, 500, 1000, 2500].find((step) => (step * wide) / frames.length > 46) ?? 5000;
    context.textAlign = "center";
    context.textBaseline = "alphabetic";
    context.fillStyle = cssColor("--dim");
    const half = (this.#x(1) - this.#x(0)) / 2;
    for (let rank = 0; rank < frames.length; rank += each) context.fillText(String(frames[rank]), this.#x(rank) + half, height - 5);
  }

  /**
   * @param {Context} context
   * @param {number} height
   */
  #cursor(context, height) {
    const rank = (this.#view?.frames ?? []).indexOf(this.poses.state.frame ?? -1);
    if (rank < 0) return;
    const x = Math.round((this.#x(rank) + this.#x(rank + 1)) / 2);
    context.fillStyle = cssColor("--truth");
    context.fillRect(x - 1, 4, 2, height - BOTTOM - 2);
    context.beginPath();
    context.moveTo(x - 5, 0);
    context.lineTo(x + 5, 0);
    context.lineTo(x, 7);
    context.fill();
  }
}

/** @param {(number | null)[]} values */
function median(values) {
  const known = values.filter((value) => value !== null).sort((first, second) => Number(first) - Number(second));
  return known.length ? Number(known[Math.floor(known.length / 2)]) : null;
}
