// The frames along the bottom: picture, number of elements, how far each is.
import { byId, el, svg } from "/static/dom.js";

export const REVIEWS = [
  ["reviewed", "Reviewed"],
  ["reviewed, empty", "Reviewed, empty"],
  ["in work", "In work"],
  ["unseen", "Unseen"],
];

export class Strip {
  constructor(state, actions) {
    this.state = state;
    this.actions = actions;
    this.tiles = new Map();
    this.current = null;
    // pictures are asked for when their tile comes near, not a thousand at once
    this.watch = new IntersectionObserver((entries) => entries.forEach(load), { root: byId("strip"), rootMargin: "0px 300px" });
  }

  show() {
    const { frames } = this.state.labels;
    if (this.tiles.size !== frames.length) this.#build(frames);
    const counts = new Map();
    for (const frame of frames) {
      counts.set(frame.state, (counts.get(frame.state) ?? 0) + 1);
      this.#update(this.tiles.get(frame.index), frame);
    }
    this.#legend(counts);
    if (this.current === this.state.frame) return;
    this.current = this.state.frame;
    this.tiles.get(this.current)?.scrollIntoView({ block: "nearest", inline: "center" });
  }

  #build(frames) {
    this.tiles = new Map(frames.map(({ index }) => [index, this.#tile(index)]));
    byId("strip").replaceChildren(...this.tiles.values());
    this.tiles.forEach((tile) => this.watch.observe(tile));
  }

  #tile(index) {
    return el("button", { class: "tile", data: { frame: index }, "aria-label": `Frame ${index}`, onclick: () => this.actions.go(index) },
      el("img", { alt: "", draggable: "false" }), el("span", { class: "caption" }, el("b", { text: index })));
  }

  #update(tile, { index, state, elements }) {
    const now = `${state} ${elements} ${index === this.state.frame}`;
    if (tile.dataset.now === now) return;
    tile.dataset.now = now;
    tile.className = `tile ${state === "unseen" ? "unseen" : ""} ${index === this.state.frame ? "current" : ""}`;
    tile.title = `Frame ${index}: ${state}, ${elements} elements`;
    tile.lastChild.replaceChildren(
      el("b", { text: index }), el("span", { class: "dim", text: state === "unseen" ? "" : elements }), reviewMark(state));
  }

  #legend(counts) {
    const rows = REVIEWS.map(([state, text]) =>
      el("li", {}, reviewMark(state), el("span", { class: "fill", text }), el("b", { text: counts.get(state) ?? 0 })));
    byId("legend").replaceChildren(...rows);
  }
}

function load(entry) {
  const picture = entry.target.querySelector("img");
  if (entry.isIntersecting && !picture.src) picture.src = `/thumbnail/${entry.target.dataset.frame}.jpg`;
}

/** Disc, struck circle, half disc or dashed circle. */
function reviewMark(state) {
  const icon = svg("svg", { class: "review", viewBox: "-6 -6 12 12", "aria-label": state });
  const ring = { r: 4.2, class: state === "unseen" ? "dashed" : "ring" };
  if (state === "reviewed") icon.append(svg("circle", { r: 4.8, class: "disc" }));
  else icon.append(svg("circle", ring));
  if (state === "reviewed, empty") icon.append(svg("path", { d: "M-3 3 3-3", class: "ring" }));
  if (state === "in work") icon.append(svg("path", { d: "M0-4.2A4.2 4.2 0 0 0 0 4.2Z", class: "disc" }));
  return icon;
}
