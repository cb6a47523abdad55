/* Canvases that stay crisp, and one transform between image pixels and CSS pixels. */

/** Where an image lies on its canvas: screen = scale * image + offset, in CSS pixels.
 * Pixel (0, 0) of an image is the CENTRE of its top-left pixel. */
export class View {
  scale = 1;
  x = 0;
  y = 0;

  toScreen([u, v]) {
    return [this.scale * (u + 0.5) + this.x, this.scale * (v + 0.5) + this.y];
  }

  toImage([x, y]) {
    return [(x - this.x) / this.scale - 0.5, (y - this.y) / this.scale - 0.5];
  }

  /** The whole image, as large as it fits, in the middle. */
  fit(imageWidth, imageHeight, width, height) {
    this.scale = Math.min(width / imageWidth, height / imageHeight);
    this.x = (width - this.scale * imageWidth) / 2;
    this.y = (height - this.scale * imageHeight) / 2;
  }

  /** Zooms so that what is under `point` stays there. */
  zoomAt([x, y], factor, least = 0.05, most = 60) {
    const scale = Math.min(most, Math.max(least, this.scale * factor));
    this.x = x - (x - this.x) * (scale / this.scale);
    this.y = y - (y - this.y) * (scale / this.scale);
    this.scale = scale;
  }

  pan(dx, dy) {
    this.x += dx;
    this.y += dy;
  }

  copyFrom(other) {
    this.scale = other.scale;
    this.x = other.x;
    this.y = other.y;
  }
}

/** A canvas that fills its parent, at the device's own pixels. `draw(context, width, height)` gets
 * CSS pixels and runs at most once a screen refresh, after `redraw` or a change of size. */
export class Surface {
  constructor(canvas, draw) {
    this.canvas = canvas;
    this.width = 0;
    this.height = 0;
    this.onresize = () => {};
    this.onpainted = () => {};
    this._draw = draw;
    this._context = canvas.getContext("2d");
    this._pending = false;
    canvas.style.position = "absolute";
    canvas.style.inset = "0";
    new ResizeObserver(() => this._resize()).observe(canvas.parentElement);
    this._resize();
  }

  /** What is on it, as a figure that can be saved. */
  figure(name, title) {
    const { width, height } = this;
    return { name, title, width, height, draw: (context) => this._draw(context, width, height) };
  }

  redraw() {
    if (this._pending) return;
    this._pending = true;
    requestAnimationFrame(() => this._pending && this._paint());
  }

  _resize() {
    const box = this.canvas.parentElement.getBoundingClientRect();
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

/** The pointer in CSS pixels of the event's own element; fractional. */
export function pointerAt(event) {
  const box = event.currentTarget.getBoundingClientRect();
  return [event.clientX - box.left, event.clientY - box.top];
}

/** Wheel zooms at the cursor; dragging with the middle or right button, or with the left one where
 * `leftPans(event)` says so, pans. Calls `changed` after each change of `view`. */
export function enableZoomAndPan(canvas, view, changed, leftPans = () => true) {
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

const known = new Map();

/** A colour of the page's palette in its present theme, such as `cssColor("--estimate")`. Kept:
 * asking the style sheet makes the browser settle the whole page first. */
export function cssColor(name) {
  const key = `${document.documentElement.dataset.theme} ${name}`;
  if (!known.has(key)) {
    known.set(key, getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  }
  return known.get(key);
}
