// @ts-check
/* Draws an ImageModel on a canvas or into an SVG. */

import { fixed } from "/static/dom.js";
import { ON_IMAGE, drawArrow, drawGlyph, drawFalse, drawHandle, drawLine, drawMissed, residualColor, traceRing } from "/static/glyphs.js";
import { endState, middle, placeOf } from "./image_model.js";
import { Labels } from "../labels.js";
import { drawLegend } from "./legend.js";

/** @typedef {import("/static/protocol").inspector.ImageSize} ImageSize */
/** @typedef {import("/static/protocol").inspector.MappedElement} MappedElement */
/** @typedef {import("/static/protocol").inspector.MappedView} MappedView */
/** @typedef {import("/static/protocol").inspector.ObservedView} ObservedView */
/** @typedef {import("/static/canvas.js").Point} Point */
/** @typedef {import("/static/canvas.js").View} View */
/** @typedef {import("../panel.js").ClassStyle} ClassStyle */
/** @typedef {import("../panel.js").ClassMap} ClassMap */
/** @typedef {import("../panel.js").Context} Context */
/** @typedef {import("./image_model.js").EndState} EndState */
/** @typedef {import("../panel.js").Ends} Ends */
/** @typedef {import("./image_model.js").ImageModel} ImageModel */

const POSE_COLOR = { estimate: ON_IMAGE.estimate, truth: ON_IMAGE.truth };
const ARROW_PX = 16; // length of the arrow at a cut end
const MISSED_PX = 9; // radius of the ring around a missed detection
const FALSE_PX = 6; // size of the cross on a false positive

/** @typedef {(point: Point) => Point} ToScreen image to canvas, px */
/** The selection, the classes, and whether vectors and legend are drawn.
 *
 * @typedef {object} ImageLook
 * @property {ClassMap} classes
 * @property {number | null} observed
 * @property {number | null} element
 * @property {boolean} vectors
 * @property {boolean} legend
 */

/** Draws `model` in `view`, in an area of `width` x `height`.
 *
 * @param {Context} context
 * @param {ImageModel} model
 * @param {View} view
 * @param {number} width
 * @param {number} height
 * @param {ImageLook} look
 */
export function drawModel(context, model, view, width, height, look) {
  const painter = new Painter(context, model, view, look, new Labels(context, width, height));
  for (const pose of painter.poses()) painter.map(pose);
  painter.observed();
  painter.failures();
  if (look.vectors) painter.vectors();
  painter.selection();
  painter.labels.draw();
  if (look.legend) drawLegend(context, height, model, view.scale);
}

/** The image, or a plain background without one.
 *
 * @param {Context} context
 * @param {ImageBitmap | null} bitmap
 * @param {View} view
 * @param {ImageSize} size
 * @param {string} [background]
 */
export function drawPhoto(context, bitmap, view, { width, height }, background = "#3A3D42") {
  const { scale, x, y } = view;
  context.imageSmoothingEnabled = scale < 3;
  context.imageSmoothingQuality = "high";
  if (bitmap) {
    context.drawImage(bitmap, x, y, scale * width, scale * height);
  } else {
    context.fillStyle = background;
    context.fillRect(x, y, scale * width, scale * height);
  }
}

/** A detection, with the states of its ends.
 *
 * @param {Context} context
 * @param {ClassStyle} kind
 * @param {Ends} place
 * @param {ToScreen} at
 * @param {[EndState, EndState]} [ends]
 */
export function drawDetection(context, { shape, color }, place, at, ends = ["known", "known"]) {
  const [anchor, end] = screenEnds(place, at);
  if (!end) {
    drawGlyph(context, shape, ...anchor, 7, color, 2);
    return;
  }
  drawLine(context, anchor, end, color, 2);
  drawEnd(context, "peak", anchor, end, color, ends[0]);
  drawEnd(context, "bottom", end, anchor, color, ends[1]);
}

/** An end of a pole: a filled handle if known, a hollow one if hidden, an arrow out of the image if
 * the border cuts the pole.
 *
 * @param {Context} context
 * @param {"peak" | "bottom"} kind
 * @param {Point} at
 * @param {Point} from
 * @param {string} color
 * @param {EndState} state
 */
function drawEnd(context, kind, at, from, color, state) {
  if (state !== "cut") {
    drawHandle(context, kind, ...at, color, state === "known");
    return;
  }
  const far = Math.hypot(at[0] - from[0], at[1] - from[1]) || 1;
  const [dx, dy] = [from[0] - at[0], from[1] - at[1]];
  /** @type {Point} */
  const start = [at[0] + (dx * ARROW_PX) / far, at[1] + (dy * ARROW_PX) / far];
  drawArrow(context, start, at, color, 3);
}

/** A map element.
 *
 * @param {Context} context
 * @param {ClassStyle} kind
 * @param {Ends} place
 * @param {ToScreen} at
 * @param {string} color
 * @param {boolean} isMatched
 */
export function drawMapped(context, { shape }, place, at, color, isMatched) {
  const [width, dash] = isMatched ? [1.6, []] : [1, [5, 4]];
  const [anchor, end] = screenEnds(place, at);
  if (end) drawLine(context, anchor, end, color, width, dash);
  else drawGlyph(context, shape, ...anchor, 7, color, width, dash);
}

/** The map projected with the what-if pose: dashed, over all else.
 *
 * @param {Context} context
 * @param {MappedElement[]} mapped
 * @param {View} view
 * @param {ClassMap} classes
 */
export function drawWhatIf(context, mapped, view, classes) {
  for (const { class_id: id, place } of mapped) {
    const [anchor, end] = screenEnds(place, (point) => view.toScreen(point));
    const kind = classes.get(id);
    if (end) drawLine(context, anchor, end, ON_IMAGE.estimate, 2.2, [9, 5]);
    else if (kind) drawGlyph(context, kind.shape, ...anchor, 10, ON_IMAGE.estimate, 2, [5, 3]);
  }
}

/**
 * @param {Ends} place
 * @param {ToScreen} at
 * @returns {Ends}
 */
function screenEnds(place, at) {
  return [at(place[0]), place[1] && at(place[1])];
}

class Painter {
  /**
   * @param {Context} context
   * @param {ImageModel} model
   * @param {View} view
   * @param {ImageLook} look
   * @param {Labels} labels
   */
  constructor(context, model, view, look, labels) {
    this.context = context;
    this.model = model;
    this.look = look;
    this.labels = labels;
    /** @param {Point} point */
    this.at = (point) => view.toScreen(point);
    this.scale = view.scale;
  }

  /** The poses that the map is projected with; the last one is on top.
   *
   * @returns {("estimate" | "truth")[]}
   */
  poses() {
    const { mode, pose } = this.model;
    if (!this.model.isPossible) return [];
    return mode === "error" ? ["truth", "estimate"] : [pose];
  }

  /** @param {"estimate" | "truth"} pose */
  map(pose) {
    const { model, look } = this;
    const color = POSE_COLOR[pose];
    for (const row of model.mapped) {
      const [element, place] = [model.frame.mapped[row], model.place(row, pose)];
      if (!place) continue;
      const isMatched = model.matched.has(row);
      const kind = look.classes.get(element.class_id);
      if (kind) drawMapped(this.context, kind, place, this.at, color, isMatched);
      const isSelected = element.id === look.element && !this.selectedDetection;
      const isNamed = !model.observed.length || (!isMatched && model.mode === "truth") || model.missedDetections.includes(row);
      if (pose === model.pose && (isSelected || isNamed)) this.labels.add(element.name, this.at(place[0]), { color, weight: isMatched ? 600 : 400, first: isSelected });
    }
  }

  observed() {
    const { model, look } = this;
    model.observed.forEach((detection, row) => {
      const kind = look.classes.get(detection.class_id);
      const peak = endState(detection.anchor_known, detection.anchor, model.size);
      const bottom = detection.end ? endState(detection.end_known, detection.end, model.size) : "known";
      if (kind) drawDetection(this.context, kind, placeOf(detection), this.at, [peak, bottom]);
      const weight = model.pairOf.has(row) ? 600 : 400;
      if (row !== look.observed) this.labels.add(model.nameOf(row), this.at(detection.anchor), { weight });
    });
  }

  /** A dashed ring around missed detections, a cross on false positives. */
  failures() {
    const { context, model } = this;
    for (const row of model.missedDetections) {
      const place = model.place(row);
      if (place) drawMissed(context, this.at(place[0]), this.at(place[1] ?? place[0]), MISSED_PX);
    }
    for (const row of model.falsePositives) drawFalse(context, ...this.at(middle(...placeOf(model.observed[row]))), FALSE_PX);
  }

  vectors() {
    const { context, model } = this;
    for (const { start, end, px, fits } of model.vectors) {
      const from = this.at(start);
      const scale = model.magnification * this.scale;
      /** @type {Point} */
      const to = [from[0] + scale * (end[0] - start[0]), from[1] + scale * (end[1] - start[1])];
      if (!fits) drawLine(context, from, to, ON_IMAGE.cannot, 1.6, [3, 3]);
      else if (Math.hypot(to[0] - from[0], to[1] - from[1]) > 1) drawArrow(context, from, to, residualColor(px), 2.6);
    }
  }

  /** The selected detection. */
  get selectedDetection() {
    const { observed } = this.look;
    return observed === null ? undefined : this.model.observed[observed];
  }

  selection() {
    const { model, look, selectedDetection: detection } = this;
    const row = model.frame.mapped.findIndex((element) => element.id === look.element);
    const place = row >= 0 && model.isPossible ? model.place(row) : null;
    if (detection) {
      this.ring(...placeOf(detection));
      this.nameSelected(detection, row < 0 ? null : model.frame.mapped[row]);
    } else if (place) {
      this.ring(...place);
    }
  }

  /**
   * @param {ObservedView} detection
   * @param {MappedView | null} mapped
   */
  nameSelected(detection, mapped) {
    const { model, look } = this;
    const pair = look.observed === null ? undefined : model.pairOf.get(look.observed);
    const probability = pair && model.frame.matrix?.probability[pair.observed][pair.mapped];
    const value = pair && `${fixed(pair.residual_px, 1)} px${pair.inlier ? "" : ", outlier"}`;
    const second = [value, probability === undefined ? "" : `p ${probability.toFixed(2)}`].filter(Boolean).join(", ");
    const isPair = pair && mapped && model.frame.mapped[pair.mapped] === mapped;
    const name = mapped ? `#${look.observed} × ${isPair ? model.nameOf(pair.observed) : mapped.name}` : `#${look.observed}, no pair`;
    this.labels.add(name, this.at(detection.anchor), { first: true, second });
  }

  /**
   * @param {Point} anchor
   * @param {Point | null} end
   */
  ring(anchor, end) {
    const [from, to] = [this.at(anchor), this.at(end ?? anchor)];
    drawRing(this.context, from, to);
  }
}

/** The ring of the selection around a point or a line on the canvas.
 *
 * @param {Context} context
 * @param {Point} from
 * @param {Point} [to]
 * @param {number} [radius]
 */
export function drawRing(context, from, to = from, radius = 12) {
  traceRing(context, from, to, radius);
  context.strokeStyle = ON_IMAGE.accent;
  context.lineWidth = 2.2;
  context.stroke();
}
