// @ts-check
// Labelling effort: inputs per observation since the page was opened.
import { byId } from "/static/dom.js";

const DRAG_FROM = 4; // CSS pixels, as in tools.js
const WHEEL_PAUSE_MS = 400; // after such a pause, turning the wheel is a new input
const MODIFIERS = new Set(["Shift", "Control", "Alt", "Meta"]);

/** Counts inputs: a key, a click or a turn of the wheel is one; a drag is two, press and release. */
export class Effort {
  constructor() {
    this.inputs = 0;
    this.observations = 0;
    this.wheeled = 0;
    /** @type {[number, number] | null} */
    this.pressed = null;
    const options = { capture: true, passive: true };
    window.addEventListener("keydown", (event) => this.#key(event), options);
    window.addEventListener("pointerdown", (event) => this.#down(event), options);
    window.addEventListener("pointerup", (event) => this.#up(event), options);
    window.addEventListener("wheel", (event) => this.#wheel(event), options);
  }

  /** Counts observations that have been saved; `count` is negative for deletions.
   *
   * @param {number} count
   */
  saved(count) {
    this.observations += count;
    const each = this.observations > 0 ? (this.inputs / this.observations).toFixed(2) : "—";
    byId("effort").textContent = `${each} inputs per observation`;
    byId("effort").title = `${this.inputs} inputs, ${this.observations} observations since this page was opened`;
  }

  /** @param {KeyboardEvent} event */
  #key({ key, repeat }) {
    if (!repeat && !MODIFIERS.has(key)) this.inputs += 1;
  }

  /** @param {PointerEvent} event */
  #down({ clientX, clientY }) {
    this.inputs += 1;
    this.pressed = [clientX, clientY];
  }

  /** @param {PointerEvent} event */
  #up({ clientX, clientY }) {
    const [x, y] = this.pressed ?? [clientX, clientY];
    if (Math.hypot(clientX - x, clientY - y) > DRAG_FROM) this.inputs += 1;
    this.pressed = null;
  }

  /** @param {WheelEvent} event */
  #wheel({ timeStamp }) {
    if (timeStamp - this.wheeled > WHEEL_PAUSE_MS) this.inputs += 1;
    this.wheeled = timeStamp;
  }
}
