/* A drawing context that writes SVG: the functions that draw a panel draw its figure too.
 *
 * It knows this part of CanvasRenderingContext2D, and throws at anything else:
 *   fillStyle, strokeStyle (CSS colours), lineWidth, lineJoin, lineCap, globalAlpha, font,
 *   textAlign, textBaseline, imageSmoothingEnabled, imageSmoothingQuality (which say nothing here)
 *   beginPath, moveTo, lineTo, arc, rect, roundRect, closePath, fill, stroke, setLineDash
 *   fillRect, strokeRect, fillText, strokeText, measureText
 *   drawImage(image, x, y, width, height), save, clip, translate, rotate, restore
 * Text stays text, images are embedded. Paths are made by calls, not by Path2D, which cannot be read. */

import { svg } from "/static/dom.js";

const ANCHOR = { left: "start", start: "start", center: "middle", right: "end", end: "end" };
const JPEG_QUALITY = 0.95;
const STYLE = {
  fillStyle: "#000000",
  strokeStyle: "#000000",
  lineWidth: 1,
  lineJoin: "miter",
  lineCap: "butt",
  globalAlpha: 1,
  font: "10px sans-serif",
  textAlign: "start",
  textBaseline: "alphabetic",
  imageSmoothingEnabled: true,
  imageSmoothingQuality: "low",
};

export class SvgContext {
  #scratch = document.createElement("canvas").getContext("2d"); // reads colours, measures text
  #group; // what is being drawn into
  #path = "";
  #dash = [];
  #saved = [];
  #clips = 0;

  constructor(width, height) {
    this.root = svg("svg", { width, height, viewBox: `0 0 ${width} ${height}` });
    this.#group = this.root;
    Object.assign(this, STYLE);
    Object.seal(this); // setting what is not known throws, as calling it does
  }

  /** The file: an SVG document. */
  toString() {
    return `<?xml version="1.0" encoding="UTF-8"?>\n${new XMLSerializer().serializeToString(this.root)}\n`;
  }

  /* Paths */

  beginPath() {
    this.#path = "";
  }

  moveTo(x, y) {
    this.#path += `M${short(x)} ${short(y)}`;
  }

  lineTo(x, y) {
    this.#path += `${this.#path ? "L" : "M"}${short(x)} ${short(y)}`;
  }

  closePath() {
    this.#path += "Z";
  }

  /** Clockwise from `start` to `end`, as canvases draw it: two halves, since one arc of SVG's cannot
   * be a whole circle. */
  arc(x, y, radius, start, end) {
    const turn = end - start >= 2 * Math.PI ? 2 * Math.PI : (((end - start) % (2 * Math.PI)) + 2 * Math.PI) % (2 * Math.PI);
    const at = (angle) => [x + radius * Math.cos(angle), y + radius * Math.sin(angle)];
    this.lineTo(...at(start));
    for (const share of [0.5, 1]) {
      const [u, v] = at(start + share * turn);
      this.#path += `A${short(radius)} ${short(radius)} 0 0 1 ${short(u)} ${short(v)}`;
    }
  }

  rect(x, y, width, height) {
    this.#path += `M${short(x)} ${short(y)}h${short(width)}v${short(height)}h${short(-width)}Z`;
  }

  roundRect(x, y, width, height, radius) {
    const [right, bottom] = [x + width, y + height];
    this.moveTo(x + radius, y);
    this.arc(right - radius, y + radius, radius, -Math.PI / 2, 0);
    this.arc(right - radius, bottom - radius, radius, 0, Math.PI / 2);
    this.arc(x + radius, bottom - radius, radius, Math.PI / 2, Math.PI);
    this.arc(x + radius, y + radius, radius, Math.PI, 1.5 * Math.PI);
    this.closePath();
  }

  setLineDash(dash) {
    this.#dash = dash;
  }

  fill(...others) {
    refuse(others, "fill");
    this.#add("path", { d: this.#path, ...this.#filled() });
  }

  stroke(...others) {
    refuse(others, "stroke");
    this.#add("path", { d: this.#path, ...this.#stroked() });
  }

  fillRect(x, y, width, height) {
    const [left, top] = [Math.min(x, x + width), Math.min(y, y + height)];
    this.#add("rect", { x: short(left), y: short(top), width: short(Math.abs(width)), height: short(Math.abs(height)), ...this.#filled() });
  }

  strokeRect(x, y, width, height) {
    this.#add("rect", { x: short(x), y: short(y), width: short(width), height: short(height), ...this.#stroked() });
  }

  /* Text and images */

  fillText(text, x, y) {
    this.#write(text, x, y, this.#filled());
  }

  strokeText(text, x, y) {
    this.#write(text, x, y, this.#stroked());
  }

  measureText(text) {
    this.#scratch.font = this.font;
    return this.#scratch.measureText(text);
  }

  drawImage(image, x, y, width, height, ...others) {
    refuse(others, "drawImage");
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [image.width, image.height];
    canvas.getContext("2d").drawImage(image, 0, 0);
    const href = canvas.toDataURL("image/jpeg", JPEG_QUALITY);
    this.#add("image", { href, x: short(x), y: short(y), width: short(width), height: short(height), preserveAspectRatio: "none" });
  }

  /* Clipping and turning, until `restore` */

  save() {
    const style = Object.fromEntries(Object.keys(STYLE).map((name) => [name, this[name]]));
    this.#saved.push({ style, dash: this.#dash, group: this.#group });
  }

  clip(...others) {
    refuse(others, "clip");
    const id = `clip-${(this.#clips += 1)}`;
    this.#add("clipPath", { id }).append(svg("path", { d: this.#path }));
    this.#group = this.#add("g", { "clip-path": `url(#${id})` });
  }

  translate(x, y) {
    this.#group = this.#add("g", { transform: `translate(${short(x)} ${short(y)})` });
  }

  rotate(angle) {
    this.#group = this.#add("g", { transform: `rotate(${short((180 * angle) / Math.PI)})` });
  }

  restore() {
    const { style, dash, group } = this.#saved.pop();
    Object.assign(this, style);
    this.#dash = dash;
    this.#group = group;
  }

  #add(tag, attributes) {
    const node = svg(tag, attributes);
    this.#group.append(node);
    return node;
  }

  #write(text, x, y, paint) {
    const anchor = ANCHOR[this.textAlign];
    const node = this.#add("text", { x: short(x), y: short(y + this.#belowBaseline()), "text-anchor": anchor, ...this.#fontOf(), ...paint });
    node.textContent = text;
  }

  /** How far the line that letters stand on lies below where the text is put: SVG's own words for
   * that are not understood everywhere. */
  #belowBaseline() {
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
    return { fill: color, ...(opacity < 1 && { "fill-opacity": opacity }) };
  }

  #stroked() {
    const [color, opacity] = this.#colorOf(this.strokeStyle);
    return {
      fill: "none",
      stroke: color,
      "stroke-width": short(this.lineWidth),
      "stroke-linejoin": this.lineJoin,
      "stroke-linecap": this.lineCap,
      ...(opacity < 1 && { "stroke-opacity": opacity }),
      ...(this.#dash.length && { "stroke-dasharray": this.#dash.join(" ") }),
    };
  }

  /** [colour without transparency, opacity]: not every program reads rgba(). */
  #colorOf(color) {
    this.#scratch.fillStyle = color;
    const read = this.#scratch.fillStyle;
    const [red, green, blue, alpha = 1] = read.startsWith("#")
      ? [1, 3, 5].map((at) => Number.parseInt(read.slice(at, at + 2), 16))
      : read.match(/^rgba\(/) ? read.match(/[\d.]+/g).map(Number) : refuse([color], "colour");
    const hex = [red, green, blue].map((one) => one.toString(16).padStart(2, "0")).join("");
    return [`#${hex}`, short(alpha * this.globalAlpha)];
  }
}

const short = (value) => Math.round(value * 100) / 100;

/** Throws where there is anything that SVG would show otherwise than the screen. */
function refuse(values, where) {
  if (values.length) throw new Error(`no SVG of ${where}: ${values.map(String)}`);
}
