// @ts-check
// The strip of frames: thumbnail, number of elements, review state.
/** @import {annotator} from "/static/protocol" */
/** @import {Page} from "../main.js" */
/** @import {State} from "../state.js" */
import { byId, el, svg } from "/static/dom.js";

export const REVIEWS = [
  ["reviewed", "Reviewed"],
  ["reviewed, empty", "Reviewed, empty"],
  ["in work", "In work"],
  ["unseen", "Unseen"],
];

const BESIDE = 4; // tiles drawn beyond each end of the visible part

/** Builds only the visible tiles: a drive may have ten thousand frames. */
export class Strip {
  /**
   * @param {State} state
   * @param {Pick<Page, "go">} page
   */
  constructor(state, page) {
    this.state = state;
    this.page = page;
    /** @type {Map<number, HTMLElement>} */
    this.tiles = new Map(); // by index in time
    /** @type {number | null} */
    this.current = null;
    /** @type {annotator.FrameSummary[]} */
    this.frames = [];
    // where the tiles are, CSS pixels; asking anew would lay the page out at each change of the state
    this.pitch = 0; // from one tile to the next; 0 while the strip is hidden
    this.width = 0; // of the visible part
    this.left = 0; // how far it is scrolled
    this.rail = el("div", { class: "rail" });
    this.root = byId("strip");
    this.root.append(this.rail);
    this.root.addEventListener("scroll", () => this.#scrolled(this.root.scrollLeft), { passive: true });
    const sizes = new ResizeObserver(() => this.#measure());
    sizes.observe(this.root);
    sizes.observe(this.rail);
  }

  show() {
    const { labels, frame } = this.state;
    if (labels.frames !== this.frames) {
      this.frames = labels.frames;
      this.rail.style.width = `calc(${this.frames.length} * var(--pitch))`;
      this.#legend();
    }
    if (this.current !== frame) {
      this.current = frame;
      this.#center();
    }
    this.#draw();
  }

  #measure() {
    if (!this.frames.length) return; // they have not arrived yet
    const pitch = this.rail.getBoundingClientRect().width / this.frames.length;
    const isOther = pitch !== this.pitch;
    Object.assign(this, { pitch, width: this.root.clientWidth });
    if (isOther) this.#center();
    this.#draw();
  }

  /** Scrolls to the current tile. */
  #center() {
    const most = this.frames.length * this.pitch - this.width;
    const middle = (this.state.order.indexOf(this.current ?? -1) + 0.5) * this.pitch;
    this.root.scrollLeft = this.left = Math.max(0, Math.min(middle - this.width / 2, most));
  }

  /** @param {number} left */
  #scrolled(left) {
    if (left === this.left) return;
    this.left = left;
    this.#draw();
  }

  #draw() {
    if (!this.pitch) return;
    const first = Math.max(0, Math.floor(this.left / this.pitch) - BESIDE);
    const last = Math.min(this.frames.length - 1, Math.ceil((this.left + this.width) / this.pitch) + BESIDE);
    for (const [place, tile] of this.tiles) {
      if (place >= first && place <= last) continue;
      tile.remove();
      this.tiles.delete(place);
    }
    for (let place = first; place <= last; place += 1) {
      const tile = this.tiles.get(place) ?? this.#tile(place);
      this.tiles.set(place, tile);
      this.#update(tile, this.frames[place]);
    }
  }

  /** @param {number} place */
  #tile(place) {
    const { index } = this.frames[place];
    const tile = el("button", { class: "tile", data: { frame: index }, "aria-label": `Frame ${index}`, onclick: () => this.page.go(index) },
      el("img", { alt: "", draggable: "false", src: `thumbnail/${index}.jpg` }), el("span", { class: "caption" }, el("b", { text: index })));
    tile.style.left = `calc(${place} * var(--pitch))`;
    this.rail.append(tile);
    return tile;
  }

  /**
   * @param {HTMLElement} tile
   * @param {annotator.FrameSummary} frame
   */
  #update(tile, { index, state, elements }) {
    const now = `${state} ${elements} ${index === this.state.frame}`;
    if (tile.dataset.now === now) return;
    tile.dataset.now = now;
    tile.className = `tile ${state === "unseen" ? "unseen" : ""} ${index === this.state.frame ? "current" : ""}`;
    tile.title = `Frame ${index}: ${state}, ${elements} elements`;
    tile.lastElementChild?.replaceChildren(
      el("b", { text: index }), el("span", { class: "dim", text: state === "unseen" ? "" : elements }), reviewMark(state));
  }

  #legend() {
    const count = (/** @type {string} */ wanted) => this.frames.filter(({ state }) => state === wanted).length;
    const rows = REVIEWS.map(([state, text]) =>
      el("li", {}, reviewMark(state), el("span", { class: "fill", text }), el("b", { text: count(state) })));
    byId("legend").replaceChildren(...rows);
  }
}

/** The icon of a review state: disc, struck circle, half disc or dashed circle.
 *
 * @param {string} state
 */
function reviewMark(state) {
  const icon = svg("svg", { class: "review", viewBox: "-6 -6 12 12", "aria-label": state });
  const ring = { r: 4.2, class: state === "unseen" ? "dashed" : "ring" };
  if (state === "reviewed") icon.append(svg("circle", { r: 4.8, class: "disc" }));
  else icon.append(svg("circle", ring));
  if (state === "reviewed, empty") icon.append(svg("path", { d: "M-3 3 3-3", class: "ring" }));
  if (state === "in work") icon.append(svg("path", { d: "M0-4.2A4.2 4.2 0 0 0 0 4.2Z", class: "disc" }));
  return icon;
}
