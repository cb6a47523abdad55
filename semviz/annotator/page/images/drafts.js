// @ts-check
// What is not drawn yet: the whole pole that a click would take, and a half-drawn pole.
/** @import {Images} from "./images.js" */
/** @import {Page} from "../main.js" */
/** @import {State} from "../state.js" */
/** @import {Drawing, Ghost, Point, Side} from "../values.js" */
import { Refusal } from "/static/socket.js";

const REST_MS = 60; // the pointer rests so long before the server is asked
const NEAR = 9; // CSS pixels; a ghost stays while the pointer is this close

/** Finds the whole pole under the pointer or the keyboard cursor. */
export class GhostFinder {
  /**
   * @param {State} state
   * @param {Images} images
   * @param {Pick<Page, "socket">} page
   */
  constructor(state, images, page) {
    this.state = state;
    this.images = images;
    this.page = page;
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.timer = undefined;
    this.isSeeking = false;
    this.isWaiting = false; // for the pointer to rest
    /** @type {{side: Side, pixel: Point} | null} */
    this.wanted = null; // where the pointer is now
  }

  /** Seeks the whole pole under a pixel, unless it is shown already.
   *
   * @param {Side} side
   * @param {Point} pixel
   */
  seek(side, pixel) {
    clearTimeout(this.timer);
    this.isWaiting = false;
    if (!this.#isOn(side) || !this.images.bitmap(side)) {
      this.drop();
      return;
    }
    this.wanted = { side, pixel };
    if (this.at(side, pixel)) return;
    this.#show(null);
    this.isWaiting = true;
    this.timer = setTimeout(() => this.#ask(), REST_MS);
  }

  /** Forgets the pole, for example where an element is under the pointer. */
  drop() {
    clearTimeout(this.timer);
    this.isWaiting = false;
    this.wanted = null;
    this.#show(null);
  }

  /** The pole that a click at a pixel takes; null if none is shown there.
   *
   * @param {Side} side
   * @param {Point} pixel
   */
  at(side, pixel) {
    const { ghost, frame } = this.state;
    if (!ghost || ghost.side !== side || ghost.frame !== frame || !this.#isOn(side)) return null;
    return distance(pixel, ghost.anchor, ghost.end) * this.images.view.scale <= NEAR ? ghost : null;
  }

  /** Whether the pole under the pointer is not known yet. */
  get isBusy() {
    return this.isSeeking || this.isWaiting;
  }

  /** @param {Side} side */
  #isOn(side) {
    const { aids, drawing, past, connected, isReady } = this.state;
    return isReady && connected && aids.whole && aids.snap && !drawing && !past && this.state.classOf(this.state.nextClass(side)).kind === "line";
  }

  async #ask() {
    this.isWaiting = false;
    if (this.isSeeking || !this.wanted) return; // the answer that is awaited asks again
    const { side, pixel } = this.wanted;
    const { frame } = this.state;
    this.isSeeking = true;
    const ghost = await this.#found(side, pixel, frame ?? 0);
    this.isSeeking = false;
    if (!this.wanted) return;
    const isSame = this.wanted.side === side && this.wanted.pixel === pixel;
    this.#show(ghost);
    if (!this.at(this.wanted.side, this.wanted.pixel)) {
      this.#show(null);
      if (!isSame) this.#ask();
    }
  }

  /**
   * @param {Side} side
   * @param {Point} pixel
   * @param {number} frame
   * @returns {Promise<Ghost | null>}
   */
  async #found(side, pixel, frame) {
    const { selectedId, isChosen } = this.state;
    const classId = this.state.nextClass(side);
    try {
      const { preview } = await this.page.socket.request("preview_draft", { draft: {
        frame_index: frame,
        selected_id: selectedId,
        is_chosen: isChosen,
        side,
        drawing: {
          side, class_id: classId, anchor_px: pixel, end_px: pixel, anchor_known: true, end_known: true, snap: false, asks_bottom: true, whole: true,
        },
        moved: {},
      } });
      const { snapped, joins } = preview;
      return snapped?.end ? { ...snapped, end: snapped.end, side, frame, class: classId, joins } : null;
    } catch (refusal) {
      if (!(refusal instanceof Refusal)) throw refusal;
      return null; // offline, or the frame has gone
    }
  }

  /** @param {Ghost | null} ghost */
  #show(ghost) {
    if (ghost !== this.state.ghost) this.state.set({ ghost });
  }
}

/** Keeps a half-drawn pole in sessionStorage, so that it survives a reload or a rebuilt frame. */
export class Sketch {
  /**
   * @param {State} state
   * @param {string} workspace key of the workspace
   */
  constructor(state, workspace) {
    this.state = state;
    this.key = `semviz.sketch.${workspace}`;
    /** @type {Drawing | null} */
    this.saved = null;
    state.onChange(() => this.#store());
  }

  /** Resumes the drawing that was left in the frame on screen. */
  restore() {
    const left = JSON.parse(sessionStorage.getItem(this.key) ?? "null");
    if (left?.frame === this.state.frame) this.state.set({ drawing: left.drawing });
  }

  /** Stores only a drawing that waits for its second click; one stroke ends with the press. */
  #store() {
    const { drawing, frame } = this.state;
    if (drawing === this.saved) return;
    this.saved = drawing;
    if (drawing?.end) sessionStorage.setItem(this.key, JSON.stringify({ frame, drawing }));
    else sessionStorage.removeItem(this.key);
  }
}

/** The distance of a point from a line between two points.
 *
 * @param {Point} point
 * @param {Point} from
 * @param {Point} to
 */
function distance([u, v], [u0, v0], [u1, v1]) {
  const [du, dv] = [u1 - u0, v1 - v0];
  const share = Math.min(Math.max(((u - u0) * du + (v - v0) * dv) / (du * du + dv * dv || 1), 0), 1);
  return Math.hypot(u - u0 - share * du, v - v0 - share * dv);
}
