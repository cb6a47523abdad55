// @ts-check
// The left image twice, with the map under the given and under the refined pose, at the same crop.
/** @import {annotator} from "/static/protocol" */
/** @import {Poses} from "./poses.js" */
/** @import {State} from "../state.js" */
import { Surface, View, enableZoomAndPan } from "/static/canvas.js";
import { byId, find } from "/static/dom.js";
import { ON_IMAGE, drawArrow, drawGlyph, drawLine, drawText, residualColor, strokeCased, traceRing } from "/static/glyphs.js";

const LONGER = 5; // times that residuals are drawn
const LEAST_PX = 1; // shorter residuals are not drawn
const GLYPH = 7;

/** @typedef {annotator.PoseMark} Mark */
/** @typedef {"before" | "after"} Pose */

export class PoseImages {
  /**
   * @param {State} state
   * @param {Poses} poses
   */
  constructor(state, poses) {
    this.state = state;
    this.poses = poses;
    this.view = new View();
    this.isFitted = false;
    /** @type {{frame: number | null, bitmap: ImageBitmap | null}} */
    this.picture = { frame: null, bitmap: null };
    this.surfaces = /** @type {Pose[]} */ (["before", "after"]).map((pose) => {
      const canvas = find(byId(`pose-${pose}`), "canvas", HTMLCanvasElement);
      const surface = new Surface(canvas, (context) => this.#draw(context, pose));
      surface.onresize = () => { this.isFitted = false; };
      enableZoomAndPan(canvas, this.view, () => this.#redraw());
      canvas.addEventListener("dblclick", () => {
        this.isFitted = false;
        this.#redraw();
      });
      return surface;
    });
  }

  show() {
    const { frame } = this.state;
    if (frame !== null && this.picture.frame !== frame) this.#load(frame);
    this.#titles();
    this.#redraw();
  }

  /** @param {number} frame */
  async #load(frame) {
    this.picture = { frame, bitmap: this.picture.bitmap };
    const { bitmap } = await this.poses.page.pictures.get(frame, "left");
    if (this.picture.frame !== frame) return;
    this.picture = { frame, bitmap };
    this.#redraw();
  }

  #redraw() {
    this.surfaces.forEach((surface) => surface.redraw());
  }

  /** The elements of the frame on screen. */
  get #marks() {
    const { marks, place } = this.poses;
    return marks && marks.frame === this.state.frame && marks.stretch === place ? marks.marks : [];
  }

  /** What an image shows: the upper one what the lower one does, if both are compared in one place.
   *
   * @param {Pose} pose
   */
  #shown(pose) {
    return pose === "before" && this.poses.inOnePlace ? "after" : pose;
  }

  #titles() {
    const { frame } = this.state;
    const { stretch } = this.poses;
    const words = { before: ["Before", "map under the given pose"], after: ["After", "map under the refined pose; same crop"] };
    for (const pose of /** @type {Pose[]} */ (["before", "after"])) {
      const panel = byId(`pose-${pose}`);
      const [title, about] = words[this.#shown(pose)];
      find(panel, "h2").textContent = title;
      find(panel, ".about").textContent = `frame ${frame}, ${about}`;
      find(panel, ".status").textContent = this.#summary(this.#shown(pose));
      const message = find(panel, ".message");
      message.textContent = stretch?.effects.length && !this.#marks.length ? "No labels in this frame" : "";
      message.hidden = !message.textContent;
    }
  }

  /** @param {Pose} pose */
  #summary(pose) {
    const sizes = this.#marks.map((mark) => (pose === "before" ? mark.before_px : mark.after_px)).filter((size) => size !== null).sort((first, second) => Number(first) - Number(second));
    if (!sizes.length) return "";
    return `${sizes.length} elements, median ${Number(sizes[Math.floor(sizes.length / 2)]).toFixed(1)} px`;
  }

  /**
   * @param {CanvasRenderingContext2D} context
   * @param {Pose} pose
   */
  #draw(context, pose) {
    const { bitmap } = this.picture;
    if (!bitmap) return;
    const [{ width, height }] = this.surfaces;
    if (!this.isFitted && width && height) {
      this.view.scale = Math.max(width / bitmap.width, height / bitmap.height); // fills the panel: a crop of the middle
      this.view.x = (width - this.view.scale * bitmap.width) / 2;
      this.view.y = (height - this.view.scale * bitmap.height) / 2;
      this.isFitted = true;
    }
    const { scale, x, y } = this.view;
    context.imageSmoothingEnabled = scale < 2;
    context.drawImage(bitmap, x, y, scale * bitmap.width, scale * bitmap.height);
    const shown = this.#shown(pose);
    for (const mark of this.#marks) this.#mark(context, mark, shown);
    /** @type {[number, number, number][]} */
    const taken = [];
    for (const mark of this.#marks) this.#name(context, mark, taken);
    if (this.#marks.length) legend(context, this.surfaces[pose === "before" ? 0 : 1].height);
  }

  /**
   * @param {CanvasRenderingContext2D} context
   * @param {Mark} mark
   * @param {Pose} pose
   */
  #mark(context, mark, pose) {
    const { id, class_id: classId, label } = mark;
    const [projected, size] = pose === "before" ? [mark.before, mark.before_px] : [mark.after, mark.after_px];
    const kind = this.state.classOf(classId);
    const [anchor, end] = label.map((point) => point && this.view.toScreen(point));
    if (!anchor) return;
    if (projected) this.#element(context, kind.shape, projected, ON_IMAGE.estimate, 2);
    this.#element(context, kind.shape, label, kind.color, 1.5);
    if (id === this.state.selected?.element) {
      traceRing(context, anchor, end ?? anchor, GLYPH + 5);
      strokeCased(context, ON_IMAGE.accent, 1.5);
    }
    if (!projected || size === null || size < LEAST_PX) return;
    const [from, to] = [middle(projected), middle(label)];
    const far = /** @type {[number, number]} */ ([from[0] + LONGER * (to[0] - from[0]), end ? from[1] : from[1] + LONGER * (to[1] - from[1])]);
    drawArrow(context, this.view.toScreen(from), this.view.toScreen(far), residualColor(size), 2);
  }

  /**
   * @param {CanvasRenderingContext2D} context
   * @param {annotator.KeyedClass["shape"]} shape
   * @param {[[number, number], [number, number] | null]} ends
   * @param {string} color
   * @param {number} width
   */
  #element(context, shape, [anchor, end], color, width) {
    const from = this.view.toScreen(anchor);
    if (end) drawLine(context, from, this.view.toScreen(end), color, width);
    else drawGlyph(context, shape, from[0], from[1], GLYPH, color, width);
  }

  /** The name of an element, unless it would cover another one.
   *
   * @param {CanvasRenderingContext2D} context
   * @param {Mark} mark
   * @param {[number, number, number][]} taken
   */
  #name(context, { name, label: [anchor] }, taken) {
    const [x, y] = this.view.toScreen(anchor);
    const at = y - 12;
    if (taken.some(([left, right, level]) => Math.abs(level - at) < 13 && x < right && x + 36 > left)) return;
    taken.push([x, x + 36, at]);
    drawText(context, name, x + 4, at);
  }
}

/** @param {[[number, number], [number, number] | null]} ends */
function middle([anchor, end]) {
  return /** @type {[number, number]} */ (end ? [(anchor[0] + end[0]) / 2, (anchor[1] + end[1]) / 2] : anchor);
}

/**
 * @param {CanvasRenderingContext2D} context
 * @param {number} height
 */
function legend(context, height) {
  context.fillStyle = "rgba(20,22,26,.8)";
  context.fillRect(8, height - 30, 254, 22);
  drawText(context, `residual, drawn ${LONGER}×`, 16, height - 19, { weight: 400 });
  drawLine(context, [132, height - 19], [150, height - 19], "#EFE154", 2);
  drawText(context, "label", 157, height - 19, { weight: 400 });
  drawLine(context, [198, height - 19], [216, height - 19], ON_IMAGE.estimate, 2);
  drawText(context, "map", 223, height - 19, { weight: 400 });
}
