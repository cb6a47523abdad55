// @ts-check
// The filmstrip on the page: a row per element, a column per frame, both images in each cell.
/** @import {annotator} from "/static/protocol" */
/** @import {Cell, Filmstrip} from "./filmstrip.js" */
/** @import {Point, Proposal, Side} from "../values.js" */
import { pointerAt } from "/static/canvas.js";
import { byId, el, fill } from "/static/dom.js";
import { classGlyph } from "/static/glyphs.js";
import { cropOf, dragged, drawCrop } from "./filmstrip_crop.js";
import { marksOf } from "../proposals.js";
import { counted, shownScore } from "../values.js";
import { RenderCache, badge } from "../panels/widgets.js";

const NAMES = 84, GAP = 6, HEADER = 36; // of the grid, CSS pixels; the header with the grid's rim
const HEIGHT = { least: 40, most: 190 }; // of a row
const DRAG_FROM = 4; // CSS pixels; a shorter one is a click
const HINTS = /** @type {const} */ ([
  [["Ctrl Enter"], "accept what is marked ✓"], [["Shift G"], "mark weak ones too"], [["Click"], "take, leave out"], [["Drag"], "correct"],
  [["X"], "reject"], [["Enter"], "open the frame"], [["Esc"], "back"],
]);

export class FilmstripGrid {
  /** @param {Filmstrip} strip */
  constructor(strip) {
    this.strip = strip;
    this.cache = new RenderCache(strip.state);
    this.body = byId("filmstrip-cells");
    this.shown = ""; // what the grid was built from
    /** @type {Map<string, () => void>} */
    this.redraws = new Map(); // of the cells, by their key
    this.isHeld = false; // a drag goes on
    this.laidOut = ""; // the rows, and the height of the grid
    this.seen = 0; // how far down the rows were looked at, CSS pixels
    new ResizeObserver(() => this.show()).observe(this.body);
    this.body.addEventListener("scroll", () => this.#saw(), { passive: true });
  }

  #saw() {
    this.seen = Math.max(this.seen, this.body.scrollTop + this.body.clientHeight);
  }

  /** Scrolls on if there are rows that were not in view yet. Returns whether there are. */
  scrollOn() {
    if (this.seen >= this.body.scrollHeight - GAP) return false;
    this.body.scrollTop = this.seen - HEADER;
    this.#saw(); // its event comes later
    return true;
  }

  /** The elements of the strip: first those with weak marks; class by class, the nearest first. */
  get rows() {
    /** @type {Map<string, Proposal>} */
    const rows = new Map();
    const weak = this.strip.doubtful;
    for (const { proposal } of this.strip.cells) if (!rows.has(proposal.id)) rows.set(proposal.id, proposal);
    return [...rows.values()].sort((a, b) => Number(weak.has(b.id)) - Number(weak.has(a.id)) || a.class_id - b.class_id || (a.depth_m ?? 0) - (b.depth_m ?? 0));
  }

  show() {
    const { strip } = this;
    if (!strip.isShown) return;
    const { frames, found } = strip;
    const built = JSON.stringify([frames, [...found].map(([frame, all]) => [frame, all.map(({ id, marks }) => [id, marks])]), this.body.clientWidth, this.body.clientHeight]);
    if (built !== this.shown && !this.isHeld) {
      this.shown = built;
      this.#build();
    }
    this.redraws.forEach((redraw) => redraw());
    this.cache.show("filmstrip-hints", [], () => HINTS.map(([keys, text]) => el("span", { class: "hint" }, ...keys.map((name) => badge(strip.keys, name)), text)));
    byId("filmstrip-about").textContent = this.#about();
  }

  #about() {
    const { strip } = this, { frames, cells } = strip;
    if (!frames.length) return "no frame before or after this one is open";
    const where = `frames ${frames[0]} to ${frames[frames.length - 1]}`;
    if (strip.isSearching) return strip.state.connected ? `${where}, searching the images …` : `${where}. Offline: the images are searched when the server is back`;
    const taken = cells.filter((cell) => strip.isTaken(cell)).length;
    return `${where}: ${taken} of ${counted(cells.length, "proposal")} marked ✓`;
  }

  #build() {
    const { strip } = this, { frames, state } = strip;
    const rows = this.rows;
    const wide = (this.body.clientWidth - NAMES - 20) / Math.max(frames.length, 1) - GAP;
    const tall = Math.min(HEIGHT.most, Math.max(HEIGHT.least, Math.floor((this.body.clientHeight - HEADER) / Math.max(rows.length, 1)) - GAP));
    const laidOut = JSON.stringify([frames, this.body.clientHeight, rows.map(({ id }) => id)]);
    if (laidOut !== this.laidOut) this.seen = this.body.clientHeight; // else the same rows were looked at already
    this.laidOut = laidOut;
    this.redraws.clear();
    this.body.style.gridTemplateColumns = `${NAMES}px repeat(${frames.length}, minmax(0, 1fr))`;
    const cells = new Map(strip.cells.map((cell) => [cell.key, cell]));
    const head = [el("span"), ...frames.map((frame) => el("button", { class: "small", title: "Open this frame in the images", onclick: () => strip.openFrame(frame) }, `Frame ${frame}`))];
    fill(this.body, [...head, ...rows.flatMap((row) => {
      const kind = state.classOf(row.class_id);
      return [
        el("span", { class: "filmstrip-name" }, classGlyph(kind, state.colorOf(kind)), row.name),
        ...frames.map((frame) => {
          const cell = cells.get(`${frame}/${row.id}`);
          return cell ? this.#cell(cell, [(wide - 2) / 2 - 2, tall - 4]) : el("span", { class: "dim filmstrip-none", text: strip.found.has(frame) ? "—" : "…" });
        }),
      ];
    })]);
  }

  /**
   * @param {Cell} cell
   * @param {Point} size of each of its two crops
   */
  #cell(cell, size) {
    const { strip } = this;
    const { name, score, is_confident: isSure } = cell.proposal;
    const about = el("span", { class: "filmstrip-state" });
    const crops = marksOf(cell.proposal).map(([side, mark]) => this.#crop(cell, side, mark, size));
    const node = el("div", { class: isSure ? "filmstrip-cell" : "filmstrip-cell weak", role: "gridcell", data: { cell: cell.key }, title: `${name} in frame ${cell.frame}${isSure ? "" : `: weak, score ${shownScore(score ?? 0)}`}` },
      ...crops.map(({ canvas }) => canvas), about);
    node.addEventListener("pointermove", () => { // keys are for what is pointed at
      if (strip.chosen !== cell.key) strip.choose(cell.key);
    });
    this.redraws.set(cell.key, () => {
      const isTaken = strip.isTaken(cell);
      node.setAttribute("aria-selected", String(isTaken));
      node.setAttribute("aria-current", String(strip.chosen === cell.key));
      about.textContent = isTaken ? "✓" : isSure || strip.answers.has(cell.key) ? "left out" : `weak ${shownScore(score ?? 0)}`;
      crops.forEach(({ draw }) => draw());
    });
    return node;
  }

  /**
   * @param {Cell} cell
   * @param {Side} side
   * @param {annotator.ProposalMark} mark
   * @param {Point} size
   */
  #crop(cell, side, mark, size) {
    const { strip } = this, { state, page } = strip;
    const ratio = window.devicePixelRatio || 1;
    const crop = cropOf(mark, cell.proposal.depth_m, state.workspace.images[side]?.width ?? 1000, size);
    const canvas = el("canvas", { width: Math.round(size[0] * ratio), height: Math.round(size[1] * ratio), data: { side, crop: JSON.stringify(crop) } });
    canvas.style.width = `${size[0]}px`;
    canvas.style.height = `${size[1]}px`;
    const context = canvas.getContext("2d");
    context?.setTransform(ratio, 0, 0, ratio, 0, 0);
    /** @type {ReturnType<typeof strip.placeOf> | null} */
    let moving = null;
    let bitmap = /** @type {ImageBitmap | null} */ (null);
    const draw = () => {
      if (context && bitmap) drawCrop(context, bitmap, crop, moving ?? strip.placeOf(mark), state.classOf(cell.proposal.class_id).color, strip.isTaken(cell));
    };
    page.pictures.get(cell.frame, side).then((picture) => {
      bitmap = picture.bitmap;
      draw();
    });
    canvas.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      const from = pointerAt(event), before = strip.placeOf(mark);
      this.isHeld = true;
      canvas.setPointerCapture(event.pointerId);
      canvas.onpointermove = (now) => {
        const to = pointerAt(now);
        if (!moving && Math.hypot(to[0] - from[0], to[1] - from[1]) < DRAG_FROM) return;
        moving = { ...before, ...dragged(crop, before, from, to) };
        draw();
      };
      canvas.onpointerup = canvas.onpointercancel = (last) => {
        canvas.onpointermove = canvas.onpointerup = canvas.onpointercancel = null;
        this.isHeld = false;
        const to = moving;
        moving = null;
        if (last.type === "pointercancel") draw();
        else if (to) strip.place(cell, side, to);
        else strip.flip(cell.key);
      };
    });
    return { canvas, draw };
  }
}
