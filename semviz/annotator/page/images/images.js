// @ts-check
// The two image canvases: shared zoom and pan, hit tests, painting.
/** @import {State} from "../state.js" */
/** @import {Point, Proposal, Side} from "../values.js" */
import { Surface, View } from "/static/canvas.js";
import { find } from "/static/dom.js";
import { marksOf } from "../proposals.js";
import { SIDES } from "../values.js";
import * as paint from "./paint.js";

const MAX_SCALE = 64; // CSS pixels per image pixel
const LOADING_OPACITY = 0.3; // of the previous frame's image until the next one is loaded
const LOUPE = { zoom: 8, size: 152, height: 172, gap: 12 };

/** The part of an observation under the pointer.
 * @typedef {{element: string, observation: string, part: "anchor" | "end" | "line"}} Hit */

export class Images {
  /** Marks and image have canvases of their own: marks change with the pointer, the image with the view.
   *
   * @param {State} state
   * @param {Record<Side, HTMLElement>} panels sections with two canvases, for the
   *   image and its marks, and a message
   * @param {(name: string) => string} shownKey as for `Painter`
   */
  constructor(state, panels, shownKey) {
    this.state = state;
    this.panels = panels;
    this.shownKey = shownKey;
    this.view = new View();
    /** @type {Record<Side, ImageBitmap | null>} */
    this.bitmaps = { left: null, right: null };
    /** @type {Record<Side, number | null>} */
    this.frames = { left: null, right: null }; // the frames of these bitmaps
    /** @type {{side: Side, point: Point} | null} */
    this.pointer = null; // while it is over an image
    /** @type {Hit | null} */
    this.hovered = null; // what a press would drag
    /** @type {{frame: number | null, marks: Set<string>}} */
    this.seen = { frame: null, marks: new Set() }; // marks of proposals that were in view in this frame
    const background = (/** @type {Side} */ side) => {
      const canvas = find(panels[side], "canvas.picture", HTMLCanvasElement);
      return new Surface(canvas, (context) => this.#paintPicture(side, context));
    };
    const marks = (/** @type {Side} */ side) =>
      new Surface(this.canvas(side), (context) => this.#paintMarks(side, context));
    this.backgrounds = { left: background("left"), right: background("right") };
    this.surfaces = { left: marks("left"), right: marks("right") };
    this.stage = this.#stage();
    this.surfaces.left.onresize = () => this.#resized();
    state.onChange(() => this.repaint());
  }

  /** @param {Side} side */
  canvas(side) {
    return find(this.panels[side], "canvas.marks", HTMLCanvasElement);
  }

  /** Shows `bitmap` of `frame` on one side; without a bitmap, `message`.
   *
   * @param {Side} side
   * @param {number} frame
   * @param {ImageBitmap | null} bitmap
   * @param {string} message
   */
  show(side, frame, bitmap, message = "") {
    this.bitmaps[side] = bitmap;
    this.frames[side] = frame;
    this.canvas(side).dataset.frame = String(frame);
    const note = find(this.panels[side], ".message");
    note.hidden = bitmap !== null;
    note.textContent = message;
    this.#moved();
  }

  /** The image on one side; null while the image of another frame is shown (faintly): it has no marks,
   * and nothing can be drawn.
   *
   * @param {Side} side
   */
  bitmap(side) {
    return this.frames[side] === this.state.frame ? this.bitmaps[side] : null;
  }

  /** Repaints the marks; `#moved` repaints everything. */
  repaint() {
    SIDES.forEach((side) => this.surfaces[side].redraw());
  }

  #moved() {
    SIDES.forEach((side) => this.backgrounds[side].redraw());
    this.repaint();
  }

  // -- zoom and pan

  /** Shows the whole image. */
  fit() {
    this.#fitView();
    this.#moved();
  }

  #fitView() {
    const [width, height] = this.#size();
    this.view.fit(width, height, this.stage[0], this.stage[1]);
  }

  /**
   * @param {Point} point
   * @param {number} factor
   */
  zoomAt(point, factor) {
    this.view.zoomAt(point, factor, this.#whole(), MAX_SCALE);
    this.#keepInside();
  }

  /**
   * @param {number} dx
   * @param {number} dy
   */
  panBy(dx, dy) {
    this.view.pan(dx, dy);
    this.#keepInside();
  }

  /** Zooms at `pixel`, or at the middle of the view.
   *
   * @param {number} factor
   * @param {Point | null} [pixel]
   */
  zoomBy(factor, pixel = null) {
    this.zoomAt(pixel ? this.view.toScreen(pixel) : this.#middle(), factor);
  }

  /** Pans just far enough to show `pixel`, away from the rim.
   *
   * @param {Point} pixel
   */
  reveal(pixel) {
    const by = this.view.toScreen(pixel).map((at, axis) => {
      const rim = Math.min(40, this.stage[axis] / 4);
      return Math.min(Math.max(at, rim), this.stage[axis] - rim) - at;
    });
    if (by[0] || by[1]) this.panBy(by[0], by[1]);
  }

  /** Centers `pixels`, as large as they fit, up to 12x.
   *
   * @param {Point[]} pixels
   */
  zoomTo(pixels) {
    const [us, vs] = [0, 1].map((axis) => pixels.map((pixel) => pixel[axis]));
    const [width, height] = [us, vs].map((values) => Math.max(...values) - Math.min(...values) + 24);
    const fit = Math.min(this.stage[0] / width, this.stage[1] / height);
    this.view.scale = Math.min(12, Math.max(this.#whole(), fit));
    const [u, v] = [us, vs].map((values) => (Math.max(...values) + Math.min(...values)) / 2);
    this.#center([u, v]);
  }

  /** @param {Point} pixel */
  #center(pixel) {
    const [x, y] = this.view.toScreen(pixel);
    this.panBy(this.stage[0] / 2 - x, this.stage[1] / 2 - y);
  }

  /** Keeps the middle of the stage inside the image; the smallest zoom shows the whole image. */
  #keepInside() {
    if (this.#isWhole()) this.#fitView();
    const size = this.#size().map((extent) => extent * this.view.scale);
    const clamp = (/** @type {number} */ offset, /** @type {0 | 1} */ axis) =>
      Math.min(this.stage[axis] / 2, Math.max(this.stage[axis] / 2 - size[axis], offset));
    this.view.x = clamp(this.view.x, 0);
    this.view.y = clamp(this.view.y, 1);
    this.#moved();
  }

  /** Keeps the middle of the view; a whole image stays whole. */
  #resized() {
    const wasWhole = this.#isWhole();
    const middle = this.view.toImage(this.#middle());
    this.stage = this.#stage();
    if (wasWhole) this.fit();
    else this.#center(middle);
  }

  /** @returns {Point} */
  #stage() {
    return [this.surfaces.left.width, this.surfaces.left.height];
  }

  /** @returns {Point} */
  #middle() {
    return [this.stage[0] / 2, this.stage[1] / 2];
  }

  /** @returns {Point} */
  #size() {
    const size = this.state.known?.images.left ?? { width: 1, height: 1 };
    return [size.width, size.height];
  }

  #isWhole() {
    return this.view.scale <= this.#whole() * 1.0001;
  }

  #whole() {
    const [width, height] = this.#size();
    return Math.min(this.stage[0] / width, this.stage[1] / height);
  }

  /** Those proposals of which a mark was out of view ever since the frame was opened.
   *
   * @param {Proposal[]} proposals
   */
  unseen(proposals) {
    if (this.#isWhole()) return [];
    SIDES.forEach((side) => this.#look(side));
    return proposals.filter((proposal) => marksOf(proposal).some(([, { id }]) => !this.seen.marks.has(id)));
  }

  /** Notes what is in view, by the middle of each mark.
   *
   * @param {Side} side
   */
  #look(side) {
    if (this.seen.frame !== this.state.frame) this.seen = { frame: this.state.frame, marks: new Set() };
    for (const { marks } of this.state.proposals) {
      const mark = marks[side];
      if (!mark) continue;
      const middle = [0, 1].map((axis) => (mark.anchor[axis] + (mark.end ?? mark.anchor)[axis]) / 2);
      const place = this.view.toScreen([middle[0], middle[1]]);
      if (place.every((at, axis) => at >= 0 && at <= this.stage[axis])) this.seen.marks.add(mark.id);
    }
  }

  // -- hit tests

  /** The observation or mark of a track under `point` (CSS pixels); null if there is none.
   *
   * @param {Side} side
   * @param {Point} point
   * @returns {Hit | null}
   */
  hit(side, point) {
    if (!this.bitmap(side)) return null;
    const { selected } = this.state;
    const elements = this.state.elements.filter((element) => !this.state.isHidden(element));
    const tracks = this.state.aids.proposals ? this.state.proposals.filter(({ track }) => track) : [];
    const marks = [...elements.map(({ id, observations }) => ({ id, mark: observations[side] })), ...tracks.map(({ id, marks }) => ({ id, mark: marks[side] }))];
    const hits = marks.flatMap(({ id, mark }) => {
      const found = mark && paint.hitTest(this.view, mark, point);
      const second = id === selected?.element ? 0 : 1;
      return mark && found ? [{ element: id, observation: mark.id, second, ...found }] : [];
    });
    hits.sort((a, b) => a.rank - b.rank || a.second - b.second || a.distance - b.distance);
    return hits[0] ?? null;
  }

  /** The nearest proposal under `point` (CSS pixels); null if there is none.
   *
   * @param {Side} side
   * @param {Point} point
   */
  hitProposal(side, point) {
    const hits = (this.state.aids.proposals && this.bitmap(side) ? this.state.proposals : []).flatMap((proposal) => {
      const mark = proposal.marks[side];
      const found = mark && paint.hitTest(this.view, mark, point);
      return found ? [{ proposal, ...found }] : [];
    });
    hits.sort((a, b) => a.distance - b.distance);
    return hits[0]?.proposal ?? null;
  }

  // -- painting

  /**
   * @param {Side} side
   * @param {CanvasRenderingContext2D} context
   */
  #paintPicture(side, context) {
    const bitmap = this.bitmaps[side];
    if (bitmap) paint.picture(context, bitmap, this.view);
  }

  /**
   * @param {Side} side
   * @param {CanvasRenderingContext2D} context
   */
  #paintMarks(side, context) {
    const { scale, x, y } = this.view;
    this.canvas(side).dataset.view = `${scale} ${x} ${y}`;
    const bitmap = this.bitmap(side);
    const { style } = this.backgrounds[side].canvas;
    style.filter = this.state.filter;
    style.opacity = String(bitmap ? 1 : LOADING_OPACITY);
    if (!bitmap || !this.state.isReady) return;
    this.#paintElements(side, context);
    this.#look(side);
    if (this.state.cursor?.side === side) paint.cursor(context, this.view.toScreen(this.state.cursor.pixel));
    if (this.state.aids.loupe && this.pointer?.side === side) this.#paintLoupe(side, context, bitmap, this.pointer.point);
  }

  /**
   * @param {Side} side
   * @param {CanvasRenderingContext2D} context
   */
  #paintElements(side, context) {
    const { state } = this;
    const painter = new paint.Painter(context, this.view, (id) => state.classOf(id), this.shownKey);
    const selectedIds = new Set(state.selectedIds);
    const isSelected = (/** @type {{id: string}} */ { id }) => selectedIds.has(id);
    if (state.aids.guides) painter.guides(state.ownPreview?.guides[side] ?? []);
    for (const proposal of state.proposals.filter(({ id }) => state.aids.proposals || state.isReviewed(id))) {
      const mark = proposal.marks[side];
      const marked = { selected: isSelected(proposal), alone: proposal.id === state.selectedId, current: proposal.id === state.currentProposal?.id, reviewed: state.isReviewed(proposal.id) };
      if (mark) painter.proposal(proposal, mark, marked);
    }
    for (const element of state.elements) {
      const observation = element.observations[side];
      if (!observation || state.isHidden(element)) continue;
      const selected = isSelected(element);
      const isHeld = element.id === state.selectedId && side === state.selected?.side;
      const hovered = this.hovered?.observation === observation.id;
      painter.element(element, observation, { selected, alone: element.id === state.selectedId, hovered, reviewed: state.isReviewed(element.id), vertex: isHeld ? state.vertex : null });
    }
    if (state.ghost?.side === side && state.ghost.frame === state.frame) painter.ghost(state.ghost);
    if (state.drawing?.side === side) {
      painter.drawing(state.drawing);
      if (state.preview?.snapped) painter.snapped(state.drawing, state.preview.snapped);
    }
    if (state.rectangle?.side === side) painter.rectangle(state.rectangle);
    painter.labels(this.stage[0]);
  }

  /** Paints the loupe beside the pointer: right below it, or on the other side near a border.
   *
   * @param {Side} side
   * @param {CanvasRenderingContext2D} context
   * @param {ImageBitmap} bitmap
   * @param {Point} point where the pointer is
   */
  #paintLoupe(side, context, bitmap, point) {
    const { size, height, gap, zoom } = LOUPE;
    const beside = point.map((at, axis) => {
      const room = this.stage[axis] - [size, height][axis];
      const place = at + gap > room ? at - gap - [size, height][axis] : at + gap;
      return Math.max(0, Math.min(place, room));
    });
    const drawing = this.state.drawing?.side === side ? this.state.drawing : null;
    paint.loupe(context, bitmap, this.view.toImage(point), {
      corner: [beside[0], beside[1]],
      size,
      zoom,
      drawing,
      color: this.state.classOf(drawing?.class ?? this.state.nextClass(side)).color,
      filter: this.state.filter,
    });
  }
}
