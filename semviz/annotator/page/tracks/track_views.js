// @ts-check
// The views of the chosen element below the matrix, nearest first, and which of them somebody has looked at.
/** @import {annotator} from "/static/protocol" */
/** @import {Tracks} from "./tracks.js" */
import { byId, el, fill } from "/static/dom.js";
import { drawHandle, drawLine, residualColor } from "/static/glyphs.js";

const WIDTH = 96, HEIGHT = 66; // of a crop, CSS pixels
const REST_MS = 400; // images are loaded once the keys rest
const AROUND = 1.5; // a crop shows so many times the element
const LEAST_PX = 40;

export class TrackViews {
  /** @param {Tracks} tracks */
  constructor(tracks) {
    this.tracks = tracks;
    this.shown = ""; // what the strip shows
    this.verifying = ""; // the element whose views are being verified
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.timer = undefined;
    /** @type {annotator.OpenTrackEvent | null} */
    this.opened = null; // the detections of the open track that was chosen last
    this.asked = "";
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.askTimer = undefined;
    tracks.page.socket.on("open_track", (event) => {
      this.opened = event;
      tracks.state.set({});
    });
  }

  /** Views that this browser has verified, as `id@place`: one that was moved since wants another look. */
  get #seen() {
    return new Set(/** @type {string[]} */ (JSON.parse(localStorage.getItem(this.#key) ?? "[]")));
  }

  get #key() {
    return `semviz.verified.${this.tracks.state.workspace.key}`;
  }

  /** The detections of the chosen row, if it is an open track. */
  get #detections() {
    const { row } = this.tracks;
    return row && row.number < 0 && this.opened?.track_id === row.id ? this.opened.views : [];
  }

  /** The labels or detections of the chosen row, the one in which it is largest first. */
  get #nearestFirst() {
    return [...this.tracks.details?.labels ?? this.#detections].sort((a, b) => b.size_px - a.size_px || a.frame - b.frame);
  }

  /** How many views of the chosen element are verified. */
  get seenCount() {
    const seen = this.#seen;
    return this.tracks.details?.labels.filter((label) => seen.has(signature(label))).length ?? 0;
  }

  /** Marks the chosen view as verified, and goes to the nearest that is not. */
  verify() {
    const { tracks } = this;
    if (!tracks.details) {
      tracks.page.notify("Choose a labelled element first.", "wrong");
      return;
    }
    const seen = this.#seen;
    const labels = this.#nearestFirst;
    const isStarted = this.verifying === tracks.chosenId;
    const [frame] = tracks.frames;
    if (isStarted) for (const label of labels) if (label.frame === frame) seen.add(signature(label));
    localStorage.setItem(this.#key, JSON.stringify([...seen].slice(-20000)));
    this.verifying = tracks.chosenId;
    const next = labels.find((label) => !seen.has(signature(label)));
    if (!next) tracks.page.notify(`All ${labels.length} views of ${tracks.row?.name} are verified.`);
    const place = tracks.placeOf((next ?? labels[0]).frame);
    if (tracks.row && place !== undefined) tracks.choose(tracks.row, place);
    tracks.reveal();
  }

  /** Redraws; called whenever the state of the page changes. */
  show() {
    const { tracks } = this, { details, row } = tracks;
    this.#askDetections();
    const [frame] = tracks.frames;
    const moved = tracks.actions.pending?.moved;
    const key = JSON.stringify([details?.id, details?.operation, details?.labels, this.#detections, frame, this.seenCount, moved ? [...moved] : null]);
    if (key === this.shown) return;
    this.shown = key;
    clearTimeout(this.timer);
    const labels = this.#nearestFirst;
    const seen = this.#seen;
    const said = details ? `nearest first; ${this.seenCount} of ${labels.length} verified` : "nearest first";
    fill(byId("track-views-about"), row && labels.length ? [
      el("b", { text: `Views of ${row.name}` }), el("span", { class: "dim", text: said }),
    ] : [el("b", { text: "Views" }), el("span", { class: "dim", text: "of the chosen element" })]);
    const strip = byId("track-views-strip");
    const fits = Math.max(1, Math.floor(strip.clientWidth / (WIDTH + 8)));
    const at = labels.findIndex((label) => label.frame === frame);
    const first = Math.max(0, Math.min(at < 0 ? 0 : at - 2, labels.length - fits));
    const tiles = labels.slice(first, first + fits).map((label) => this.#tile(label, seen.has(signature(label)), label.frame === frame));
    strip.replaceChildren(...tiles.map(({ node }) => node));
    this.timer = setTimeout(() => tiles.forEach(({ load }) => load()), REST_MS);
  }

  /** Requests the detections of the chosen row, if it is another open track than before. */
  #askDetections() {
    const { row, page } = this.tracks;
    const wanted = row && row.number < 0 ? row.id : "";
    if (wanted === this.asked) return;
    this.asked = wanted;
    clearTimeout(this.askTimer);
    if (wanted) this.askTimer = setTimeout(() => page.socket.send("show_open_track", { track_id: wanted }), REST_MS / 2);
  }

  /**
   * @param {annotator.TrackImage} label
   * @param {boolean} isSeen
   * @param {boolean} isHere
   */
  #tile(label, isSeen, isHere) {
    const { tracks } = this;
    const ratio = window.devicePixelRatio || 1;
    const canvas = el("canvas", { width: WIDTH * ratio, height: HEIGHT * ratio });
    const px = label.px === null ? "no position" : `${label.px.toFixed(1)} px`;
    const node = el("button", { class: "view", "aria-current": String(isHere), title: `${label.side} image of frame ${label.frame}`, onclick: () => {
      const place = tracks.placeOf(label.frame);
      if (tracks.row && place !== undefined) tracks.choose(tracks.row, place);
      tracks.reveal();
    } }, canvas, el("span", {}, el("b", { text: `${label.frame} ${label.side === "left" ? "L" : "R"}` }), el("span", { class: "dim", text: ` ${px}` }), isSeen ? el("span", { class: "push verified", text: "✓" }) : null));
    const load = async () => {
      const { bitmap } = await tracks.page.pictures.get(label.frame, label.side);
      if (bitmap && node.isConnected) this.#draw(canvas, bitmap, label, ratio);
    };
    return { node, load };
  }

  /**
   * @param {HTMLCanvasElement} canvas
   * @param {ImageBitmap} bitmap
   * @param {annotator.TrackImage} label
   * @param {number} ratio
   */
  #draw(canvas, bitmap, label, ratio) {
    const context = canvas.getContext("2d");
    if (!context) return;
    const ends = label.end ? [label.anchor, label.end] : [label.anchor];
    const [u, v] = [0, 1].map((axis) => ends.reduce((sum, end) => sum + end[axis], 0) / ends.length);
    const tall = Math.max(LEAST_PX, AROUND * (label.end ? Math.hypot(label.end[0] - label.anchor[0], label.end[1] - label.anchor[1]) : label.size_px));
    const scale = HEIGHT / tall;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.drawImage(bitmap, u + 0.5 - WIDTH / scale / 2, v + 0.5 - tall / 2, WIDTH / scale, tall, 0, 0, WIDTH, HEIGHT);
    const screen = (/** @type {[number, number]} */ [x, y]) => /** @type {[number, number]} */ ([(x - u) * scale + WIDTH / 2, (y - v) * scale + HEIGHT / 2]);
    const color = label.px === null ? "#FFFFFF" : residualColor(label.px);
    mark(context, label.anchor, label.end, screen, color, []);
    const move = this.tracks.actions.pending?.moved?.get(label.id);
    if (move) mark(context, move.anchor_px, move.end_px ?? null, screen, "#FFFFFF", [3, 2]);
  }
}

/**
 * @param {CanvasRenderingContext2D} context
 * @param {[number, number]} anchor
 * @param {[number, number] | null} end
 * @param {(pixel: [number, number]) => [number, number]} screen
 * @param {string} color
 * @param {number[]} dash
 */
function mark(context, anchor, end, screen, color, dash) {
  if (!end) {
    const [x, y] = screen(anchor);
    drawHandle(context, "bottom", x, y, color);
    return;
  }
  context.save();
  context.setLineDash(dash);
  drawLine(context, screen(anchor), screen(end), color, dash.length ? 1 : 1.5);
  context.restore();
}

/** A label as it was looked at.
 *
 * @param {annotator.TrackImage} label
 */
const signature = ({ id, anchor, end }) => `${id}@${[...anchor, ...end ?? []].map((value) => value.toFixed(2)).join()}`;
