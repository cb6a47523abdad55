// @ts-check
// Paints elements, proposals, guides and the loupe on an image. Sizes are CSS pixels at any zoom.
/** @import {annotator} from "/static/protocol" */
/** @import {View} from "/static/canvas.js" */
/** @import {Drawing, ElementClass, Ghost, Observation, Proposal, Point, Rectangle, ShownElement} from "../values.js" */
import { CASING, drawArrow, drawGlyph, drawHandle, drawLine, drawText } from "/static/glyphs.js";
import { counted, shownScore } from "../values.js";

const ACCENT = "#4DABF7"; // the dark set is used on images in both themes
const HANDLE_HIT = 8; // a press within this radius grabs a handle
const GLYPH = 7;
const SELECTED_GLYPH = 8;
const LEVELS = [0, -16, -32, -48, -64, 28, 44, 60]; // of labels, in CSS pixels from their usual height
const LABEL_SIZE = 11;

/** @typedef {CanvasRenderingContext2D} Context */
/** A mark, saved or not.
 * @typedef {{anchor: Point, end: Point | null, anchor_known: boolean, end_known: boolean}} Mark */
/** @typedef {[number, number, number, number]} Box */

/** Paints the overlay of one image; call `labels` last, so that they lie above all lines. */
export class Painter {
  /**
   * @param {Context} context
   * @param {View} view
   * @param {(id: number) => ElementClass} classOf
   * @param {(name: string) => string} shownKey the present key of a command
   */
  constructor(context, view, classOf, shownKey) {
    this.context = context;
    this.view = view;
    this.classOf = classOf;
    this.shownKey = shownKey;
    /** @type {{text: string, at: Point, weight: number, length: number}[]} */
    this.texts = [];
  }

  /** A labelled element. `alone`: it is selected, and nothing else. `reviewed`: the open decision or finding is about
   * it. `vertex`: the end that the arrow keys move; null if it is not selected.
   *
   * @param {ShownElement} element
   * @param {Observation} observation
   * @param {{selected: boolean, alone: boolean, hovered: boolean, reviewed: boolean, vertex: "anchor" | "end" | null}} look
   */
  element(element, observation, { selected, alone, hovered, reviewed, vertex }) {
    const { color, shape, kind } = this.classOf(element.class_id);
    const anchor = this.view.toScreen(observation.anchor);
    const width = hovered ? 3 : 2;
    const dash = element.unsaved ? [2, 2] : [];
    if (kind === "line" && observation.end) {
      const end = this.view.toScreen(observation.end);
      if (selected || reviewed) this.#halo(anchor, end);
      drawLine(this.context, anchor, end, color, width, dash);
      this.#poleEnd("peak", anchor, end, color, observation.anchor_known, vertex === "anchor");
      this.#poleEnd("bottom", end, anchor, color, observation.end_known, vertex === "end");
    } else {
      if (selected || reviewed) this.#ring(anchor, GLYPH + 6);
      drawGlyph(this.context, shape, anchor[0], anchor[1], selected ? SELECTED_GLYPH : GLYPH, color, width, dash);
      this.#dot(anchor, color);
    }
    const name = element.notes?.length ? `${element.name} ◆${element.notes.length}` : element.name; // comments wait for an answer
    const text = alone ? [name, ...missing(kind, observation)].join(" · ") : name;
    this.#label(text, anchor, alone ? 3 : selected || reviewed ? 2.5 : 2, observation.end);
  }

  /** A proposal: dashed if confident, else dotted; never filled. The current one shows its key.
   *
   * @param {Proposal} proposal
   * @param {annotator.ProposalMark} mark
   * @param {{selected: boolean, alone: boolean, current: boolean, reviewed: boolean}} look
   */
  proposal(proposal, mark, { selected, alone, current, reviewed }) {
    const { score, runner_up } = mark;
    this.#proposed(proposal.class_id, mark, { selected: selected || reviewed, dash: proposal.is_confident ? [5, 4] : [1.5, 4] });
    const name = proposal.track ? `${proposal.name} · ${counted(proposal.track.frames, "frame")}` : proposal.name;
    const sure = proposal.track ? proposal.track.doubt || "sure" : score === null ? "" : shownScore(score);
    const parts = [name, sure, current ? this.shownKey("Space") : ""];
    const text = current ? parts.filter(Boolean).join(" · ") : name;
    this.#label(text, this.view.toScreen(mark.anchor), alone || current ? 3 : selected || reviewed ? 2.5 : proposal.is_confident ? 1 : 0, mark.end);
    if (!runner_up || !current) return;
    this.#proposed(proposal.class_id, runner_up, { dash: [1, 5] });
    this.#label(`second-best ${shownScore(runner_up.score)} · ${this.shownKey("K")}`, this.view.toScreen(runner_up.anchor), 0, runner_up.end);
  }

  /**
   * @param {number} id of the class
   * @param {Mark} mark
   * @param {{selected?: boolean, dash: number[]}} look
   */
  #proposed(id, { anchor, end, anchor_known, end_known }, { selected = false, dash }) {
    const { color, shape, kind } = this.classOf(id);
    const from = this.view.toScreen(anchor);
    if (kind === "line" && end) {
      const to = this.view.toScreen(end);
      if (selected) this.#halo(from, to);
      drawLine(this.context, from, to, color, 1.5, dash);
      if (!anchor_known) this.#arrow(from, to, color);
      if (!end_known) this.#arrow(to, from, color);
    } else {
      if (selected) this.#ring(from, GLYPH + 6);
      drawGlyph(this.context, shape, from[0], from[1], GLYPH, color, 1.5, dash);
    }
  }

  /** Epipolar lines: thin over the whole image, brighter where the depth is plausible.
   *
   * @param {annotator.Guide[]} guides
   */
  guides(guides) {
    for (const { line, plausible } of guides) {
      this.#path(line, "rgba(255,255,255,.55)", 1);
      this.#path(plausible, "rgba(255,255,255,.9)", 2);
    }
  }

  /** The drawing as it will be saved, snapped to edges.
   *
   * @param {Drawing} drawing
   * @param {annotator.SnappedMark} mark
   */
  snapped({ class: id, end_known: drawn }, { anchor, end, end_known, by_px }) {
    this.#proposed(id, { anchor, end, anchor_known: true, end_known: end_known || !drawn }, { dash: [3, 2] });
    const hidden = end && drawn && !end_known ? `, bottom hidden (${this.shownKey("O")}: visible)` : "";
    this.#label(`snapped, ${by_px.toFixed(1)} px${hidden}`, this.view.toScreen(end ?? anchor), 3, null);
  }

  /** The rectangle that selects what it touches.
   *
   * @param {Rectangle} rectangle
   */
  rectangle({ from, to }) {
    this.#box(this.view.toScreen(from), this.view.toScreen(to), ACCENT);
  }

  /** The whole pole that a click takes.
   *
   * @param {Ghost} ghost
   */
  ghost({ class: id, anchor, end, anchor_known, end_known, joins }) {
    this.#proposed(id, { anchor, end, anchor_known, end_known }, { dash: [3, 2] });
    drawHandle(this.context, "peak", ...this.view.toScreen(anchor), this.classOf(id).color, anchor_known);
    drawHandle(this.context, "bottom", ...this.view.toScreen(end), this.classOf(id).color, end_known);
    this.#label(`click: ${joins ?? `new ${this.classOf(id).name}`}`, this.view.toScreen(anchor), 3, null);
  }

  /** The drawing.
   *
   * @param {Drawing} drawing
   */
  drawing({ class: id, anchor, end, box, anchor_known, end_known }) {
    const { color, shape, kind } = this.classOf(id);
    const from = this.view.toScreen(anchor);
    if (kind === "line" && end) {
      const to = this.view.toScreen(end);
      drawLine(this.context, from, to, color);
      this.#poleEnd("peak", from, to, color, anchor_known, false);
      if (!end_known) this.#poleEnd("bottom", to, from, color, false, false);
    } else {
      if (box) this.#box(this.view.toScreen(box[0]), this.view.toScreen(box[1]), color);
      drawGlyph(this.context, shape, from[0], from[1], GLYPH, color);
      this.#dot(from, color);
    }
  }

  /** Labels, right or left of their marks; if both places are taken, above or below, with a leader. If
   * all are, the less important label is left out: a proposal before an element, a far pole before a
   * near one; the selected one stays.
   *
   * @param {number} width
   */
  labels(width) {
    const taken = this.texts.map(({ at: [x, y] }) => /** @type {Box} */ ([x - 6, y - 6, 12, 12])); // labels never cover a glyph
    /** @type {{text: string, box: Box, font: number}[]} */
    const placed = []; // their texts are drawn over all leaders
    this.texts.sort((a, b) => b.weight - a.weight || b.length - a.length);
    for (const { text, at, weight } of this.texts) {
      const font = weight > 1 ? 600 : 400;
      this.context.font = `${font} ${LABEL_SIZE}px Inter, "Liberation Sans", Arial, sans-serif`;
      const size = this.context.measureText(text).width;
      const y = Math.max(at[1] - 8, 9);
      const boxes = LEVELS.flatMap((level) => [at[0] + 11, at[0] - 11 - size].map((x) => /** @type {Box} */ ([x, y - 7 + level, size, 14])));
      const free = boxes.find((box) =>
        box[0] > 0 && box[0] + size < width && box[1] > 0 && !taken.some((other) => overlap(other, box)));
      const box = free ?? (weight === 3 ? boxes[0] : null);
      if (!box) continue;
      taken.push(box);
      if (Math.abs(box[1] + 7 - y) > 12) this.#leader(at, box);
      placed.push({ text, box, font });
    }
    for (const { text, box: [x, y], font } of placed) drawText(this.context, text, x, y + 7, { weight: font, size: LABEL_SIZE });
  }

  /** A thin line from a mark to its label.
   *
   * @param {Point} at
   * @param {Box} box
   */
  #leader(at, [x, y, w, h]) {
    const to = /** @type {Point} */ ([x > at[0] ? x - 2 : x + w + 2, y + h / 2]);
    this.#path([at, to], CASING, 2.2, true);
    this.#path([at, to], "rgba(255,255,255,.55)", 1, true);
  }

  /**
   * @param {string} text
   * @param {Point} at
   * @param {number} weight
   * @param {Point | null} end the other end of the mark, in pixels; null for signs
   */
  #label(text, at, weight, end) {
    this.texts.push({ text, at, weight, length: end ? gap(at, this.view.toScreen(end)) : 0 });
  }

  /** A handle; for an unknown end, hollow and with an arrow that continues the pole.
   *
   * @param {"peak" | "bottom"} kind
   * @param {Point} at
   * @param {Point} from
   * @param {string} color
   * @param {boolean} known
   * @param {boolean} active
   */
  #poleEnd(kind, at, from, color, known, active) {
    const { context } = this;
    if (!known) this.#arrow(at, from, color);
    drawHandle(context, kind, at[0], at[1], color, known);
    if (!active) return;
    context.strokeStyle = ACCENT;
    context.lineWidth = 2.2;
    context.strokeRect(at[0] - 6, at[1] - 6, 12, 12);
  }

  /** An arrow that continues the pole.
   *
   * @param {Point} at
   * @param {Point} from
   * @param {string} color
   */
  #arrow(at, from, color) {
    const [dx, dy] = [at[0] - from[0], at[1] - from[1]];
    const length = Math.hypot(dx, dy) || 1;
    const ahead = (/** @type {number} */ distance) =>
      /** @type {Point} */ ([at[0] + (dx / length) * distance, at[1] + (dy / length) * distance]);
    drawArrow(this.context, ahead(6), ahead(14), color, 1.6);
  }

  /**
   * @param {Point} from
   * @param {Point} to
   */
  #halo(from, to) {
    this.#path([from, to], ACCENT, 6.5, true);
  }

  /**
   * @param {Point} middle
   * @param {number} radius
   */
  #ring([x, y], radius) {
    this.context.beginPath();
    this.context.arc(x, y, radius, 0, 2 * Math.PI);
    this.context.strokeStyle = ACCENT;
    this.context.lineWidth = 2.2;
    this.context.stroke();
  }

  /**
   * @param {Point[]} points
   * @param {string} color
   * @param {number} width
   */
  #path(points, color, width, onScreen = false) {
    const { context } = this;
    context.beginPath();
    for (const point of points) {
      const [x, y] = onScreen ? point : this.view.toScreen(point);
      context.lineTo(x, y);
    }
    context.strokeStyle = color;
    context.lineWidth = width;
    context.stroke();
  }

  /**
   * @param {Point} middle
   * @param {string} color
   */
  #dot([x, y], color) {
    this.context.fillStyle = CASING;
    this.context.fillRect(x - 1.5, y - 1.5, 3, 3);
    this.context.fillStyle = color;
    this.context.fillRect(x - 0.75, y - 0.75, 1.5, 1.5);
  }

  /**
   * @param {Point} from
   * @param {Point} to
   * @param {string} color
   */
  #box([x0, y0], [x1, y1], color) {
    this.context.strokeStyle = color;
    this.context.lineWidth = 1;
    this.context.strokeRect(x0, y0, x1 - x0, y1 - y0);
  }
}

/** Draws `bitmap` in `view`; from 3 CSS pixels per pixel on, pixels are squares.
 *
 * @param {Context} context
 * @param {ImageBitmap} bitmap
 * @param {View} view
 */
export function picture(context, bitmap, view) {
  context.imageSmoothingEnabled = view.scale < 3;
  context.imageSmoothingQuality = "medium";
  context.drawImage(bitmap, view.x, view.y, bitmap.width * view.scale, bitmap.height * view.scale);
}

/** The loupe around pixel (u, v), unsmoothed, with the coordinates.
 *
 * @param {Context} context
 * @param {ImageBitmap} bitmap
 * @param {Point} pixel
 * @param {{corner: Point, size: number, zoom: number, drawing: Drawing | null, color: string, filter: string}} look
 */
export function loupe(context, bitmap, [u, v], { corner: [x, y], size, zoom, drawing, color, filter }) {
  const caption = 20;
  const place = (/** @type {Point} */ [pu, pv]) =>
    /** @type {Point} */ ([x + size / 2 + (pu - u) * zoom, y + size / 2 + (pv - v) * zoom]);
  const [firstU, firstV] = [u, v].map((value) => Math.floor(value - size / zoom / 2));
  const count = Math.ceil(size / zoom) + 2;
  const [left, top] = place([firstU, firstV]).map((value) => value - zoom / 2);
  context.save();
  context.beginPath();
  context.roundRect(x, y, size, size + caption, 4);
  context.clip();
  context.fillStyle = "#0A0B0D";
  context.fillRect(x, y, size, size + caption);
  context.filter = filter;
  context.imageSmoothingEnabled = false;
  context.drawImage(bitmap, firstU, firstV, count, count, left, top, count * zoom, count * zoom);
  context.filter = "none";
  if (drawing?.end) drawLine(context, place(drawing.anchor), place([u, v]), color, 1.5);
  crosshair(context, x + size / 2, y + size / 2, size / 2);
  context.fillStyle = "#0A0B0D";
  context.fillRect(x, y + size, size, caption);
  const text = `${zoom}× ${u.toFixed(1)}, ${v.toFixed(1)}`;
  drawText(context, text, x + size / 2, y + size + caption / 2, { weight: 400, align: "center" });
  context.textAlign = "left";
  context.restore();
  context.strokeStyle = "#A3A8AF";
  context.lineWidth = 1;
  context.strokeRect(x + 0.5, y + 0.5, size - 1, size + caption - 1);
}

/** The keyboard cursor.
 *
 * @param {Context} context
 * @param {Point} point
 */
export function cursor(context, [x, y]) {
  for (const { color, width } of [{ color: CASING, width: 3.2 }, { color: ACCENT, width: 1.6 }]) {
    context.strokeStyle = color;
    context.lineWidth = width;
    context.beginPath();
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      context.moveTo(x + dx * 5, y + dy * 5);
      context.lineTo(x + dx * 22, y + dy * 22);
    }
    context.stroke();
  }
}

/**
 * @param {Context} context
 * @param {number} x
 * @param {number} y
 * @param {number} reach
 */
function crosshair(context, x, y, reach) {
  context.strokeStyle = "rgba(255,255,255,.75)";
  context.lineWidth = 1;
  context.beginPath();
  for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
    context.moveTo(x + dx * 5, y + dy * 5);
    context.lineTo(x + dx * reach, y + dy * reach);
  }
  context.stroke();
}

/** The part of an observation under `point` (CSS pixels): handles before lines.
 *
 * @param {View} view
 * @param {{anchor: Point, end: Point | null}} mark
 * @param {Point} point
 * @returns {{part: "anchor" | "end" | "line", distance: number, rank: number} | null}
 */
export function hitTest(view, { anchor, end }, point) {
  /** @type {{part: "anchor" | "end", pixel: Point | null}[]} */
  const ends = [{ part: "anchor", pixel: anchor }, { part: "end", pixel: end }];
  for (const { part, pixel } of ends) {
    if (!pixel) continue;
    const distance = gap(point, view.toScreen(pixel));
    if (distance <= (end ? HANDLE_HIT : GLYPH + 3)) return { part, distance, rank: 0 };
  }
  if (!end) return null;
  const distance = gapToSegment(point, view.toScreen(anchor), view.toScreen(end));
  return distance <= 5 ? { part: "line", distance, rank: 1 } : null;
}

/** The unknown ends of a pole, in words.
 *
 * @param {"line" | "point"} kind
 * @param {Observation} observation
 */
function missing(kind, { anchor_known, end_known }) {
  return [anchor_known ? "" : "peak cut", kind === "line" && !end_known ? "bottom hidden" : ""].filter(Boolean);
}

/**
 * @param {Box} first
 * @param {Box} second
 */
const overlap = ([x, y, w, h], [a, b, c, d]) => x < a + c && a < x + w && y < b + d && b < y + h;

/**
 * @param {Point} first
 * @param {Point} second
 */
const gap = ([x, y], [a, b]) => Math.hypot(x - a, y - b);

/**
 * @param {Point} point
 * @param {Point} from
 * @param {Point} to
 */
function gapToSegment([x, y], [ax, ay], [bx, by]) {
  const length = (bx - ax) ** 2 + (by - ay) ** 2 || 1;
  const along = Math.min(1, Math.max(0, ((x - ax) * (bx - ax) + (y - ay) * (by - ay)) / length));
  return gap([x, y], [ax + along * (bx - ax), ay + along * (by - ay)]);
}
