// @ts-check
/* Canvases at device resolution, and the transform between image pixels and CSS pixels. */

/** @typedef {[number, number]} Point */

/** The position of an image on its canvas: screen = scale * image + offset, in CSS pixels.
 * Pixel (0, 0) of an image is the CENTRE of its top-left pixel. */
export class View {
  scale = 1;
  x = 0;
  y = 0;

  /**
   * @param {Point} pixel
   * @returns {Point}
   */
  toScreen([u, v]) {
    return [this.scale * (u + 0.5) + this.x, this.scale * (v + 0.5) + this.y];
  }

  /**
   * @param {Point} point
   * @returns {Point}
   */
  toImage([x, y]) {
    return [(x - this.x) / this.scale - 0.5, (y - this.y) / this.scale - 0.5];
  }

  /** Shows the whole image, as large as it fits, centered.
   *
   * @param {number} imageWidth
   * @param {number} imageHeight
   * @param {number} width
   * @param {number} height
   */
  fit(imageWidth, imageHeight, width, height) {
    this.scale = Math.min(width / imageWidth, height / imageHeight);
    this.x = (width - this.scale * imageWidth) / 2;
    this.y = (height - this.scale * imageHeight) / 2;
  }

  /** Shows points, with so much around them, inside a margin of the canvas. At least 1 by 1 is shown.
   *
   * @param {Point[]} points
   * @param {number} around in their unit
   * @param {number} margin px
   * @param {number} width
   * @param {number} height
   */
  fitPoints(points, around, margin, width, height) {
    const [xs, ys] = [points.map(([x]) => x), points.map(([, y]) => y)];
    const [left, top] = [least(xs) - around, least(ys) - around];
    const size = [xs, ys].map((values, axis) => Math.max(around - least(values.map((value) => -value)) - [left, top][axis], 1));
    this.fit(size[0], size[1], Math.max(width - 2 * margin, 50), Math.max(height - 2 * margin, 50));
    this.pan(margin - this.scale * left, margin - this.scale * top);
  }

  /** Zooms around a point, which stays fixed.
   *
   * @param {Point} point
   * @param {number} factor
   */
  zoomAt([x, y], factor, least = 0.05, most = 60) {
    const scale = Math.min(most, Math.max(least, this.scale * factor));
    this.x = x - (x - this.x) * (scale / this.scale);
    this.y = y - (y - this.y) * (scale / this.scale);
    this.scale = scale;
  }

  /**
   * @param {number} dx
   * @param {number} dy
   */
  pan(dx, dy) {
    this.x += dx;
    this.y += dy;
  }

  /** @param {View} other */
  copyFrom(other) {
    this.scale = other.scale;
    this.x = other.x;
    this.y = other.y;
  }
}

/** @typedef {(context: CanvasRenderingContext2D, width: number, height: number) => void} Draw */

/** A canvas that fills its parent, at device resolution. `draw(context, width, height)` gets CSS pixels
 * and runs at most once per screen refresh, after `redraw` or a change of size. */
export class Surface {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {Draw} draw
   */
  constructor(canvas, draw) {
    this.canvas = canvas;
    this.width = 0;
    this.height = 0;
    this.onresize = () => {};
    this.onpainted = () => {};
    this._draw = draw;
    this._context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
    this._pending = false;
    canvas.style.position = "absolute";
    canvas.style.inset = "0";
    this._parent = /** @type {HTMLElement} */ (canvas.parentElement);
    new ResizeObserver(() => this._resize()).observe(this._parent);
    this._resize();
  }

  /** The contents as a figure that can be saved.
   *
   * @param {string} name
   * @param {string} title
   */
  figure(name, title) {
    const { width, height } = this;
    return { name, title, width, height, draw: (/** @type {CanvasRenderingContext2D} */ context) => this._draw(context, width, height) };
  }

  redraw() {
    if (this._pending) return;
    this._pending = true;
    requestAnimationFrame(() => this._pending && this._paint());
  }

  _resize() {
    const box = this._parent.getBoundingClientRect();
    this.width = box.width;
    this.height = box.height;
    const ratio = window.devicePixelRatio || 1;
    this.canvas.width = Math.max(1, Math.round(box.width * ratio));
    this.canvas.height = Math.max(1, Math.round(box.height * ratio));
    this.canvas.style.width = `${box.width}px`;
    this.canvas.style.height = `${box.height}px`;
    this.onresize();
    this._paint();
  }

  _paint() {
    this._pending = false; // a change of size paints at once
    if (!this.width || !this.height) return;
    const context = this._context;
    context.setTransform(this.canvas.width / this.width, 0, 0, this.canvas.height / this.height, 0, 0);
    context.clearRect(0, 0, this.width, this.height);
    this._draw(context, this.width, this.height);
    this.onpainted();
  }
}

/** The pointer position in CSS pixels of the event's element; fractional.
 *
 * @param {MouseEvent} event
 * @returns {Point}
 */
export function pointerAt(event) {
  const box = /** @type {Element} */ (event.currentTarget).getBoundingClientRect();
  return [event.clientX - box.left, event.clientY - box.top];
}

/** Zooms with the wheel at the pointer, and pans by dragging with the middle or right button, or with the
 * left one if `leftPans(event)`. Calls `changed` after each change of `view`.
 *
 * @param {HTMLElement} canvas
 * @param {View} view
 * @param {() => void} changed
 * @param {(event: PointerEvent) => boolean} leftPans
 */
export function enableZoomAndPan(canvas, view, changed, leftPans = () => true) {
  /** @type {Point | null} */
  let last = null;
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const lines = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 33 : 1;
    view.zoomAt(pointerAt(event), Math.exp(-event.deltaY * lines * 0.0016));
    changed();
  }, { passive: false });
  canvas.addEventListener("pointerdown", (event) => {
    if (event.button === 0 && !leftPans(event)) return;
    last = [event.clientX, event.clientY];
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!last) return;
    view.pan(event.clientX - last[0], event.clientY - last[1]);
    last = [event.clientX, event.clientY];
    changed();
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { last = null; });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
}

const CLICK_PX = 4; // a press that moves less is a click

/** Calls `pick` with what a click hits. Over it there is a hand, and its text is the canvas's title.
 *
 * @template Thing
 * @param {HTMLCanvasElement} canvas
 * @param {(at: Point) => Thing | null} find
 * @param {(thing: Thing) => string} text
 * @param {(thing: Thing) => void} pick
 */
export function enablePicking(canvas, find, text, pick) {
  /** @type {Point} */
  let pressed = [0, 0];
  canvas.addEventListener("pointerdown", (event) => { pressed = pointerAt(event); });
  canvas.addEventListener("click", (event) => {
    const at = pointerAt(event);
    const thing = Math.hypot(at[0] - pressed[0], at[1] - pressed[1]) < CLICK_PX ? find(at) : null;
    if (thing) pick(thing);
  });
  canvas.addEventListener("pointermove", (event) => {
    const thing = find(pointerAt(event));
    canvas.title = thing ? text(thing) : "";
    canvas.style.cursor = thing ? "pointer" : "grab";
  });
}

/** The least value, of any number of them.
 *
 * @param {number[]} values
 */
function least(values) {
  return values.reduce((a, b) => Math.min(a, b), Infinity);
}

/** @type {Map<string, string>} */
const colors = new Map();

/** A colour of the page's palette in the present theme, for example `cssColor("--estimate")`. Cached: reading
 * a style forces the browser to lay out the page.
 *
 * @param {string} name
 */
export function cssColor(name) {
  const key = `${document.documentElement.dataset.theme} ${name}`;
  const color = colors.get(key) ?? getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  colors.set(key, color);
  return color;
}
