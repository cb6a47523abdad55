// @ts-check
// How far each step of the poses is from that of the images: its turn and its way, with the usual spread.
/** @import {annotator} from "/static/protocol" */
import { Surface, cssColor, pointerAt } from "/static/canvas.js";
import { byId } from "/static/dom.js";

const LEFT = 116, RIGHT = 14, TOP = 8, BOTTOM = 18, GAP = 10; // CSS pixels
const SIGMAS = 3; // of good steps: the dashed line

export class DriveStrip {
  /** @param {(frame: number) => void} go */
  constructor(go) {
    /** @type {annotator.StepErrors | null} */
    this.steps = null;
    /** @type {number | null} */
    this.frame = null;
    const canvas = byId("drive-strip", HTMLCanvasElement);
    this.surface = new Surface(canvas, (context, width, height) => this.#draw(context, width, height));
    canvas.addEventListener("click", (event) => {
      const at = Math.floor(((pointerAt(event)[0] - LEFT) * (this.steps?.frames.length ?? 0)) / (this.surface.width - LEFT - RIGHT));
      const frame = this.steps?.frames[at];
      if (frame !== undefined) go(frame);
    });
  }

  /**
   * @param {annotator.DriveView} drive
   * @param {number | null} frame
   */
  show({ motion: steps, frames }, frame) {
    this.steps = steps;
    this.frame = frame;
    const all = steps && steps.frames.length >= frames.length - 1;
    byId("drive-strip-about").textContent = !steps ? "not measured: Poses measures them" : `how far each step of the poses is from what the images say; ${all ? "all" : steps.frames.length} steps`;
    this.surface.redraw();
  }

  /**
   * @param {CanvasRenderingContext2D} context
   * @param {number} width
   * @param {number} height
   */
  #draw(context, width, height) {
    const { steps } = this;
    context.font = '11px Inter, "Liberation Sans", Arial, sans-serif';
    context.textBaseline = "middle";
    if (!steps) return;
    const tall = (height - TOP - BOTTOM - GAP) / 2;
    this.#bars(context, width, TOP, tall, "Turn", steps.turn_deg, steps.usual[0], "\u00b0", 3);
    this.#bars(context, width, TOP + tall + GAP, tall, "Way", steps.shift_m, steps.usual[1], " m", 3);
    this.#axis(context, width, height, steps);
  }

  /**
   * @param {CanvasRenderingContext2D} context
   * @param {number} width
   * @param {number} top
   * @param {number} tall
   * @param {string} title
   * @param {number[]} values
   * @param {number} usual
   * @param {string} unit
   * @param {number} digits
   */
  #bars(context, width, top, tall, title, values, usual, unit, digits) {
    const limit = SIGMAS * usual;
    const most = Math.max(2 * limit, ...values);
    const step = (width - LEFT - RIGHT) / Math.max(values.length, 1);
    context.textAlign = "left";
    context.fillStyle = cssColor("--text");
    context.fillText(title, 12, top + 7);
    context.fillStyle = cssColor("--dim");
    context.fillText("a step", 12, top + 21);
    context.textAlign = "right";
    context.fillText(`${most.toFixed(digits)}${unit}`, LEFT - 6, top + 6);
    context.fillText("0", LEFT - 6, top + tall - 5);
    values.forEach((value, at) => {
      context.fillStyle = cssColor(this.steps?.wrong[at] ? "--warning" : "--residual-0");
      const high = Math.max(1, (value / most) * tall);
      context.fillRect(LEFT + at * step, top + tall - high, Math.max(1, step - (step > 4 ? 1 : 0)), high);
    });
    context.strokeStyle = cssColor("--faint");
    context.setLineDash([4, 3]);
    const y = top + tall - (limit / most) * tall;
    context.beginPath();
    context.moveTo(LEFT, y);
    context.lineTo(width - RIGHT, y);
    context.stroke();
    context.setLineDash([]);
  }

  /**
   * @param {CanvasRenderingContext2D} context
   * @param {number} width
   * @param {number} height
   * @param {annotator.StepErrors} steps
   */
  #axis(context, width, height, { frames }) {
    const step = (width - LEFT - RIGHT) / Math.max(frames.length, 1);
    context.fillStyle = cssColor("--dim");
    context.textAlign = "center";
    const every = Math.max(1, Math.ceil(frames.length / Math.max(1, Math.floor((width - LEFT) / 70))));
    for (let at = 0; at < frames.length; at += every) context.fillText(`${frames[at]}`, LEFT + (at + 0.5) * step, height - 8);
    const at = frames.indexOf(this.frame ?? -1);
    if (at < 0) return;
    context.fillStyle = cssColor("--text");
    context.fillRect(LEFT + (at + 0.5) * step - 0.5, TOP, 1, height - TOP - BOTTOM);
  }
}
