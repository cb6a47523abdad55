/* Draws a sight on a canvas, or into an SVG: all that is needed comes as arguments. */

import { ON_IMAGE, drawArrow, drawGlyph, drawFalse, drawHandle, drawLine, drawMissed, residualColor, traceRing } from "/static/glyphs.js";
import { endState, middle, placeOf } from "./image_model.js";
import { Labels } from "./labels.js";
import { drawLegend } from "./legend.js";

const POSE_COLOR = { estimate: ON_IMAGE.estimate, truth: ON_IMAGE.truth };
const ARROW_PX = 16; // of an end that is cut off
const MISSED_PX = 9; // radius of the ring around what was missed
const FALSE_PX = 6; // of the cross on what is nothing

/** `sight` seen through `view`, in an area of `width` x `height`. `look` says what else belongs to
 * it: classes, the selection `{observed, element}`, whether vectors and legend are drawn. */
export function drawSight(context, sight, view, width, height, look) {
  const painter = new Painter(context, sight, view, look, new Labels(context, width, height));
  for (const pose of painter.poses()) painter.map(pose);
  painter.observed();
  painter.failures();
  if (look.vectors) painter.vectors();
  painter.selection();
  painter.labels.draw();
  if (look.legend) drawLegend(context, height, sight, view.scale);
}

/** The photo, or plain ground where there is none. */
export function drawPhoto(context, picture, view, { width, height }, ground = "#3A3D42") {
  const { scale, x, y } = view;
  context.imageSmoothingEnabled = scale < 3;
  context.imageSmoothingQuality = "high";
  if (picture) {
    context.drawImage(picture, x, y, scale * width, scale * height);
  } else {
    context.fillStyle = ground;
    context.fillRect(x, y, scale * width, scale * height);
  }
}

/** Something seen, with its ends as they are known. `at` turns its pixels into places on the
 * canvas. */
export function drawSeen(context, { shape, color }, place, at, ends = ["known", "known"]) {
  const [anchor, end] = place.map((point) => point && at(point));
  if (!end) {
    drawGlyph(context, shape, ...anchor, 7, color, 2);
    return;
  }
  drawLine(context, anchor, end, color, 2);
  drawEnd(context, "peak", anchor, end, color, ends[0]);
  drawEnd(context, "bottom", end, anchor, color, ends[1]);
}

/** A pole's handle: filled; hollow and dashed where something hides the end; an arrow out of the
 * image where its border cuts the pole. */
function drawEnd(context, kind, at, from, color, state) {
  if (state !== "cut") {
    drawHandle(context, kind, ...at, color, state === "known");
    return;
  }
  const far = Math.hypot(at[0] - from[0], at[1] - from[1]) || 1;
  const start = [0, 1].map((axis) => at[axis] + ((from[axis] - at[axis]) * ARROW_PX) / far);
  drawArrow(context, start, at, color, 3);
}

/** Something mapped. */
export function drawMapped(context, { shape }, place, at, color, isMatched) {
  const [width, dash] = isMatched ? [1.6, []] : [1, [5, 4]];
  const [anchor, end] = place.map((point) => point && at(point));
  if (end) drawLine(context, anchor, end, color, width, dash);
  else drawGlyph(context, shape, ...anchor, 7, color, width, dash);
}

/** The map under a pose that is being tried, `mapped` as `{class, place}`: dashed over all else. */
export function drawTried(context, mapped, view, classes) {
  for (const { class: id, place } of mapped) {
    const [anchor, end] = place.map((point) => point && view.toScreen(point));
    if (end) drawLine(context, anchor, end, ON_IMAGE.estimate, 2.2, [9, 5]);
    else drawGlyph(context, classes.get(id).shape, ...anchor, 10, ON_IMAGE.estimate, 2, [5, 3]);
  }
}

class Painter {
  constructor(context, sight, view, look, labels) {
    Object.assign(this, { context, sight, look, labels });
    this.at = (point) => view.toScreen(point);
    this.scale = view.scale;
  }

  /** Under which poses the map is drawn, the one that matters last and so on top. */
  poses() {
    const { mode, pose } = this.sight;
    if (!this.sight.isPossible) return [];
    return mode === "error" ? ["truth", "estimate"] : [pose];
  }

  map(pose) {
    const { sight, look } = this;
    const color = POSE_COLOR[pose];
    for (const row of sight.mapped) {
      const [one, place] = [sight.frame.mapped[row], sight.place(row, pose)];
      if (!place) continue;
      const isMatched = sight.matched.has(row);
      drawMapped(this.context, look.classes.get(one.class), place, this.at, color, isMatched);
      const chosen = one.id === look.element && !sight.observed[look.observed];
      const isNamed = !sight.observed.length || (!isMatched && sight.mode === "truth") || sight.missed.includes(row);
      if (pose === sight.pose && (chosen || isNamed)) this.labels.add(one.name, this.at(place[0]), { color, weight: isMatched ? 600 : 400, first: chosen });
    }
  }

  observed() {
    const { sight, look } = this;
    sight.observed.forEach((one, row) => {
      const ends = [endState(one.anchorKnown, one.anchor, sight.size), one.end && endState(one.endKnown, one.end, sight.size)];
      drawSeen(this.context, look.classes.get(one.class), placeOf(one), this.at, ends);
      const weight = sight.pairOf.has(row) ? 600 : 400;
      if (row !== look.observed) this.labels.add(sight.nameOf(row), this.at(one.anchor), { weight });
    });
  }

  /** Where detection failed: a dashed ring around what was missed, a cross on what is nothing. */
  failures() {
    const { context, sight } = this;
    for (const row of sight.missed) {
      const [anchor, end] = sight.place(row);
      drawMissed(context, this.at(anchor), this.at(end ?? anchor), MISSED_PX);
    }
    for (const row of sight.false) drawFalse(context, ...this.at(middle(...placeOf(sight.observed[row]))), FALSE_PX);
  }

  vectors() {
    const { context, sight } = this;
    for (const { start, end, px, fits } of sight.vectors) {
      const from = this.at(start);
      const to = from.map((value, axis) => value + sight.magnification * this.scale * (end[axis] - start[axis]));
      if (!fits) drawLine(context, from, to, ON_IMAGE.cannot, 1.6, [3, 3]);
      else if (Math.hypot(to[0] - from[0], to[1] - from[1]) > 1) drawArrow(context, from, to, residualColor(px), 2.6);
    }
  }

  selection() {
    const { sight, look } = this;
    const seen = sight.observed[look.observed];
    const row = sight.frame.mapped.findIndex((one) => one.id === look.element);
    if (seen) {
      this.ring(...placeOf(seen));
      this.nameSelected(seen, row < 0 ? null : sight.frame.mapped[row]);
    } else if (row >= 0 && sight.isPossible && sight.place(row)) {
      this.ring(...sight.place(row));
    }
  }

  nameSelected(seen, mapped) {
    const { sight, look } = this;
    const pair = sight.pairOf.get(look.observed);
    const probability = pair && sight.frame.matrix?.probability[look.observed][pair.mapped];
    const value = pair && `${pair.residualPx.toFixed(1)} px${pair.inlier ? "" : ", outlier"}`;
    const second = [value, probability === undefined ? "" : `p ${probability.toFixed(2)}`].filter(Boolean).join(", ");
    const isPair = mapped && sight.frame.mapped[pair?.mapped] === mapped;
    const name = mapped ? `#${look.observed} × ${isPair ? sight.nameOf(look.observed) : mapped.name}` : `#${look.observed}, no pair`;
    this.labels.add(name, this.at(seen.anchor), { first: true, second });
  }

  ring(anchor, end) {
    const [from, to] = [this.at(anchor), this.at(end ?? anchor)];
    drawRing(this.context, from, to);
  }
}

/** The mark of the selection around a point or a line on the canvas. */
export function drawRing(context, from, to = from, radius = 12) {
  traceRing(context, from, to, radius);
  context.strokeStyle = ON_IMAGE.accent;
  context.lineWidth = 2.2;
  context.stroke();
}
