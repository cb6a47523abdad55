// @ts-check
// The view "Filmstrip": what is proposed in the frames between two that were labelled, cut out and enlarged. One
// look and one key take a stretch of frames.
/** @import {annotator} from "/static/protocol" */
/** @import {Command, Keys} from "/static/keys.js" */
/** @import {CropMark} from "./filmstrip_crop.js" */
/** @import {Page} from "../main.js" */
/** @import {State} from "../state.js" */
/** @import {Proposal, Side} from "../values.js" */
import { FilmstripGrid } from "./filmstrip_grid.js";
import { dismissals, drawnMark, marksOf } from "../proposals.js";
import { LEAST_SCORE } from "../state.js";
import { counted } from "../values.js";

export const STRIDE = 5; // of key frames
const MOST = STRIDE - 1; // frames on the strip

/** What is proposed for an element in a frame of the strip.
 * @typedef {{key: string, frame: number, proposal: Proposal}} Cell */

export class Filmstrip {
  /**
   * @param {State} state
   * @param {Keys} keys
   * @param {Page} page
   */
  constructor(state, keys, page) {
    this.state = state;
    this.keys = keys;
    this.page = page;
    /** @type {number[]} */
    this.frames = []; // on the strip
    /** @type {Map<number, Proposal[]>} */
    this.found = new Map(); // by frame, as soon as its images were searched
    /** @type {Map<string, boolean>} */
    this.answers = new Map(); // whether a cell is taken, by its key, where somebody said so
    this.takesWeak = false; // whether weak ones are taken unless somebody said no
    /** @type {Map<string, CropMark>} */
    this.placed = new Map(); // corrected marks, by their id
    this.following = 0; // rows that are searched anew after a correction
    /** @type {Set<string>} */
    this.doubtful = new Set(); // elements that had a weak mark at first: their rows stay on top
    /** @type {string | null} */
    this.chosen = null; // the cell that keys act on
    this.isWanted = false; // the strip waits for saved edits before it is searched
    /** @type {number | null} */
    this.goesTo = null; // the frame that follows the strip
    this.grid = new FilmstripGrid(this);
    page.socket.on("filmstrip", (event) => this.#received(event));
    page.socket.on("filmstrip_row", (event) => this.#followed(event));
    page.socket.on("workspace", () => { this.isWanted ||= this.found.size < this.frames.length; }); // connected again: the search goes on
  }

  get isShown() {
    return this.state.view === "filmstrip";
  }

  get isSearching() {
    return this.found.size < this.frames.length || this.following > 0;
  }

  /** Commands for `Keys`.
   *
   * @returns {Command[]}
   */
  commands() {
    const view = "filmstrip", group = "Filmstrip", row = "Choose a mark", accept = "Accept what is marked ✓; weak ones too";
    return [
      { key: "e", shift: true, view: "", group: "Frames", title: "Key frames: label every fifth; again: every", words: "skip stride stretch", run: () => this.#toggleStride() },
      { key: "Enter", ctrl: true, view, group, title: "Accept what is marked ✓; on to the next key frame", row: accept, run: () => this.accept() },
      { key: "Enter", ctrl: true, shift: true, view, group, title: "Accept weak ones too, but not what you left out", row: accept, run: () => {
        this.takesWeak = true;
        this.accept();
      } },
      { key: "g", shift: true, view, group, title: "Mark weak ones ✓ too; again: sure ones only", run: () => {
        this.takesWeak = !this.takesWeak;
        this.state.set({});
      } },
      { key: " ", view, group, title: "Take or leave out the chosen mark", run: () => this.flip(this.chosen) },
      { key: "x", view, group, title: "Reject the chosen mark: not here", run: () => this.#reject() },
      { key: "Enter", view, group, title: "Open its frame in the images", run: () => this.openFrame(this.cell(this.chosen)?.frame ?? this.frames[0]) },
      ...[["ArrowLeft", 0, -1], ["ArrowRight", 0, 1], ["ArrowUp", -1, 0], ["ArrowDown", 1, 0]].map(([key, down, right]) =>
        ({ key: String(key), view, group, row, title: "Choose a mark", run: () => this.#move(Number(down), Number(right)) })),
      { key: "Escape", view, group, title: "Back to the images", run: () => this.page.views.open("images") },
    ];
  }

  // -- which frames

  /** Whether every fifth frame is labelled first. */
  get isSparse() {
    return localStorage.getItem(this.#strideKey) === "yes";
  }

  get #strideKey() {
    return `semviz.keyframes.${this.state.workspace.key}`;
  }

  #toggleStride() {
    const isSparse = !this.isSparse;
    localStorage.setItem(this.#strideKey, isSparse ? "yes" : "no");
    this.page.notify(isSparse
      ? `Key frames: Ctrl Enter goes ${STRIDE} frames on. The frames between come as a filmstrip (F7).`
      : "Ctrl Enter goes to the next frame.");
    this.state.set({});
  }

  /** After a frame was reviewed: the strip that it was opened from, or that of the frames before it, else the next frame or
   * key frame. */
  goOn() {
    if (this.state.isOfStrip || (this.isSparse && this.#before().length)) this.page.views.open("filmstrip");
    else this.page.go(this.#at(this.isSparse ? STRIDE : 1));
  }

  /** The frame so many places after that on screen, the last one at most.
   *
   * @param {number} by
   */
  #at(by) {
    const { order, frame } = this.state;
    return order[Math.min(order.indexOf(frame ?? -1) + by, order.length - 1)];
  }

  /** The frames before that on screen, back to the last one that was reviewed; none without one. */
  #before() {
    const { labels, order, frame } = this.state;
    const rank = order.indexOf(frame ?? -1);
    const isDone = (/** @type {number} */ place) => labels.frames[place].state.startsWith("reviewed");
    let first = rank;
    while (first > 0 && rank - first < MOST && !isDone(first - 1)) first -= 1;
    return first > 0 && isDone(first - 1) ? order.slice(first, rank) : [];
  }

  /** The frames after that on screen. */
  #ahead() {
    const { order, frame } = this.state;
    const rank = order.indexOf(frame ?? -1);
    return order.slice(rank + 1, rank + 1 + MOST);
  }

  // -- a part of the page

  entered() {
    if (!this.state.isOfStrip) this.#begin();
    this.found.clear(); // what was drawn meanwhile is followed into the other frames
    this.chosen = null;
    this.isWanted = this.frames.length > 0;
    this.state.set({ leftStrip: [] });
  }

  #begin() {
    const before = this.#before();
    this.frames = before.length ? before : this.#ahead();
    this.goesTo = before.length ? this.#at(this.isSparse ? STRIDE : 1) : this.frames[this.frames.length - 1] ?? null;
    this.answers.clear();
    this.takesWeak = false;
    this.placed.clear();
    this.doubtful.clear();
  }

  /** Redraws; called whenever the state of the page changes. */
  show() {
    if (!this.isShown) return;
    if (this.isWanted && this.state.connected && !this.state.pending.length) {
      this.isWanted = false;
      this.page.socket.send("search_filmstrip", { frames: this.frames.filter((frame) => !this.found.has(frame)) });
    }
    this.grid.show();
  }

  /** @param {annotator.FilmstripEvent} event */
  #received({ frame, proposals }) {
    if (!this.frames.includes(frame)) return;
    const found = proposals.filter(({ score }) => (score ?? 0) >= LEAST_SCORE);
    this.found.set(frame, found);
    for (const { id, is_confident: isSure } of found) if (!isSure) this.doubtful.add(id);
    this.chosen ??= this.cells[0]?.key ?? null;
    if (!this.isSearching) new Set(this.#corrected().map(({ proposal }) => proposal.id)).forEach((id) => this.#follow(id)); // back on the strip
    this.state.set({});
  }

  // -- corrections

  /** The corrected marks, with their cells. */
  #corrected() {
    return this.cells.flatMap(({ frame, proposal }) => marksOf(proposal).flatMap(([side, mark]) => {
      const to = this.placed.get(mark.id);
      return to ? [{ proposal, mark: { frame, side, ...to } }] : [];
    }));
  }

  /** Searches an element anew in all frames: what was corrected is followed into the other images.
   *
   * @param {string} id
   */
  #follow(id) {
    const marks = this.#corrected().filter(({ proposal }) => proposal.id === id).map(({ mark }) => mark);
    this.following += 1;
    const ended = () => {
      this.following -= 1;
      this.state.set({});
    };
    this.page.socket.request("follow_corrections", { element_id: id, frames: this.frames, corrected: marks }).then(ended, ended); // offline, the others stay where they are
  }

  /** @param {annotator.FilmstripRowEvent} event */
  #followed({ element_id: id, frames, cells }) {
    for (const frame of frames.filter((each) => this.found.has(each))) {
      const now = cells.find((cell) => cell.frame === frame)?.proposal;
      const isShown = now && ((now.score ?? 0) >= LEAST_SCORE || marksOf(now).some(([, mark]) => this.placed.has(mark.id)));
      const others = (this.found.get(frame) ?? []).filter((proposal) => proposal.id !== id);
      this.found.set(frame, isShown ? [...others, now] : others);
    }
  }

  // -- cells

  /** All cells, frame by frame.
   *
   * @returns {Cell[]}
   */
  get cells() {
    return this.frames.flatMap((frame) => (this.found.get(frame) ?? []).map((proposal) => ({ key: `${frame}/${proposal.id}`, frame, proposal })));
  }

  /** @param {string | null} key */
  cell(key) {
    return this.cells.find((cell) => cell.key === key) ?? null;
  }

  /** Whether a cell is accepted by Ctrl Enter.
   *
   * @param {Cell} cell
   */
  isTaken({ key, proposal }) {
    return this.answers.get(key) ?? (proposal.is_confident || this.takesWeak);
  }

  /** A mark of a cell, corrected.
   *
   * @param {annotator.ProposalMark} mark
   */
  placeOf(mark) {
    return { ...mark, ...this.placed.get(mark.id) };
  }

  /** @param {string | null} key */
  flip(key) {
    const cell = this.cell(key);
    if (!cell) return;
    this.answers.set(cell.key, !this.isTaken(cell));
    this.choose(cell.key);
  }

  /** @param {string} key */
  choose(key) {
    this.chosen = key;
    this.state.set({});
  }

  /** Corrects a mark; its cell is taken.
   *
   * @param {Cell} cell
   * @param {Side} side
   * @param {CropMark} to
   */
  place(cell, side, to) {
    const mark = cell.proposal.marks[side];
    if (!mark) return;
    this.placed.set(mark.id, { anchor: to.anchor, end: to.end, anchor_known: to.anchor_known, end_known: to.end_known });
    this.answers.set(cell.key, true);
    this.#follow(cell.proposal.id);
    this.choose(cell.key);
  }

  /**
   * @param {number} down
   * @param {number} right
   */
  #move(down, right) {
    const now = this.cell(this.chosen);
    const rows = this.grid.rows;
    if (!now) return;
    const [row, column] = [rows.findIndex(({ id }) => id === now.proposal.id), this.frames.indexOf(now.frame)];
    const keys = new Set(this.cells.map(({ key }) => key));
    for (let step = 1; step <= Math.max(rows.length, this.frames.length); step += 1) { // over empty cells
      const [frame, id] = [this.frames[column + step * right], rows[row + step * down]?.id];
      if (frame === undefined || id === undefined) return;
      if (keys.has(`${frame}/${id}`)) {
        this.choose(`${frame}/${id}`);
        return;
      }
    }
  }

  // -- answers

  /** Accepts the marks of the strip in one operation, and goes to the next key frame. */
  accept() {
    if (this.isSearching) {
      this.page.notify(this.state.connected ? "The images are still being searched: a moment." : "Offline: the images are searched when the server is back.");
      return;
    }
    if (!this.page.mayEdit()) return;
    if (this.grid.scrollOn()) {
      this.page.notify("There are more rows: look at them, then press again.");
      return;
    }
    const taken = this.cells.filter((cell) => this.isTaken(cell));
    const marks = taken.flatMap(({ frame, proposal }) => marksOf(proposal).map(([side, mark]) => drawnMark(frame, proposal, side, this.placeOf(mark))));
    const { goesTo } = this;
    if (marks.length) this.page.submit({ kind: "accept", marks });
    this.page.notify(`${counted(marks.length, "label")} accepted in ${counted(new Set(taken.map(({ frame }) => frame)).size, "frame")}. Ctrl Z takes them back.`);
    this.page.views.open("images");
    if (goesTo !== null) this.page.go(goesTo);
  }

  #reject() {
    const cell = this.cell(this.chosen);
    if (!cell) return;
    this.page.submit({ kind: "dismiss", dismissals: dismissals(cell.proposal, "rejected") });
    this.found.set(cell.frame, (this.found.get(cell.frame) ?? []).filter(({ id }) => id !== cell.proposal.id));
    this.chosen = this.cells[0]?.key ?? null;
    this.state.set({});
  }

  /** Shows a frame of the strip in the images; the key that goes on leads back.
   *
   * @param {number | undefined} frame
   */
  openFrame(frame) {
    if (frame === undefined) return;
    this.page.views.open("images");
    this.page.go(frame);
    this.state.set({ leftStrip: this.frames });
    this.page.notify(`Draw what the filmstrip lacks; ${this.keys.shown("Ctrl Enter")} goes back to it.`);
  }
}
