// @ts-check
// The panels around the matrix: filter, card of the chosen element, preview, hints.
/** @import {annotator} from "/static/protocol" */
/** @import {Child} from "/static/dom.js" */
/** @import {Row} from "./track_table.js" */
/** @import {Tracks} from "./tracks.js" */
import { Surface, cssColor } from "/static/canvas.js";
import { byId, el } from "/static/dom.js";
import { classGlyph, residualColor } from "/static/glyphs.js";
import { noHit, classWord } from "./track_filter.js";
import { LOOK_FIRST, counted, spaced } from "../values.js";
import { RenderCache, badge } from "../panels/widgets.js";

const CHIPS = [["residual>2", "Over 2 px"], ["gaps", "Gaps"], ["proposed", "Proposed"], ["look-first", "Look first"], ["unsure", "Unsure"], ["noted", "Notes"]];
const PLOT_PX = [0, 3, 5]; // lines of the plot

export class TrackPanels {
  /** @param {Tracks} tracks */
  constructor(tracks) {
    this.tracks = tracks;
    this.cache = new RenderCache(tracks.state);
    this.search = byId("track-search", HTMLInputElement);
    this.search.value = tracks.filterText;
    this.search.addEventListener("input", () => tracks.setFilter(this.search.value));
    this.search.addEventListener("keydown", (event) => {
      if (event.key !== "Enter" && event.key !== "Escape") return;
      if (event.key === "Escape") tracks.setFilter("");
      this.search.blur();
    });
    byId("track-sort").addEventListener("click", () => tracks.sortNext());
    byId("track-clear").addEventListener("click", () => tracks.setFilter(""));
    this.plot = new Surface(byId("track-plot", HTMLCanvasElement), (context, width, height) => this.#drawPlot(context, width, height));
    this.note = byId("track-note-text", HTMLInputElement);
    byId("track-note").addEventListener("submit", (event) => {
      event.preventDefault();
      const text = this.note.value.trim();
      if (text) tracks.actions.note(text);
      this.#endNote();
    });
    this.note.addEventListener("keydown", (event) => { if (event.key === "Escape") this.#endNote(); });
  }

  /** Opens the line for a note on the chosen element. */
  startNote() {
    const { row, page } = this.tracks;
    if (!row || row.number < 0) {
      page.notify("Choose a labelled element first.", "wrong");
      return;
    }
    byId("track-note").hidden = false;
    this.note.value = "";
    this.note.focus();
  }

  #endNote() {
    byId("track-note").hidden = true;
    this.note.blur();
  }

  show() {
    const { tracks, cache } = this;
    if (document.activeElement !== this.search && this.search.value !== tracks.filterText) this.search.value = tracks.filterText;
    cache.show("track-chips", [tracks.table.version, tracks.filterText], () => this.#chips());
    cache.show("track-count", [tracks.shown.length, tracks.table.rows.size, tracks.table.total, tracks.table.waiting], () => [this.#count()]);
    byId("track-sort").textContent = `Sort: ${tracks.order}`;
    byId("track-clear").hidden = !tracks.filterText;
    const message = this.#message();
    byId("track-message").hidden = !message;
    byId("track-message").textContent = message;
    this.#bar();
    const { row, details, range, actions } = tracks;
    cache.show("track-head", [row, details], () => this.#head());
    cache.show("track-card", [row, details, range, tracks.place, actions.proposals, actions.isSearching, tracks.views.seenCount], () => this.#card());
    this.plot.redraw();
    byId("track-plot-box").hidden = !details;
    cache.show("track-hints", [tracks.place, tracks.shown.length], () => this.#hints());
  }

  /** What stands in place of rows. */
  #message() {
    const { table, filterText, filter, shown, places, state } = this.tracks;
    if (filter.fault) return filter.fault;
    if (table.total === null) return state.connected ? "Reading the tracks …" : "No connection. The tracks load when the server is back.";
    if (shown.length) return "";
    if (table.total === 0) return "No labels yet. Label in Images (F2), or have a detector look.";
    return filterText && table.rows.size ? noHit(filterText, table, filter, places) : "";
  }

  #count() {
    const { table, shown, since } = this.tracks;
    const { total, waiting, rows: { size } } = table;
    if (total !== null && waiting) return `residuals of ${spaced(Math.max(0, total - waiting))} of ${spaced(total)}, ${Math.round((performance.now() - since) / 1000)} s so far`;
    return total === null ? "" : `${spaced(shown.length)} of ${counted(size, "row")}`;
  }

  #chips() {
    const { tracks } = this, { table, state } = tracks;
    const rows = [...table.rows.values()];
    const words = tracks.filterText.split(/\s+/);
    const chip = (/** @type {string} */ word, /** @type {number} */ count, /** @type {Child[]} */ children, title = word) =>
      el("button", { class: "chip", title: `Filter: ${title}`, "aria-pressed": String(words.includes(word)), onclick: () => this.#toggle(word) }, ...children, el("b", { text: ` ${count}` }));
    const classes = state.workspace.classes.map((kind) =>
      chip(`class:${classWord(kind, state.workspace.classes)}`, rows.filter(({ class_id: id }) => id === kind.id).length, [classGlyph(kind, state.colorOf(kind))]));
    const counts = /** @type {Record<string, number>} */ ({
      "residual>2": rows.filter(({ worst_px: px }) => (px ?? 0) > 2).length,
      gaps: rows.filter((row) => table.gaps(row).length).length,
      proposed: rows.filter((row) => table.proposed(row)).length,
      "look-first": rows.filter(({ doubt }) => doubt).length,
      unsure: rows.filter((row) => row.notes.some(({ unsure }) => unsure)).length,
      noted: rows.filter((row) => row.notes.some(({ text }) => text)).length,
    });
    return [...classes, ...CHIPS.map(([word, title]) => chip(word, counts[word], [title]))];
  }

  /** Adds a word to the filter, or removes it.
   *
   * @param {string} word
   */
  #toggle(word) {
    const { tracks } = this;
    const words = tracks.filterText.split(/\s+/).filter(Boolean);
    const rest = words.filter((other) => other !== word && !(word.startsWith("class:") && other.startsWith("class:")));
    tracks.setFilter((words.includes(word) ? rest : [...rest, word]).join(" "));
  }

  /** The preview, with its two answers. */
  #bar() {
    const { tracks } = this, { pending } = tracks.actions;
    byId("track-bar").hidden = !pending;
    this.cache.show("track-bar", pending?.text ?? "", () => (pending ? [
      el("span", { class: "fill", text: `${pending.text} Nothing is changed yet.` }),
      el("button", { class: "small", onclick: () => tracks.actions.apply() }, `${pending.apply} `, badge(tracks.keys, "Ctrl Enter")),
      el("button", { class: "small", onclick: () => tracks.actions.drop() }, "Drop ", badge(tracks.keys, "Esc")),
    ] : []));
  }

  #head() {
    const { row, state } = this.tracks;
    if (!row) return [el("h2", { text: "No element" }), el("span", { class: "about", text: "arrows, or a click" })];
    const kind = state.classOf(row.class_id);
    const [first, last] = this.tracks.table.span(row).map((place) => this.tracks.frameAt(place));
    return [
      classGlyph(kind, state.colorOf(kind)), el("h2", { text: row.name }), el("span", { class: "about", text: `frames ${first}–${last} · ${kind.name}` }),
      el("span", { class: "chip push", text: counted(row.views, row.number < 0 ? "detection" : "view") }),
    ];
  }

  /** @returns {Child[]} */
  #card() {
    const { row, details } = this.tracks;
    if (!row) return [];
    if (row.number < 0) return this.#openTrack(row);
    if (!details) return [el("p", { class: "dim track-text", text: "Reading …" })];
    return [
      details.split ? this.#cause(details.split) : null,
      el("h3", { text: "The whole track" }), ...this.#wholeTrack(row, details),
      ...this.#range(row, details),
      el("dl", { class: "track-facts" }, el("dt", { text: "Place" }), el("dd", { text: details.place, title: details.place }), el("dt", { text: "Drawn by" }), el("dd", { text: details.drawn_by, title: details.drawn_by }),
        ...Object.entries(row.attributes).flatMap(([name, value]) => [el("dt", { text: name }), el("dd", { text: value, title: value })])),
      ...row.notes.map((note) => this.#note(note)),
    ];
  }

  /** @param {Row} row */
  #openTrack(row) {
    const { actions, keys } = this.tracks;
    return [
      el("p", { class: "track-text", title: row.doubt ? LOOK_FIRST : "" }, "A track of detections. ",
        row.doubt ? el("span", { class: "warning", text: `Look first: ${row.doubt}.` }) : "It is sure."),
      action("Accept the track", counted(row.views, "label"), [badge(keys, "Space")], () => actions.acceptCell()),
      action("Reject the track", "no map has it", [badge(keys, "X")], () => actions.rejectCell()),
      action("Accept all sure ones", "that the filter leaves", [badge(keys, "Shift Space")], () => actions.acceptSure()),
      action("Reject all", "that the filter leaves", [badge(keys, "Shift X")], () => actions.rejectTracks()),
    ];
  }

  /** @param {annotator.TrackSplit} split */
  #cause(split) {
    const { tracks } = this;
    return el("button", { class: "track-cause", onclick: () => {
      const place = tracks.placeOf(split.frame);
      if (tracks.row && place !== undefined) tracks.choose(tracks.row, place);
      tracks.reveal();
    } }, el("b", {}, el("span", { class: "warning", text: "◆ " }), split.title), el("span", { text: split.text }));
  }

  /**
   * @param {Row} row
   * @param {annotator.TrackDetails} details
   */
  #wholeTrack(row, { labels, merge }) {
    const { actions, keys, views, frames } = this.tracks;
    const accepted = labels.filter((label) => label.accepted).length;
    const flagged = row.notes.some(({ unsure }) => unsure);
    return [
      action("Re-snap", `${accepted}, hand-drawn stay`, [badge(keys, "Shift R")], () => actions.resnap()),
      action("Verify, nearest first", `${views.seenCount} of ${labels.length}`, [badge(keys, "Shift B")], () => views.verify()),
      action("Split here", `before frame ${frames[0]}`, [badge(keys, "Shift U")], () => actions.split()),
      action("Merge with…", merge ? `nearest ${merge.name}, ${merge.away_m.toFixed(2)} m` : "none near", [badge(keys, "Shift P")], () => actions.merge()),
      action(flagged ? "Unsure ✓" : "Unsure", "asks a second person", [badge(keys, "Shift X")], () => actions.toggleUnsure()),
      action("Note…", `frame ${frames[0]}`, [badge(keys, "N")], () => this.startNote()),
    ];
  }

  /**
   * @param {Row} row
   * @param {annotator.TrackDetails} details
   * @returns {Child[]}
   */
  #range(row, details) {
    const { tracks } = this, { actions, keys, range, state } = tracks;
    const [first, last] = tracks.frames;
    const labels = actions.inRange(details);
    const frames = new Set(labels.map(({ frame }) => frame)).size;
    const found = actions.proposals?.proposals.filter(({ frame }) => frame >= first && frame <= last);
    const sure = found?.filter((mark) => mark.is_confident).length ?? 0;
    const signs = state.workspace.classes.filter(({ id, key }) => key && id !== row.class_id && state.classOf(id).kind === state.classOf(row.class_id).kind);
    const title = range ? `Range ${first}–${last}, ${counted(range[1] - range[0] + 1, "frame")}` : `Frame ${first}`;
    return [
      el("h3", {}, el("span", { text: title }), el("span", { class: "push", text: `${keys.shown("Shift ←")} ${keys.shown("Shift →")} widens` })),
      range ? action(actions.isSearching ? "Accept sure ones" : `Accept ${sure} sure`, actions.isSearching ? "searching …" : found ? `${found.length - sure} weak stay` : "nothing proposed", [badge(keys, "Shift Space")], () => actions.acceptSure()) : null,
      signs.length ? action("Change class", counted(range ? labels.length : details.labels.length, "label"), signs.map(({ key }) => badge(keys, `Shift ${key}`)), () => actions.setClass(signs[0].id)) : null,
      action(`Delete ${counted(labels.length, "label")}`, `in ${counted(frames, "frame")}`, [badge(keys, "Del")], () => actions.remove()),
    ];
  }

  /** @param {annotator.NoteView} note */
  #note({ id, frame, unsure, text, author, time }) {
    const about = [unsure ? "unsure" : "note", frame === null ? "" : `frame ${frame}`].filter(Boolean).join(", ");
    return el("div", { class: "track-note" },
      el("p", { class: "dim" }, el("b", { text: author }), ` ${about}`, el("span", { class: "push", title: time, text: new Date(time).toLocaleDateString() }),
        el("button", { class: "small", "aria-label": "Delete this note", title: "Answered: delete this note", onclick: () => this.tracks.actions.deleteNote(id) }, "✕")),
      text ? el("p", { text }) : null);
  }

  #hints() {
    const { keys, shown, place, matrix } = this.tracks;
    const hint = (/** @type {string[]} */ names, /** @type {string} */ text) => el("span", { class: "hint" }, ...names.map((name) => badge(keys, name)), ` ${text}`);
    byId("track-seen").textContent = `${Math.round(matrix.columns)} of ${spaced(this.tracks.places)} frames, ${Math.min(matrix.visibleRows, shown.length)} of ${spaced(shown.length)} rows`;
    return [
      hint(["←", "→", "↑", "↓"], "cell"), hint(["Shift ←", "Shift →"], "range"), hint(["Z"], "zoom to element"), hint(["0"], "whole drive"),
      hint(["Space"], "accept this one"), hint(["X"], "reject"), hint(["Enter"], `open frame ${place === null ? "" : this.tracks.frameAt(place)} in Images`),
    ];
  }

  /** Residual per frame: left up, right down.
   *
   * @param {CanvasRenderingContext2D} context
   * @param {number} width
   * @param {number} height
   */
  #drawPlot(context, width, height) {
    const { details, range, frames, place, state } = this.tracks;
    if (!details?.labels.length) return;
    const left = 22, middle = height / 2 - 5, most = Math.max(5, ...details.labels.map(({ px }) => px ?? 0));
    const first = details.labels[0].frame, last = details.labels[details.labels.length - 1].frame;
    const cell = (width - left) / (last - first + 1), scale = (middle - 6) / most;
    const x = (/** @type {number} */ frame) => left + (frame - first) * cell;
    if (range) {
      context.fillStyle = cssColor("--accent-ground");
      context.fillRect(x(frames[0]), 0, (frames[1] - frames[0] + 1) * cell, height - 10);
    }
    context.font = "11px Inter, \"Liberation Sans\", Arial, sans-serif";
    context.textBaseline = "middle";
    for (const px of PLOT_PX) for (const sign of [1, -1]) {
      context.fillStyle = cssColor("--hairline");
      context.fillRect(left, middle - sign * px * scale, width - left, 1);
      context.fillStyle = cssColor("--dim");
      context.fillText(`${px}`, 6, middle - sign * px * scale);
    }
    const colors = [0, 1, 2, 3, 4].map((level) => cssColor(`--residual-${level}`));
    for (const { frame, side, px } of details.labels) {
      context.fillStyle = px === null ? cssColor("--faint") : residualColor(px, colors);
      const tall = Math.max(1, (px ?? 0.4) * scale);
      context.fillRect(x(frame), side === "left" ? middle - tall : middle, Math.max(cell - 0.5, 0.6), tall);
    }
    context.fillStyle = cssColor("--dim");
    context.fillText(`${first}`, left, height - 5);
    context.textAlign = "right";
    context.fillText(`${last}`, width, height - 5);
    context.textAlign = "left";
    if (place !== null) {
      context.strokeStyle = state.theme === "light" ? "#000" : "#fff";
      context.setLineDash([2, 2]);
      context.strokeRect(x(frames[0]), 0.5, 0, height - 12);
      context.setLineDash([]);
    }
  }
}

/** A row of the card: what a key does, and to how much.
 *
 * @param {string} title
 * @param {string} about
 * @param {Child[]} badges
 * @param {() => void} run
 */
function action(title, about, badges, run) {
  return el("button", { class: "row track-action", onclick: run }, el("span", { text: title }), el("span", { class: "push dim", text: about, title: about }), ...badges);
}
