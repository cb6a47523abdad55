// @ts-check
// The trajectory of the drive from above, north up.
/** @import {annotator} from "/static/protocol" */

const MARGIN_PX = 28;
const LABEL = [56, 16]; // size of the label of the frame on screen, which has its place before others

export class Trajectory {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {(frame: number) => void} go
   */
  constructor(canvas, go) {
    this.canvas = canvas;
    /** @type {annotator.DriveView | null} */
    this.drive = null;
    /** @type {number | null} */
    this.frame = null;
    /** @type {[number, number][]} */
    this.points = []; // of the frames, on the canvas
    canvas.addEventListener("click", (event) => {
      const nearest = this.#nearest(event.offsetX, event.offsetY);
      if (nearest !== null) go(nearest);
    });
    new ResizeObserver(() => this.#draw()).observe(canvas);
  }

  /**
   * @param {annotator.DriveView} drive
   * @param {number | null} frame
   */
  show(drive, frame) {
    this.drive = drive;
    this.frame = frame;
    this.#draw();
  }

  /**
   * @param {number} x
   * @param {number} y
   */
  #nearest(x, y) {
    const away = this.points.map(([px, py]) => Math.hypot(px - x, py - y));
    return away.length ? this.drive?.frames[away.indexOf(Math.min(...away))] ?? null : null;
  }

  #draw() {
    const { canvas, drive } = this;
    const { clientWidth: width, clientHeight: height } = canvas;
    if (!drive || !width || !height) return;
    const ratio = devicePixelRatio;
    Object.assign(canvas, { width: width * ratio, height: height * ratio });
    const context = canvas.getContext("2d");
    if (!context) return;
    context.scale(ratio, ratio);
    const style = getComputedStyle(document.documentElement);
    const color = (/** @type {string} */ name) => style.getPropertyValue(name);
    context.font = `12px ${getComputedStyle(document.body).fontFamily}`;
    context.fillStyle = color("--dim");
    if (!drive.places_m.length) {
      context.fillText("No poses, so no trajectory.", 12, 24);
      return;
    }
    const scale = this.#layOut(drive.places_m, width, height);
    context.strokeStyle = color("--map-drive") || "#F08030";
    context.lineWidth = 2;
    context.lineJoin = "round";
    context.beginPath();
    this.points.forEach(([x, y]) => context.lineTo(x, y));
    context.stroke();
    const [first, last] = [this.points[0], this.points[this.points.length - 1]];
    const here = this.points[drive.frames.indexOf(this.frame ?? -1)];
    const isFree = (/** @type {[number, number]} */ [x, y]) => !here || Math.abs(x - here[0]) > LABEL[0] || Math.abs(y - here[1]) > LABEL[1];
    if (isFree(first)) context.fillText("start", first[0] - 4, first[1] - 9);
    if (this.points.length > 1 && isFree(last)) context.fillText("end", last[0] - 4, last[1] - 9);
    if (here) this.#mark(context, here, color("--text"), `frame ${this.frame}`);
    this.#scaleBar(context, scale, width, height, color("--text"));
  }

  /** Places the frames on the canvas; returns its pixels in a metre.
   *
   * @param {[number, number][]} places
   * @param {number} width
   * @param {number} height
   */
  #layOut(places, width, height) {
    const xs = places.map(([x]) => x);
    const ys = places.map(([, y]) => y);
    const [west, east, south, north] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
    const scale = Math.min((width - 2 * MARGIN_PX - 40) / Math.max(east - west, 1), (height - 2 * MARGIN_PX - 24) / Math.max(north - south, 1));
    const [left, top] = [(width - 40 - scale * (east - west)) / 2, (height - 24 - scale * (north - south)) / 2];
    this.points = places.map(([x, y]) => [left + scale * (x - west), top + scale * (north - y)]);
    return scale;
  }

  /**
   * @param {CanvasRenderingContext2D} context
   * @param {[number, number]} place
   * @param {string} color
   * @param {string} text
   */
  #mark(context, [x, y], color, text) {
    context.fillStyle = color;
    context.beginPath();
    context.arc(x, y, 5, 0, 2 * Math.PI);
    context.fill();
    context.fillText(text, x + 9, y - 8);
  }

  /**
   * @param {CanvasRenderingContext2D} context
   * @param {number} scale
   * @param {number} width
   * @param {number} height
   * @param {string} color
   */
  #scaleBar(context, scale, width, height, color) {
    const wanted = width / 5 / scale; // metres
    const power = 10 ** Math.floor(Math.log10(wanted));
    const length = [5, 2, 1].map((factor) => factor * power).find((metres) => metres <= wanted) ?? power;
    context.fillStyle = color;
    context.fillRect(12, height - 14, length * scale, 2);
    context.fillText(`${length} m`, 20 + length * scale, height - 9);
  }
}
