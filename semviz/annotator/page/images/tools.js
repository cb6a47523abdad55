// @ts-check
// Drawing and dragging on the images with the pointer or the keyboard cursor.
/** @import {Hit, Images} from "./images.js" */
/** @import {Page} from "../main.js" */
/** @import {State} from "../state.js" */
/** @import {Drawing, Ghost, Proposal, Point, Selected, Side} from "../values.js" */
import { pointerAt } from "/static/canvas.js";
import { GhostFinder } from "./drafts.js";
import { toggled, touched } from "../selection.js";
import { SIDES, uuid7 } from "../values.js";

const BESIDE = 8; // CSS pixels; a press this close outside the image counts as on its border
const DRAG_FROM = 4; // CSS pixels; a shorter move is a click

/** A press that has not ended; `held`: the observation that a drag moves, as
 * it was after operation `since`.
 * @typedef {{
 *   side: Side, start: Point, last: Point, moved: boolean, mode: "" | "pan" | "finish" | "drag" | "draw" | "whole" | "select",
 *   ghost?: Ghost, held?: {hit: Hit, grab: Point, anchor: Point, end: Point | null, since: {operation: number, hash: string}},
 * }} Press */

export class Tools {
  /**
   * @param {State} state
   * @param {Images} images
   * @param {Pick<Page, "submit" | "preview" | "mayEdit" | "notify" | "keys" | "socket">} page
   */
  constructor(state, images, page) {
    this.ghosts = new GhostFinder(state, images, page);
    this.state = state;
    this.images = images;
    this.page = page;
    /** @type {Press | null} */
    this.press = null;
    for (const side of SIDES) {
      const canvas = images.canvas(side);
      canvas.addEventListener("pointerdown", (event) => this.#down(side, event));
      canvas.addEventListener("pointermove", (event) => this.#move(side, event));
      canvas.addEventListener("pointerup", (event) => this.#up(side, event));
      canvas.addEventListener("pointercancel", () => this.#cancelPress());
      canvas.addEventListener("pointerleave", () => this.#leave());
      canvas.addEventListener("wheel", (event) => this.#wheel(event), { passive: false });
      canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    }
  }

  /** Cancels drawing and drag. Returns whether there was one. */
  cancel() {
    const had = this.state.drawing || this.press?.moved;
    this.press = null;
    this.state.set({ drawing: null, dragged: null, rectangle: null });
    if (had) this.page.preview();
    return Boolean(had);
  }

  /**
   * @param {Side} side
   * @param {PointerEvent} event
   */
  #down(side, event) {
    event.preventDefault();
    this.images.canvas(side).focus({ preventScroll: true });
    this.images.canvas(side).setPointerCapture(event.pointerId);
    const point = pointerAt(event);
    /** @type {Press} */
    const press = { side, start: point, last: point, moved: false, mode: "" };
    this.press = press;
    if (event.button !== 0 || event.altKey) {
      press.mode = "pan";
    } else if (this.state.drawing) {
      press.mode = "finish";
    } else if (event.ctrlKey || event.metaKey) {
      press.mode = "select";
    } else {
      const hit = event.shiftKey ? null : this.images.hit(side, point);
      const ghost = event.shiftKey ? null : this.ghosts.at(side, this.images.view.toImage(point));
      if (hit) this.#take(press, hit);
      else if (ghost) Object.assign(press, { mode: "whole", ghost });
      else if (this.#begin(side, this.images.view.toImage(point), event.shiftKey)) press.mode = "draw";
    }
  }

  // -- with the keyboard cursor

  /** Shows the whole pole under a pixel, if there is one.
   *
   * @param {Side} side
   * @param {Point} pixel
   */
  seek(side, pixel) {
    this.ghosts.seek(side, pixel);
  }

  /** Sets a point at `pixel`, like a click: begins a drawing, or finishes it.
   *
   * @param {Side} side
   * @param {Point} pixel
   */
  setPoint(side, pixel) {
    const { drawing } = this.state;
    const ghost = this.ghosts.at(side, pixel);
    if (drawing && drawing.side !== side) {
      this.cancel();
    } else if (drawing) {
      this.#finish(drawing, pixel);
    } else if (ghost) {
      this.#saveWhole(ghost);
    } else {
      const started = this.#begin(side, pixel);
      if (started && !started.end) this.#save(started, pixel, null);
    }
  }

  /** Moves the free end of a drawn pole on this side to `pixel`.
   *
   * @param {Side} side
   * @param {Point} pixel
   */
  stretchTo(side, pixel) {
    const { drawing } = this.state;
    if (drawing?.side !== side || !drawing.end) return;
    this.state.set({ drawing: { ...drawing, end: this.#inside(side, pixel) } });
    this.page.preview();
  }

  /** Selects an observation or the mark of a track; a drag will move its vertex or all of it.
   *
   * @param {Press} press
   * @param {Hit} hit
   */
  #take(press, hit) {
    const { side } = press;
    const mark = this.state.elements.find(({ id }) => id === hit.element)?.observations[side] ?? this.#track(hit.element)?.marks[side];
    if (!mark) return;
    const { anchor, end } = mark;
    press.mode = "drag";
    press.held = { hit, grab: this.images.view.toImage(press.start), anchor, end, since: this.state.lastShown };
    this.state.set({
      selected: { element: hit.element, side },
      vertex: hit.part === "end" ? "end" : "anchor",
      chosen: { element: hit.element, frame: this.state.frame ?? -1 },
    });
    this.page.preview();
  }

  /** Begins a drawing and returns it; null if nothing can be drawn here.
   *
   * @param {Side} side
   * @param {Point} pixel
   * @param {boolean} onTop whether it may lie on an element without a question
   */
  #begin(side, pixel, onTop = false) {
    const near = BESIDE / this.images.view.scale;
    if (!this.images.bitmap(side) || !this.#isInside(side, pixel, near) || !this.page.mayEdit()) return null;
    const anchor = this.#inside(side, pixel);
    const id = this.state.nextClass(side);
    const isLine = this.state.classOf(id).kind === "line";
    /** @type {Drawing} */
    const drawing = {
      side, class: id, anchor, end: isLine ? anchor : null, anchor_known: true, end_known: isLine, asks_bottom: isLine, on_top: onTop,
    };
    this.ghosts.drop();
    this.state.set({ drawing });
    this.page.preview();
    return drawing;
  }

  /**
   * @param {Side} side
   * @param {PointerEvent} event
   */
  #move(side, event) {
    const point = pointerAt(event);
    this.images.pointer = { side, point };
    const { press } = this;
    if (press && Math.hypot(point[0] - press.start[0], point[1] - press.start[1]) > DRAG_FROM) {
      press.moved = true;
    }
    if (press?.mode === "pan") {
      this.images.panBy(point[0] - press.last[0], point[1] - press.last[1]);
      press.last = point;
    } else if (press?.mode === "whole") {
      if (press.moved && this.#begin(side, this.images.view.toImage(press.start))) press.mode = "draw"; // a stroke
    } else if (press?.mode === "select") {
      if (press.moved) this.state.set({ rectangle: { side, from: this.images.view.toImage(press.start), to: this.images.view.toImage(point) } });
    } else if (press?.mode === "drag" && press.moved && this.page.mayEdit()) {
      this.#drag(side, press, point);
    } else if (this.state.drawing?.side === side) {
      this.#stretch(side, this.state.drawing, point);
    } else {
      this.#hover(side, point);
    }
    this.images.repaint();
  }

  /** Moves the free end of a pole, or the corner of a sign's box.
   *
   * @param {Side} side
   * @param {Drawing} drawing
   * @param {Point} point
   */
  #stretch(side, drawing, point) {
    const at = this.images.view.toImage(point);
    if (drawing.end) {
      this.stretchTo(side, at);
    } else if (this.press?.moved) {
      const from = this.images.view.toImage(this.press.start);
      const share = this.state.middleOf(drawing.class) === "centroid" ? 2 / 3 : 1 / 2;
      this.state.set({ drawing: { ...drawing, box: [from, at], anchor: inBox(from, at, share) } });
      this.page.preview();
    }
  }

  /**
   * @param {Side} side
   * @param {Press} press
   * @param {Point} point
   */
  #drag(side, { held }, point) {
    if (!held) return;
    const { hit, grab, anchor, end } = held;
    const at = this.images.view.toImage(point);
    const moved = (/** @type {Point} */ [u, v]) => this.#inside(side, [u + at[0] - grab[0], v + at[1] - grab[1]]);
    this.state.set({ dragged: {
      observation: hit.observation,
      anchor: hit.part === "end" ? null : moved(anchor),
      end: hit.part === "anchor" || !end ? null : moved(end),
    } });
    this.page.preview();
  }

  /**
   * @param {Side} side
   * @param {Point} point
   */
  #hover(side, point) {
    const hit = this.images.hit(side, point);
    this.images.hovered = hit;
    this.images.canvas(side).style.cursor = hit ? "grab" : "crosshair";
    const proposal = this.images.hitProposal(side, point);
    this.#point(proposal);
    if (hit || proposal || this.press) this.ghosts.drop();
    else this.ghosts.seek(side, this.images.view.toImage(point));
  }

  /** Makes the proposal under the pointer the current one.
   *
   * @param {Proposal | null} proposal
   */
  #point(proposal) {
    const id = proposal?.id ?? null;
    if (id !== this.state.pointed) this.state.set({ pointed: id });
  }

  /**
   * @param {Side} side
   * @param {PointerEvent} event
   */
  #up(side, event) {
    const { press } = this;
    const { drawing, dragged } = this.state;
    this.press = null;
    if (!press) return;
    if (press.mode === "drag" && dragged) this.#drop(dragged, press.held?.since);
    else if (press.mode === "select") this.#select(press);
    else if (press.mode === "whole" && press.ghost) this.#saveWhole(press.ghost);
    else if (press.mode === "draw" && drawing) this.#released(press, drawing);
    else if (press.mode === "finish" && drawing?.side === side) {
      this.#finish(drawing, this.images.view.toImage(pointerAt(event)));
    } else if (press.mode === "finish") {
      this.cancel();
    }
  }

  /** The open track that an element id names.
   *
   * @param {string} element
   */
  #track(element) {
    return this.state.proposals.find(({ id, track }) => id === element && track);
  }

  /** Selects what the rectangle touches; a click adds one to the selection, or takes it out.
   *
   * @param {Press} press
   */
  #select({ side, start }) {
    const { rectangle } = this.state;
    const id = this.images.hit(side, start)?.element ?? this.images.hitProposal(side, start)?.id;
    if (rectangle) this.choose(touched(this.state, rectangle));
    else if (id) this.choose(toggled(this.state, id, side));
  }

  /** Makes something the selection.
   *
   * @param {Selected | null} selected
   */
  choose(selected) {
    const chosen = { element: selected?.element ?? "", frame: this.state.frame ?? -1 };
    this.state.set({ selected, rectangle: null, vertex: "anchor", chosen });
    this.page.preview();
  }

  /** Saves a drag; that of a track's mark is kept until the track is accepted.
   *
   * @param {import("../values.js").Dragged} dragged
   * @param {{operation: number, hash: string} | undefined} since the last operation that was shown when the drag began
   */
  #drop({ observation, anchor, end }, since) {
    const track = this.state.proposals.find(({ marks }) => SIDES.some((side) => marks[side]?.id === observation));
    const mark = track && SIDES.map((side) => track.marks[side]).find((candidate) => candidate?.id === observation);
    if (track && mark) {
      const placed = { track: track.id, anchor: mark.anchor, end: mark.end };
      const corrected = new Map(this.state.corrected).set(observation, placed);
      this.state.set({ dragged: null, corrected });
      this.page.notify(`Corrected in this image. ${this.page.keys.shown("Space")} accepts the track with it.`);
      return;
    }
    this.state.set({ dragged: null });
    this.page.submit({ kind: "move", observation_id: observation, anchor_px: anchor, end_px: end }, since);
  }

  /** Saves a sign, or a pole drawn in one stroke; any other pole waits for its second click.
   *
   * @param {Press} press
   * @param {Drawing} drawing
   */
  #released(press, drawing) {
    if (!drawing.end) this.#save(drawing, drawing.anchor, null);
    else if (press.moved) this.#save(drawing, drawing.anchor, drawing.end);
  }

  /**
   * @param {Drawing} drawing
   * @param {Point} end
   */
  #finish(drawing, end) {
    this.#save(drawing, drawing.anchor, this.#inside(drawing.side, end));
  }

  /**
   * @param {Drawing} drawing
   * @param {Point} anchor
   * @param {Point | null} end
   */
  #save({ side, class: id, anchor_known, end_known, asks_bottom, box, on_top: onTop }, anchor, end) {
    const [element, observation] = [uuid7(), uuid7()];
    this.state.set({ drawing: null });
    this.page.submit({
      kind: "draw",
      observation_id: observation,
      element_id: element,
      frame_index: this.state.frame ?? 0,
      side,
      second: this.state.second,
      class_id: id,
      anchor_px: anchor,
      end_px: end,
      anchor_known: anchor_known && !(end && this.#isCut(side, anchor)),
      end_known: end_known && !(end && this.#isCut(side, end)),
      selected_id: this.state.selectedId,
      is_chosen: this.state.isChosen,
      asks_same: !onTop,
      snap: this.state.aids.snap && !box,
      asks_bottom: this.state.aids.snap && asks_bottom,
    });
  }

  /** Saves the whole pole as it is shown.
   *
   * @param {Ghost} ghost
   */
  #saveWhole({ side, class: id, anchor, end, anchor_known, end_known }) {
    this.ghosts.drop();
    if (!this.page.mayEdit()) return;
    this.page.submit({
      kind: "draw",
      observation_id: uuid7(),
      element_id: uuid7(),
      frame_index: this.state.frame ?? 0,
      side,
      class_id: id,
      anchor_px: anchor,
      end_px: end,
      anchor_known,
      end_known,
      selected_id: this.state.selectedId,
      is_chosen: this.state.isChosen,
      asks_same: true,
      snap: false,
      asks_bottom: false,
    });
  }

  #cancelPress() {
    this.press = null;
    this.state.set({ dragged: null, rectangle: null });
  }

  #leave() {
    if (this.press) return;
    this.images.pointer = null;
    this.images.hovered = null;
    this.#point(null);
    this.ghosts.drop();
    this.images.repaint();
  }

  /** @param {WheelEvent} event */
  #wheel(event) {
    event.preventDefault();
    const point = pointerAt(event);
    if (event.shiftKey) this.images.panBy(-(event.deltaX || event.deltaY), 0);
    else this.images.zoomAt(point, Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.002)));
  }

  /** Whether a pole's end lies on the image's border: there it is cut off.
   *
   * @param {Side} side
   * @param {Point} pixel
   */
  #isCut(side, pixel) {
    return !this.#isInside(side, pixel, -1);
  }

  /**
   * @param {Side} side
   * @param {Point} pixel
   * @param {number} margin
   */
  #isInside(side, [u, v], margin) {
    const { width, height } = this.#size(side);
    const low = -0.5 - margin;
    return u >= low && v >= low && u <= width - 0.5 + margin && v <= height - 0.5 + margin;
  }

  /** @param {Side} side */
  #size(side) {
    return this.state.workspace.images[side] ?? { width: 0, height: 0 };
  }

  /** The nearest pixel inside the image.
   *
   * @param {Side} side
   * @param {Point} pixel
   * @returns {Point}
   */
  #inside(side, [u, v]) {
    const { width, height } = this.#size(side);
    return [Math.min(Math.max(u, -0.5), width - 0.5), Math.min(Math.max(v, -0.5), height - 0.5)];
  }
}

/** The point of a box midway across and at a share of its height from its top.
 *
 * @param {Point} first
 * @param {Point} second
 * @param {number} share
 * @returns {Point}
 */
const inBox = ([a, b], [c, d], share) => [(a + c) / 2, Math.min(b, d) + share * Math.abs(d - b)];
