// The two image canvases: one zoom and pan for both, and what is drawn on them.
import { Surface, View } from "/static/canvas.js";
import { SIDES } from "./state.js";
import * as paint from "./paint.js";

const MOST = 64; // CSS pixels to the image pixel
const COMING = 0.3; // opacity of the picture before, until the next one is there
const LOUPE = { zoom: 8, size: 152, height: 172, gap: 12 };

export class Images {
  /** `panels`: {left, right} sections with two canvases, for the picture and for the marks on it,
   * and a message; `shownKey` as for `Painter`. Marks change with every move of the pointer, the picture only with the view. */
  constructor(state, panels, shownKey) {
    this.state = state;
    this.panels = panels;
    this.shownKey = shownKey;
    this.view = new View();
    this.bitmaps = { left: null, right: null };
    this.frames = { left: null, right: null }; // what they are of
    this.pointer = null; // {side, point} while it is over an image
    this.hovered = null; // what a press would take hold of
    this.surfaces = {};
    this.backgrounds = {};
    for (const side of SIDES) {
      const background = panels[side].querySelector("canvas.picture");
      this.backgrounds[side] = new Surface(background, (context) => this.#paintPicture(side, context));
      this.surfaces[side] = new Surface(this.canvas(side), (context) => this.#paintMarks(side, context));
    }
    this.stage = this.#stage();
    this.surfaces.left.onresize = () => this.#resized();
    state.onChange(() => this.repaint());
  }

  canvas(side) {
    return this.panels[side].querySelector("canvas.marks");
  }

  /** Shows `bitmap` of `frame` or, where there is none, `message` on one side. */
  show(side, frame, bitmap, message = "") {
    this.bitmaps[side] = bitmap;
    this.frames[side] = frame;
    this.canvas(side).dataset.frame = frame;
    const note = this.panels[side].querySelector(".message");
    note.hidden = bitmap !== null;
    note.textContent = message;
    this.#moved();
  }

  /** The picture on one side if it is there; while another frame's is still shown, faintly, nothing
   * is marked in it and nothing can be drawn. */
  bitmap(side) {
    return this.frames[side] === this.state.frame ? this.bitmaps[side] : null;
  }

  /** The marks; `#moved` repaints everything. */
  repaint() {
    SIDES.forEach((side) => this.surfaces[side].redraw());
  }

  #moved() {
    SIDES.forEach((side) => this.backgrounds[side].redraw());
    this.repaint();
  }

  // -- zoom and pan

  /** The whole image. */
  fit() {
    this.view.fit(...this.#size(), ...this.stage);
    this.#moved();
  }

  zoomAt(point, factor) {
    this.view.zoomAt(point, factor, this.#whole(), MOST);
    this.#keepInside();
  }

  panBy(dx, dy) {
    this.view.pan(dx, dy);
    this.#keepInside();
  }

  /** Zooms at `pixel`, or at the middle of what is in sight. */
  zoomBy(factor, pixel = null) {
    this.zoomAt(pixel ? this.view.toScreen(pixel) : this.stage.map((side) => side / 2), factor);
  }

  /** Pans as little as brings `pixel` into sight, away from the rim. */
  reveal(pixel) {
    const by = this.view.toScreen(pixel).map((at, axis) => {
      const rim = Math.min(40, this.stage[axis] / 4);
      return Math.min(Math.max(at, rim), this.stage[axis] - rim) - at;
    });
    if (by[0] || by[1]) this.panBy(...by);
  }

  /** Puts `pixels` into the middle, as large as they fit up to 12x. */
  lookAt(pixels) {
    const [us, vs] = [0, 1].map((axis) => pixels.map((pixel) => pixel[axis]));
    const [width, height] = [us, vs].map((values) => Math.max(...values) - Math.min(...values) + 24);
    const fit = Math.min(this.stage[0] / width, this.stage[1] / height);
    this.view.scale = Math.min(12, Math.max(this.#whole(), fit));
    this.#center([us, vs].map((values) => (Math.max(...values) + Math.min(...values)) / 2));
  }

  #center(pixel) {
    const [x, y] = this.view.toScreen(pixel);
    this.panBy(this.stage[0] / 2 - x, this.stage[1] / 2 - y);
  }

  /** The middle of the stage never leaves the image; the smallest zoom shows it whole. */
  #keepInside() {
    if (this.view.scale <= this.#whole() * 1.0001) this.view.fit(...this.#size(), ...this.stage);
    const size = this.#size().map((one) => one * this.view.scale);
    const clamp = (offset, axis) =>
      Math.min(this.stage[axis] / 2, Math.max(this.stage[axis] / 2 - size[axis], offset));
    this.view.x = clamp(this.view.x, 0);
    this.view.y = clamp(this.view.y, 1);
    this.#moved();
  }

  /** What was in the middle stays there; a whole image stays whole. */
  #resized() {
    const wasWhole = this.view.scale <= this.#whole() * 1.0001;
    const middle = this.view.toImage(this.stage.map((side) => side / 2));
    this.stage = this.#stage();
    if (wasWhole) this.fit();
    else this.#center(middle);
  }

  #stage() {
    return [this.surfaces.left.width, this.surfaces.left.height];
  }

  #size() {
    const size = this.state.hello?.images.left ?? { width: 1, height: 1 };
    return [size.width, size.height];
  }

  #whole() {
    const [width, height] = this.#size();
    return Math.min(this.stage[0] / width, this.stage[1] / height);
  }

  // -- what lies where

  /** What is under `point` (CSS pixels): {element, observation, part: anchor | end | line} or null. */
  hit(side, point) {
    if (!this.bitmap(side)) return null;
    const { selected } = this.state;
    const hits = this.state.elements.flatMap((element) => {
      const observation = element.observations[side];
      const found = observation && paint.hitTest(this.view, observation, point);
      const second = element.id === selected?.element ? 0 : 1;
      return found ? [{ element: element.id, observation: observation.id, second, ...found }] : [];
    });
    hits.sort((a, b) => a.rank - b.rank || a.second - b.second || a.distance - b.distance);
    return hits[0] ?? null;
  }

  /** The proposal that is nearest to `point` (CSS pixels), of those under it; or null. */
  hitOffer(side, point) {
    const hits = (this.state.aids.ghosts && this.bitmap(side) ? this.state.offers : []).flatMap((offer) => {
      const found = offer[side] && paint.hitTest(this.view, offer[side], point);
      return found ? [{ offer, ...found }] : [];
    });
    hits.sort((a, b) => a.distance - b.distance);
    return hits[0]?.offer ?? null;
  }

  // -- painting

  #paintPicture(side, context) {
    if (this.bitmaps[side]) paint.picture(context, this.bitmaps[side], this.view);
  }

  #paintMarks(side, context) {
    const { scale, x, y } = this.view;
    this.canvas(side).dataset.view = `${scale} ${x} ${y}`;
    const bitmap = this.bitmap(side);
    const { style } = this.backgrounds[side].canvas;
    style.filter = this.state.filter;
    style.opacity = bitmap ? 1 : COMING;
    if (!bitmap || !this.state.labels) return;
    this.#paintElements(side, context);
    if (this.state.cursor?.side === side) paint.cursor(context, this.view.toScreen(this.state.cursor.pixel));
    if (this.state.aids.loupe && this.pointer?.side === side) this.#paintLoupe(side, context, bitmap);
  }

  #paintElements(side, context) {
    const { state } = this;
    const painter = new paint.Painter(context, this.view, (id) => state.classOf(id), this.shownKey);
    const isSelected = (one) => one.id === state.selected?.element || one.id === state.selected?.also;
    if (state.aids.guides) painter.guides(state.look?.guides[side] ?? []);
    for (const offer of state.offers.filter(({ id }) => state.aids.ghosts || state.isReviewed(id))) {
      const marked = { selected: isSelected(offer), current: offer.id === state.currentOffer?.id, reviewed: state.isReviewed(offer.id) };
      if (offer[side]) painter.offer(offer, offer[side], marked);
    }
    for (const element of state.elements) {
      const observation = element.observations[side];
      if (!observation) continue;
      const selected = isSelected(element);
      const inHand = element.id === state.selected?.element && side === state.selected.side;
      const hovered = this.hovered?.observation === observation.id;
      painter.element(element, observation, { selected, hovered, reviewed: state.isReviewed(element.id), vertex: inHand ? state.vertex : null });
    }
    if (state.drawing?.side === side) {
      painter.drawing(state.drawing);
      if (state.look?.snapped) painter.snapped(state.drawing, state.look.snapped);
    }
    painter.labels(this.stage[0]);
  }

  /** Bottom right; in the left corner when the pointer comes near. */
  #paintLoupe(side, context, bitmap) {
    const { point } = this.pointer;
    const { size, height, gap, zoom } = LOUPE;
    const right = this.stage[0] - size - gap;
    const top = this.stage[1] - height - gap;
    const isNear = point[0] > right - 60 && point[1] > top - 60;
    const drawing = this.state.drawing?.side === side ? this.state.drawing : null;
    paint.loupe(context, bitmap, this.view.toImage(point), {
      corner: [isNear ? gap : right, top],
      size,
      zoom,
      drawing,
      color: this.state.classOf(drawing?.class ?? this.state.classId).color,
      filter: this.state.filter,
    });
  }
}
