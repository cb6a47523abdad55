// @ts-check
// The view "Tracks": every element in every frame; what is chosen there, and the filter.
/** @import {annotator} from "/static/protocol" */
/** @import {Command, Keys} from "/static/keys.js" */
/** @import {Page} from "../main.js" */
/** @import {State} from "../state.js" */
/** @import {Order} from "./track_filter.js" */
/** @import {Row} from "./track_table.js" */
import { byId } from "/static/dom.js";
import { TrackActions } from "./track_actions.js";
import { ORDER_NAMES, filtered, parseFilter } from "./track_filter.js";
import { TrackMatrix } from "./track_matrix.js";
import { TrackOverview } from "./track_overview.js";
import { TrackPanels } from "./track_panels.js";
import { ABSENT, HIDDEN, NOTHING, PROPOSED, REJECTED, TrackTable, UNPLACED } from "./track_table.js";
import { TrackViews } from "./track_views.js";
import { counted, spaced } from "../values.js";

const REST_MS = 150; // a frame or an element is loaded once the keys rest
const FULL_COLUMNS = 88;

export class Tracks {
  /**
   * @param {State} state
   * @param {Keys} keys
   * @param {Page} page
   */
  constructor(state, keys, page) {
    this.state = state;
    this.keys = keys;
    this.page = page;
    this.table = new TrackTable();
    /** @type {Map<number, number>} places of frames in the order of time, by index */
    this.placesOf = new Map();
    this.filterText = new URLSearchParams(location.search).get("filter") ?? "";
    this.filter = parseFilter("", [], this.placesOf);
    /** @type {Order} */
    this.order = "first seen";
    /** @type {Row[]} */
    this.shown = []; // the rows that the filter leaves
    this.filterKey = "";
    /** @type {number | null} */
    this.place = null; // of the cell that keys act on
    this.frame = -1; // the frame of the page that `place` followed last
    /** @type {[number, number] | null} */
    this.span = null; // the ends of the range: where it began, and where it is now
    this.since = 0; // when rows were requested, ms
    /** @type {annotator.TrackDetails | null} */
    this.known = null; // the chosen element
    this.asked = ""; // the version of an element that was requested
    this.read = ""; // the one that is known
    /** @type {(() => void) | null} */
    this.onceRead = null; // an action on the chosen element that waits for this version
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.timer = undefined;
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.detailTimer = undefined;
    this.matrix = new TrackMatrix(this);
    this.overview = new TrackOverview(this);
    this.actions = new TrackActions(this);
    this.panels = new TrackPanels(this);
    this.views = new TrackViews(this);
    page.socket.on("tracks", (event) => this.#received(event));
    page.socket.on("track", ({ track }) => {
      if (track.id !== this.chosenId) return;
      this.known = track;
      this.read = this.#version();
      const waiting = this.onceRead;
      this.onceRead = null;
      waiting?.();
      state.set({});
    });
    page.socket.on("track_proposals", (event) => this.actions.found(event));
    page.socket.on("resnap", (event) => this.actions.snapped(event));
    page.socket.on("workspace", () => { // connected again, or with other poses
      this.actions.isSearching = false;
      if (this.isShown || this.table.total !== null) this.#request();
    });
  }

  get isShown() {
    return this.state.view === "tracks";
  }

  /** The number of frames. */
  get places() {
    return this.state.received ? this.state.order.length : 0;
  }

  /** @param {number} place */
  frameAt(place) {
    return this.state.order[place];
  }

  /** @param {number} frame */
  placeOf(frame) {
    return this.placesOf.get(frame);
  }

  /** The id of the chosen element, or "". */
  get chosenId() {
    return this.state.selected?.element ?? "";
  }

  /** The row of the chosen element; null if it has none. */
  get row() {
    return this.table.rows.get(this.chosenId) ?? null;
  }

  /** What is known of the chosen element; null until it has arrived. */
  get details() {
    return this.known?.id === this.chosenId ? this.known : null;
  }

  /** Whether what is known of the chosen element is of its labels as they are now. */
  get isRead() {
    return this.details !== null && this.read === this.#version();
  }

  /** The chosen range of places, both inclusive; null for none.
   *
   * @returns {[number, number] | null}
   */
  get range() {
    return this.span && [Math.min(...this.span), Math.max(...this.span)];
  }

  /** The chosen range as frames; without one, that of the chosen cell.
   *
   * @returns {[number, number]}
   */
  get frames() {
    const [first, last] = this.range ?? [this.place ?? 0, this.place ?? 0];
    return [this.frameAt(first), this.frameAt(last)];
  }

  /** The part of the address that keeps the filter. */
  inAddress() {
    return this.isShown && this.filterText ? `&filter=${encodeURIComponent(this.filterText)}` : "";
  }

  entered() {
    this.matrix.look(this.matrix.first);
    this.#request();
    if (this.row) this.reveal();
  }

  left() {
    this.actions.drop();
  }

  #request() {
    this.since = performance.now();
    this.page.socket.send("show_tracks", {});
  }

  /** @param {annotator.TracksEvent} event */
  #received(event) {
    if (this.placesOf.size !== this.places) this.placesOf = new Map(this.state.order.map((index, place) => [index, place]));
    if (event.total !== null && event.total !== undefined) this.table.rows.clear(); // the answer has all that is known
    this.table.merge(event, this.placesOf);
    if (event.rows.some(({ id }) => id === this.chosenId)) this.actions.changed();
    this.refilter();
  }

  /** Reads the filter again, and applies it. */
  refilter() {
    if (!this.state.known) return;
    this.filter = parseFilter(this.filterText, this.state.workspace.classes, this.placesOf);
    this.shown = filtered(this.table, this.filter, this.order, this.places);
    this.filterKey = `${this.filterText} ${this.order}`;
    this.matrix.look(this.matrix.first);
    this.state.set({});
  }

  /** @param {string} text */
  setFilter(text) {
    this.filterText = text.trim();
    this.page.go(this.state.frame); // the address keeps it
    this.refilter();
    if (this.filter.frames) this.zoomTo(this.filter.frames);
  }

  sortNext() {
    this.order = ORDER_NAMES[(ORDER_NAMES.indexOf(this.order) + 1) % ORDER_NAMES.length];
    this.refilter();
  }

  /** Chooses a row, and a cell of it.
   *
   * @param {Row} row
   * @param {number | null} place null keeps the frame
   * @param {boolean} widens whether the range goes from the cell before to this one
   */
  choose(row, place, widens = false) {
    if (row.id !== this.chosenId) {
      this.onceRead = null;
      this.actions.drop();
      this.page.select(row.id);
      if (!widens) this.span = null;
    }
    if (place === null) this.state.set({});
    else if (widens) this.widen(place);
    else this.#goTo(place, null);
  }

  /** Lets the range end at a place.
   *
   * @param {number} place
   */
  widen(place) {
    if (place === this.place) return;
    this.#goTo(place, [this.span?.[0] ?? this.place ?? place, place]);
  }

  /** Moves the cell that keys act on.
   *
   * @param {number} by frames
   * @param {boolean} widens
   */
  step(by, widens = false) {
    const place = Math.max(0, Math.min((this.place ?? 0) + by, this.places - 1));
    if (widens) this.widen(place);
    else this.#goTo(place, null);
    this.reveal();
  }

  /** Chooses the row `by` rows further.
   *
   * @param {number} by
   */
  stepRow(by) {
    const { shown } = this;
    if (!shown.length) return;
    const at = shown.findIndex(({ id }) => id === this.chosenId);
    const next = shown[at < 0 ? 0 : Math.max(0, Math.min(at + by, shown.length - 1))];
    const [first, last] = this.table.span(next);
    const isInside = this.place !== null && this.place >= first && this.place <= last;
    this.choose(next, isInside ? null : first);
    this.reveal();
  }

  /**
   * @param {number} place
   * @param {[number, number] | null} span
   */
  #goTo(place, span) {
    this.place = place;
    this.span = span;
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.page.go(this.frameAt(this.place ?? 0)), REST_MS);
    this.actions.rangeChanged();
    this.state.set({});
  }

  /** Scrolls to the chosen cell. */
  reveal() {
    this.matrix.reveal(this.place ?? 0, this.shown.findIndex(({ id }) => id === this.chosenId));
    this.overview.surface.redraw();
  }

  /** Zooms to places from the first to the last.
   *
   * @param {[number, number]} places
   */
  zoomTo([first, last]) {
    this.matrix.look(first - 1, last - first + 3);
    this.reveal();
  }

  /** Whether the preview of an action changes a cell of the chosen row.
   *
   * @param {number} place
   */
  isPreviewed(place) {
    return this.actions.pending?.frames.has(this.frameAt(place)) ?? false;
  }

  /** Numbers for the overview.
   *
   * @returns {string[]}
   */
  summary() {
    const rows = [...this.table.rows.values()];
    const labels = rows.reduce((sum, row) => sum + (row.number < 0 ? 0 : row.views), 0);
    return [`${counted(this.places, "frame")}`, `${counted(rows.length, "row")}, ${spaced(labels)} labels`];
  }

  /** What a cell is, in words.
   *
   * @param {Row} row
   * @param {number} place
   */
  tooltip(row, place) {
    const words = /** @type {Record<number, string>} */ ({ [PROPOSED]: "proposed", [REJECTED]: "rejected", [HIDDEN]: "hidden", [ABSENT]: "no longer there", [UNPLACED]: "labelled, no position" });
    const [left, right] = this.table.cells(row, place).map((code) => (code === NOTHING ? "–" : words[code] ?? `${(code / 10).toFixed(1)} px`));
    return `${row.name}, frame ${this.frameAt(place)}: left ${left}, right ${right}`;
  }

  /** Leaves the innermost of what is going on: preview, range, filter, the view. */
  escape() {
    if (this.actions.drop()) return;
    if (this.span) {
      this.span = null;
      this.state.set({});
    } else if (this.filterText) this.setFilter("");
    else this.page.views.open("images");
  }

  /** Commands for `Keys`.
   *
   * @returns {Command[]}
   */
  commands() {
    const { actions, matrix } = this;
    const group = "Tracks", view = "tracks";
    /** @type {(key: string, title: string, run: () => void, more?: Partial<Command>) => Command} */
    const own = (key, title, run, more = {}) => ({ key, view, group, title, run, ...more });
    const shift = true;
    const arrows = "Previous, next frame and element", range = "Widen the range";
    return [
      own("/", "Filter and search", () => byId("track-search").focus(), { words: "find class score residual flag note" }),
      own("ArrowLeft", "Previous frame", () => this.step(-1), { row: arrows }),
      own("ArrowRight", "Next frame", () => this.step(1), { row: arrows }),
      own("ArrowUp", "Previous element", () => this.stepRow(-1), { row: arrows }),
      own("ArrowDown", "Next element", () => this.stepRow(1), { row: arrows }),
      own("ArrowLeft", "Widen the range to the left", () => this.step(-1, true), { shift, row: range }),
      own("ArrowRight", "Widen the range to the right", () => this.step(1, true), { shift, row: range }),
      own("Tab", "Next element", () => this.stepRow(1), { row: "Next, previous element" }),
      own("Tab", "Previous element", () => this.stepRow(-1), { shift, row: "Next, previous element" }),
      own("PageUp", "A page of elements up", () => this.stepRow(-matrix.visibleRows), { row: "A page up, down" }),
      own("PageDown", "A page of elements down", () => this.stepRow(matrix.visibleRows), { row: "A page up, down" }),
      own("z", "Zoom to the element", () => { if (this.row) this.zoomTo(this.table.span(this.row)); }),
      own("0", "Whole drive", () => matrix.look(0, Math.max(this.places, FULL_COLUMNS))),
      own("Enter", "Open the frame in the images", () => this.page.views.open("images")),
      own(" ", "Accept this cell, or this track", () => actions.acceptCell()),
      own("x", "Reject this cell, or this track", () => actions.rejectCell()),
      own("r", "Re-snap the track: what was accepted", () => actions.resnap(), { shift, words: "edges again" }),
      own("b", "Verify, from the nearest view backwards", () => this.views.verify(), { shift, words: "check seen" }),
      own("u", "Split here: from this frame on another element", () => actions.split(), { shift, words: "unlink" }),
      own("p", "Merge with the nearest element", () => actions.merge(), { shift, words: "link" }),
      own("x", "Unsure: asks a second person; of tracks of a detector: reject all that the filter leaves", () => actions.toggleUnsure(), { shift, words: "flag doubt" }),
      own("n", "Note on the element", () => this.panels.startNote(), { words: "comment" }),
      own(" ", "Accept all sure ones in the range", () => actions.acceptSure(), { shift }),
      ...this.state.workspace.classes.filter(({ key }) => key).map(({ id, name, key }) =>
        own(key, `Class in the range: ${name}`, () => actions.setClass(id), { shift, row: "Class in the range" })),
      own("Delete", "Delete the labels of the cell or range", () => actions.remove()),
      own("Enter", "Apply what is previewed", () => actions.apply(), { ctrl: true }),
      own("Escape", "Drop the preview; the range; the filter", () => this.escape()),
      own("o", "Sort the elements differently", () => this.sortNext(), { words: "order" }),
    ];
  }

  /** Redraws; called whenever the state of the page changes. */
  show() {
    if (!this.isShown) return;
    this.#follow();
    this.#askDetails();
    this.panels.show();
    this.views.show();
    this.matrix.surface.redraw();
    this.overview.surface.redraw();
  }

  /** Takes over the frame that the page shows, if another part of the page changed it. */
  #follow() {
    const { frame } = this.state;
    if (frame === null || frame === this.frame) return;
    this.frame = frame;
    this.place = this.placesOf.get(frame) ?? this.state.order.indexOf(frame);
  }

  /** The chosen element with its labels, as a text that changes with them; "" for none. */
  #version() {
    const { row } = this;
    return row && row.number >= 0 ? JSON.stringify(row) : "";
  }

  /** Requests the chosen element, if it or its labels changed. */
  #askDetails() {
    const { row } = this, wanted = this.#version();
    if (wanted === this.asked) return;
    this.asked = wanted;
    clearTimeout(this.detailTimer);
    if (row && wanted) this.detailTimer = setTimeout(() => this.page.socket.send("show_track", { element_id: row.id }), this.details ? 0 : REST_MS);
  }
}
