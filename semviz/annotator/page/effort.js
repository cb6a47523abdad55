// How much work a label is: inputs per observation since the page was opened, counted as they are.
import { byId } from "/static/dom.js";

const DRAG_FROM = 4; // CSS pixels, as for the pen
const WHEEL_PAUSE_MS = 400; // a turn of the wheel after such a pause is another input
const MODIFIERS = new Set(["Shift", "Control", "Alt", "Meta"]);

/** A key is one input, so is a click and a turn of the wheel; a drag is two, its press and its release. */
export class Effort {
  constructor() {
    this.inputs = 0;
    this.observations = 0;
    this.wheeled = 0;
    this.pressed = null;
    const on = (name, handler) => window.addEventListener(name, handler.bind(this), { capture: true, passive: true });
    on("keydown", this.#key);
    on("pointerdown", this.#down);
    on("pointerup", this.#up);
    on("wheel", this.#wheel);
  }

  /** So many observations more are on disk. */
  saved(count) {
    this.observations += count;
    const each = this.observations > 0 ? (this.inputs / this.observations).toFixed(2) : "—";
    byId("effort").textContent = `${each} inputs per observation`;
    byId("effort").title = `${this.inputs} inputs, ${this.observations} observations since this page was opened`;
  }

  #key({ key, repeat }) {
    if (!repeat && !MODIFIERS.has(key)) this.inputs += 1;
  }

  #down({ clientX, clientY }) {
    this.inputs += 1;
    this.pressed = [clientX, clientY];
  }

  #up({ clientX, clientY }) {
    const [x, y] = this.pressed ?? [clientX, clientY];
    if (Math.hypot(clientX - x, clientY - y) > DRAG_FROM) this.inputs += 1;
    this.pressed = null;
  }

  #wheel({ timeStamp }) {
    if (timeStamp - this.wheeled > WHEEL_PAUSE_MS) this.inputs += 1;
    this.wheeled = timeStamp;
  }
}
