// @ts-check
/* A drawing context that writes SVG, so that the same functions draw a panel and its figure.
 *
 * It implements this part of CanvasRenderingContext2D, and throws at anything else:
 *   fillStyle, strokeStyle (CSS colours), lineWidth, lineJoin, lineCap, globalAlpha, font,
 *   textAlign, textBaseline, imageSmoothingEnabled, imageSmoothingQuality (ignored)
 *   beginPath, moveTo, lineTo, arc, rect, roundRect, closePath, fill, stroke, setLineDash
 *   fillRect, strokeRect, fillText, strokeText, measureText
 *   drawImage(image, x, y, width, height), save, clip, translate, rotate, restore
 * Text stays text, images are embedded. Paths are made by calls: a Path2D cannot be read. */

import { svg } from "/static/dom.js";

/** @type {Map<CanvasTextAlign, string>} */
const ANCHOR = new Map([["left", "start"], ["start", "start"], ["center", "middle"], ["right", "end"], ["end", "end"]]);
const JPEG_QUALITY = 0.95;

export class SvgContext {
  fillStyle = "#000000";
  strokeStyle = "#000000";
  lineWidth = 1;
  lineJoin = "miter";
  lineCap = "butt";
  globalAlpha = 1;
  font = "10px sans-serif";
  /** @type {CanvasTextAlign} */
  textAlign = "start";
  /** @type {CanvasTextBaseline} */
  textBaseline = "alphabetic";
  imageSmoothingEnabled = true;
  imageSmoothingQuality = "low";
  #scratch = scratch(); // reads colours, measures text
  /** @type {SVGElement} */
  #group; // the current group
  #path = "";
  /** @type {number[]} */
  #dash = [];
  /** @type {{style: object, dash: number[], group: SVGElement}[]} */
  #saved = [];
  #clips = 0;

  /**
   * @param {number} width
   * @param {number} height
   */
  constructor(width, height) {
    this.root = svg("svg", { width, height, viewBox: `0 0 ${width} ${height}` });
    this.#group = this.root;
    Object.seal(this); // setting an unknown property throws
  }

  /** The file: an SVG document. */
  toString() {
    return `<?xml version="1.0" encoding="UTF-8"?>\n${new XMLSerializer().serializeToString(this.root)}\n`;
  }

  /* Paths */

  beginPath() {
    this.#path = "";
  }

  /**
   * @param {number} x
   * @param {number} y
   */
  moveTo(x, y) {
    this.#path += `M${short(x)} ${short(y)}`;
  }

  /**
   * @param {number} x
   * @param {number} y
   */
  lineTo(x, y) {
    this.#path += `${this.#path ? "L" : "M"}${short(x)} ${short(y)}`;
  }

  closePath() {
    this.#path += "Z";
  }

  /** Clockwise from `start` to `end`, in two halves: one SVG arc cannot be a whole circle.
   *
   * @param {number} x
   * @param {number} y
   * @param {number} radius
   * @param {number} start
   * @param {number} end
   */
  arc(x, y, radius, start, end) {
    const turn = end - start >= 2 * Math.PI ? 2 * Math.PI : (((end - start) % (2 * Math.PI)) + 2 * Math.PI) % (2 * Math.PI);
    /** @type {(angle: number) => [number, number]} */
    const at = (angle) => [x + radius * Math.cos(angle), y + radius * Math.sin(angle)];
    this.lineTo(...at(start));
    for (const share of [0.5, 1]) {
      const [u, v] = at(start + share * turn);
      this.#path += `A${short(radius)} ${short(radius)} 0 0 1 ${short(u)} ${short(v)}`;
    }
  }

  /**
   * @param {number} x
   * @param {number} y
   * @param {number} width
   * @param {number} height
   */
  rect(x, y, width, height) {
    this.#path += `M${short(x)} ${short(y)}h${short(width)}v${short(height)}h${short(-width)}Z`;
  }

  /**
   * @param {number} x
   * @param {number} y
   * @param {number} width
   * @param {number} height
   * @param {number} radius
   */
  roundRect(x, y, width, height, radius) {
    const [right, bottom] = [x + width, y + height];
    this.moveTo(x + radius, y);
    this.arc(right - radius, y + radius, radius, -Math.PI / 2, 0);
    this.arc(right - radius, bottom - radius, radius, 0, Math.PI / 2);
    this.arc(x + radius, bottom - radius, radius, Math.PI / 2, Math.PI);
    this.arc(x + radius, y + radius, radius, Math.PI, 1.5 * Math.PI);
    this.closePath();
  }

  /** @param {number[]} dash */
  setLineDash(dash) {
    this.#dash = dash;
  }

  /** @param {...unknown[]} others */
  fill(...others) {
    refuse(others, "fill");
    this.#add("path", { d: this.#path, ...this.#filled() });
  }

  /** @param {...unknown[]} others */
  stroke(...others) {
    refuse(others, "stroke");
    this.#add("path", { d: this.#path, ...this.#stroked() });
  }

  /**
   * @param {number} x
   * @param {number} y
   * @param {number} width
   * @param {number} height
   */
  fillRect(x, y, width, height) {
    const [left, top] = [Math.min(x, x + width), Math.min(y, y + height)];
    this.#add("rect", { x: short(left), y: short(top), width: short(Math.abs(width)), height: short(Math.abs(height)), ...this.#filled() });
  }

  /**
   * @param {number} x
   * @param {number} y
   * @param {number} width
   * @param {number} height
   */
  strokeRect(x, y, width, height) {
    this.#add("rect", { x: short(x), y: short(y), width: short(width), height: short(height), ...this.#stroked() });
  }

  /* Text and images */

  /**
   * @param {string} text
   * @param {number} x
   * @param {number} y
   */
  fillText(text, x, y) {
    this.#write(text, x, y, this.#filled());
  }

  /**
   * @param {string} text
   * @param {number} x
   * @param {number} y
   */
  strokeText(text, x, y) {
    this.#write(text, x, y, this.#stroked());
  }

  /** @param {string} text */
  measureText(text) {
    this.#scratch.font = this.font;
    return this.#scratch.measureText(text);
  }

  /**
   * @param {ImageBitmap | HTMLCanvasElement} image
   * @param {number} x
   * @param {number} y
   * @param {number} width
   * @param {number} height
   * @param {...unknown[]} others
   */
  drawImage(image, x, y, width, height, ...others) {
    refuse(others, "drawImage");
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [image.width, image.height];
    canvas.getContext("2d")?.drawImage(image, 0, 0);
    const href = canvas.toDataURL("image/jpeg", JPEG_QUALITY);
    this.#add("image", { href, x: short(x), y: short(y), width: short(width), height: short(height), preserveAspectRatio: "none" });
  }

  /* Clipping and transforms, until `restore` */

  save() {
    const { root: _, ...style } = this;
    this.#saved.push({ style, dash: this.#dash, group: this.#group });
  }

  /** @param {...unknown[]} others */
  clip(...others) {
    refuse(others, "clip");
    const id = `clip-${(this.#clips += 1)}`;
    this.#add("clipPath", { id }).append(svg("path", { d: this.#path }));
    this.#group = this.#add("g", { "clip-path": `url(#${id})` });
  }

  /**
   * @param {number} x
   * @param {number} y
   */
  translate(x, y) {
    this.#group = this.#add("g", { transform: `translate(${short(x)} ${short(y)})` });
  }

  /** @param {number} angle */
  rotate(angle) {
    this.#group = this.#add("g", { transform: `rotate(${short((180 * angle) / Math.PI)})` });
  }

  restore() {
    const saved = this.#saved.pop();
    if (!saved) return;
    Object.assign(this, saved.style);
    this.#dash = saved.dash;
    this.#group = saved.group;
  }

  /**
   * @template {keyof SVGElementTagNameMap} Tag
   * @param {Tag} tag
   * @param {{[name: string]: string | number}} attributes
   */
  #add(tag, attributes) {
    const node = svg(tag, attributes);
    this.#group.append(node);
    return node;
  }

  /**
   * @param {string} text
   * @param {number} x
   * @param {number} y
   * @param {{[name: string]: string | number}} paint
   */
  #write(text, x, y, paint) {
    const anchor = ANCHOR.get(this.textAlign) ?? refuse([this.textAlign], "textAlign");
    const node = this.#add("text", { x: short(x), y: short(y + this.#belowBaseline()), "text-anchor": anchor, ...this.#fontOf(), ...paint });
    node.textContent = text;
  }

  /** Distance from the text position down to the alphabetic baseline: not every program supports
   * SVG's baseline attributes. */
  #belowBaseline() {
    /** @param {CanvasTextBaseline} baseline */
    const ascent = (baseline) => {
      this.#scratch.font = this.font;
      this.#scratch.textBaseline = baseline;
      return this.#scratch.measureText("x").fontBoundingBoxAscent;
    };
    return ascent("alphabetic") - ascent(this.textBaseline);
  }

  #fontOf() {
    const [, weight = "400", size, family] = this.font.match(/^(?:(\w+) )?([\d.]+)px (.+)$/) ?? refuse([this.font], "font");
    return { "font-family": family, "font-size": size, "font-weight": weight };
  }

  #filled() {
    const [color, opacity] = this.#colorOf(this.fillStyle);
    return { fill: color, ...(opacity < 1 ? { "fill-opacity": opacity } : {}) };
  }

  #stroked() {
    const [color, opacity] = this.#colorOf(this.strokeStyle);
    return {
      fill: "none",
      stroke: color,
      "stroke-width": short(this.lineWidth),
      "stroke-linejoin": this.lineJoin,
      "stroke-linecap": this.lineCap,
      ...(opacity < 1 ? { "stroke-opacity": opacity } : {}),
      ...(this.#dash.length ? { "stroke-dasharray": this.#dash.join(" ") } : {}),
    };
  }

  /** [colour without transparency, opacity]: not every program supports rgba().
   *
   * @param {string} color
   * @returns {[string, number]}
   */
  #colorOf(color) {
    this.#scratch.fillStyle = color;
    const read = this.#scratch.fillStyle;
    const numbers = read.startsWith("rgba(") ? read.match(/[\d.]+/g) : null;
    const [red, green, blue, alpha = 1] = read.startsWith("#")
      ? [1, 3, 5].map((at) => Number.parseInt(read.slice(at, at + 2), 16))
      : numbers?.map(Number) ?? refuse([color], "colour");
    const hex = [red, green, blue].map((band) => band.toString(16).padStart(2, "0")).join("");
    return [`#${hex}`, short(alpha * this.globalAlpha)];
  }
}

/** @param {number} value */
const short = (value) => Math.round(value * 100) / 100;

/** Throws for a value that SVG would show differently from the screen.
 * @returns {any} never
 * @param {unknown[]} values
 * @param {string} where
 */
function refuse(values, where) {
  if (values.length) throw new Error(`no SVG of ${where}: ${values.map(String)}`);
  return undefined;
}

function scratch() {
  return /** @type {CanvasRenderingContext2D} */ (document.createElement("canvas").getContext("2d"));
}
