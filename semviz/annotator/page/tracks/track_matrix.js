// @ts-check
// The matrix of the view "Tracks" on one canvas: rows are elements, columns frames. Only what is seen is drawn.
/** @import {Tracks} from "./tracks.js" */
/** @import {Row} from "./track_table.js" */
import { Surface, cssColor, pointerAt } from "/static/canvas.js";
import { byId } from "/static/dom.js";
import { RESIDUAL_LIMITS_PX, traceGlyph } from "/static/glyphs.js";
import { ABSENT, HIDDEN, NOTHING, PROPOSED, REJECTED, UNPLACED, isLabel } from "./track_table.js";

export const NAMES = 176; // width of the names, which stay when scrolling
const TOP = 24, ROW = 21, CELL_TOP = 3; // CSS pixels
const HALVES_PX = 5, COLOUR_PX = 2; // narrower cells have no halves; still narrower ones only colour
const LEAST_COLUMNS = 12;

/** @typedef {CanvasRenderingContext2D} Context */

export class TrackMatrix {
  /** @param {Tracks} tracks */
  constructor(tracks) {
    this.tracks = tracks;
    this.first = 0; // leftmost place; fractional
    this.columns = 88; // places on screen
    this.top = 0; // uppermost row; fractional
    this.canvas = byId("track-matrix", HTMLCanvasElement);
    this.surface = new Surface(this.canvas, (context, width, height) => this.#draw(context, width, height));
    this.canvas.addEventListener("pointerdown", (event) => this.#pressed(event));
    this.canvas.addEventListener("pointermove", (event) => this.#moved(event));
    this.canvas.addEventListener("wheel", (event) => this.#wheel(event), { passive: false });
  }

  get #cell() {
    return (this.surface.width - NAMES - 8) / this.columns;
  }

  /** Rows on screen. */
  get visibleRows() {
    return Math.max(1, Math.floor((this.surface.height - TOP) / ROW));
  }

  /** Keeps the view inside the drive and the list.
   *
   * @param {number} first
   * @param {number} columns
   * @param {number} top
   */
  look(first, columns = this.columns, top = this.top) {
    const { places, shown } = this.tracks;
    this.columns = Math.min(Math.max(columns, Math.min(LEAST_COLUMNS, places)), Math.max(places, 1));
    this.first = Math.max(0, Math.min(first, places - this.columns));
    this.top = Math.max(0, Math.min(top, shown.length - this.visibleRows));
    this.surface.redraw();
  }

  /** Scrolls to a cell.
   *
   * @param {number} place
   * @param {number} row
   */
  reveal(place, row) {
    const margin = Math.min(4, this.columns / 4);
    const first = place < this.first + margin ? place - margin : place > this.first + this.columns - 1 - margin ? place + 1 + margin - this.columns : this.first;
    const rows = this.visibleRows;
    const top = row < 0 ? this.top : row < this.top ? row : row > this.top + rows - 1 ? row + 1 - rows : this.top;
    this.look(first, this.columns, top);
  }

  /** Where a cell is on the canvas, CSS pixels; for scripts that drive the page.
   *
   * @param {number} place
   * @param {number} row
   * @returns {[number, number]}
   */
  position(place, row) {
    return [NAMES + (place - this.first + 0.5) * this.#cell, TOP + (row - this.top + 0.5) * ROW];
  }

  /** @param {MouseEvent} event */
  #at(event) {
    const [x, y] = pointerAt(event);
    const row = Math.floor((y - TOP) / ROW + this.top);
    const place = x < NAMES ? null : Math.floor((x - NAMES) / this.#cell + this.first);
    return { row: this.tracks.shown[row] ?? null, place: place !== null && place < this.tracks.places ? place : null };
  }

  /** @param {PointerEvent} event */
  #pressed(event) {
    const { row, place } = this.#at(event);
    if (!row || event.button) return;
    this.tracks.choose(row, place, event.shiftKey);
    if (place !== null) this.canvas.setPointerCapture(event.pointerId);
  }

  /** @param {PointerEvent} event */
  #moved(event) {
    const { row, place } = this.#at(event);
    if (event.buttons & 1 && this.canvas.hasPointerCapture(event.pointerId) && place !== null) this.tracks.widen(place);
    this.canvas.title = row && place !== null ? this.tracks.tooltip(row, place) : "";
  }

  /** @param {WheelEvent} event */
  #wheel(event) {
    event.preventDefault();
    const [x] = pointerAt(event);
    const delta = event.deltaY * (event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 33 : 1);
    if (event.ctrlKey) this.zoom(Math.exp(delta * 0.0016), (x - NAMES) / this.#cell);
    else if (event.shiftKey || event.deltaX) this.look(this.first + (event.deltaX || delta) / this.#cell);
    else this.look(this.first, this.columns, this.top + delta / ROW);
  }

  /** Shows more or fewer frames; column `at` of the screen stays.
   *
   * @param {number} factor
   * @param {number} at
   */
  zoom(factor, at = this.columns / 2) {
    const columns = Math.min(Math.max(this.columns * factor, LEAST_COLUMNS), this.tracks.places);
    this.look(this.first + at - (at * columns) / this.columns, columns);
  }

  /**
   * @param {Context} context
   * @param {number} width
   * @param {number} height
   */
  #draw(context, width, height) {
    const { tracks } = this;
    if (!tracks.isShown) return;
    const look = theme();
    context.font = "11px Inter, \"Liberation Sans\", Arial, sans-serif";
    context.textBaseline = "middle";
    this.#columns(context, width, height, look);
    const end = Math.min(tracks.shown.length, Math.ceil(this.top + (height - TOP) / ROW));
    context.save();
    context.beginPath();
    context.rect(0, TOP, width, height - TOP);
    context.clip();
    for (let at = Math.floor(this.top); at < end; at += 1) this.#row(context, tracks.shown[at], TOP + (at - this.top) * ROW, width, look);
    context.restore();
  }

  /** Heads of the columns, and the range.
   *
   * @param {Context} context
   * @param {number} width
   * @param {number} height
   * @param {Look} look
   */
  #columns(context, width, height, look) {
    const { tracks } = this, cell = this.#cell;
    context.fillStyle = look.dim;
    context.textAlign = "left";
    context.fillText("element", 12, 12);
    context.textAlign = "right";
    context.fillText("views", 128, 12);
    context.fillText("worst", NAMES - 8, 12);
    context.textAlign = "center";
    const every = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000].find((step) => step * cell > 46) ?? 10000;
    for (let place = Math.ceil(this.first / every) * every; place < Math.min(tracks.places, this.first + this.columns); place += every) {
      const x = NAMES + (place - this.first + 0.5) * cell;
      context.fillStyle = look.dim;
      context.fillText(`${tracks.frameAt(place)}`, Math.min(x, width - 14), 12);
      context.fillStyle = look.hairline;
      context.fillRect(x, TOP, 1, height - TOP);
    }
    const { range } = tracks;
    if (range) {
      const from = Math.max(NAMES, NAMES + (range[0] - this.first) * cell), to = NAMES + (range[1] + 1 - this.first) * cell;
      if (to <= NAMES) return;
      context.fillStyle = look.ground;
      context.fillRect(from, TOP, to - from, height - TOP);
      context.fillStyle = look.accent;
      context.fillRect(from, TOP - 4, to - from, 2);
    }
  }

  /**
   * @param {Context} context
   * @param {Row} row
   * @param {number} y
   * @param {number} width
   * @param {Look} look
   */
  #row(context, row, y, width, look) {
    const { tracks } = this, cell = this.#cell;
    const isChosen = row.id === tracks.chosenId;
    if (isChosen) {
      context.fillStyle = look.chosen;
      context.fillRect(0, y, width, ROW);
    }
    const first = Math.max(0, Math.floor(this.first)), last = Math.min(tracks.places - 1, Math.ceil(this.first + this.columns));
    context.save();
    context.beginPath();
    context.rect(NAMES, y, width - NAMES, ROW);
    context.clip();
    const [from, to] = tracks.table.span(row);
    for (let place = first; place <= last; place += 1) {
      const [left, right] = tracks.table.cells(row, place);
      if (left === NOTHING && right === NOTHING) continue;
      const x = NAMES + (place - this.first) * cell;
      const isGap = place > from && place < to && row.number >= 0 && !isLabel(left) && !isLabel(right);
      if (isGap && (left === PROPOSED || right === PROPOSED)) this.#gap(context, x, y, cell, look);
      else this.#cells(context, [left, right], x, y, cell, look, isChosen && tracks.isPreviewed(place));
    }
    this.#marks(context, row, y, cell, look);
    context.restore();
    this.#name(context, row, y, look);
  }

  /**
   * @param {Context} context
   * @param {number[]} codes left, right
   * @param {number} x
   * @param {number} y
   * @param {number} cell
   * @param {Look} look
   * @param {boolean} isPreviewed
   */
  #cells(context, codes, x, y, cell, look, isPreviewed) {
    const gap = cell > HALVES_PX ? 1 : 0;
    const height = ROW - 2 * CELL_TOP;
    if (cell <= HALVES_PX) {
      const worst = Math.max(...codes.filter(isLabel), NOTHING);
      const code = worst > NOTHING ? worst : codes.find(isLabel) ?? codes.find((one) => one === PROPOSED) ?? codes[0];
      this.#half(context, code, x, y + CELL_TOP, Math.max(cell, 0.6), height, look);
    } else {
      codes.forEach((code, at) => this.#half(context, code, x + gap / 2, y + CELL_TOP + (at * height) / 2, cell - gap, height / 2 - 0.5, look));
    }
    if (isPreviewed) {
      context.strokeStyle = look.text;
      context.setLineDash([2, 2]);
      context.strokeRect(x + 0.5, y + 1.5, cell - 1, ROW - 3);
      context.setLineDash([]);
    }
  }

  /**
   * @param {Context} context
   * @param {number} code
   * @param {number} x
   * @param {number} y
   * @param {number} width
   * @param {number} height
   * @param {Look} look
   */
  #half(context, code, x, y, width, height, look) {
    if (isLabel(code)) {
      context.fillStyle = code === UNPLACED ? look.faint : look.residual[levelOf(code / 10)];
      context.fillRect(x, y, width, height);
    } else if (code === PROPOSED) {
      context.strokeStyle = context.fillStyle = look.dim;
      if (width <= COLOUR_PX) context.fillRect(x, y + height / 3, width, height / 3);
      else {
        context.setLineDash([2, 1.5]);
        context.strokeRect(x + 0.5, y + 0.5, width - 1, height - 1);
        context.setLineDash([]);
      }
    } else if (code === REJECTED || code === ABSENT) {
      const cx = x + width / 2, cy = y + height / 2, r = Math.min(2.6, width / 2);
      context.strokeStyle = look.dim;
      context.beginPath();
      context.moveTo(cx - r, cy - r);
      context.lineTo(cx + r, cy + r);
      context.moveTo(cx - r, cy + r);
      context.lineTo(cx + r, cy - r);
      context.stroke();
    } else if (code === HIDDEN) {
      context.fillStyle = look.dim;
      context.fillRect(x + width / 2 - 1, y + height / 2 - 1, 2, 2);
    }
  }

  /** In view, not labelled, between labels.
   *
   * @param {Context} context
   * @param {number} x
   * @param {number} y
   * @param {number} cell
   * @param {Look} look
   */
  #gap(context, x, y, cell, look) {
    context.fillStyle = look.warning;
    context.fillRect(x, y + ROW / 2 - 1, cell, 2);
  }

  /** The cell that keys act on, and diamonds of what is unsure.
   *
   * @param {Context} context
   * @param {Row} row
   * @param {number} y
   * @param {number} cell
   * @param {Look} look
   */
  #marks(context, row, y, cell, look) {
    const { tracks } = this;
    for (const { frame, unsure } of row.notes) {
      const place = unsure && frame !== null ? tracks.placeOf(frame) : undefined;
      if (place === undefined) continue;
      context.beginPath();
      const x = NAMES + (place - this.first + 0.5) * cell;
      for (const [dx, dy] of [[0, -5], [5, 0], [0, 5], [-5, 0]]) context.lineTo(x + dx, y + ROW / 2 + dy);
      context.closePath();
      context.fillStyle = look.panel;
      context.fill();
      context.strokeStyle = look.warning;
      context.stroke();
    }
    if (row.id !== tracks.chosenId || tracks.place === null) return;
    context.strokeStyle = look.text;
    context.lineWidth = 2;
    context.strokeRect(NAMES + (tracks.place - this.first) * cell, y + 1, Math.max(cell, 4), ROW - 2);
    context.lineWidth = 1;
  }

  /**
   * @param {Context} context
   * @param {Row} row
   * @param {number} y
   * @param {Look} look
   */
  #name(context, row, y, look) {
    const { state } = this.tracks, kind = state.classOf(row.class_id), middle = y + ROW / 2;
    context.strokeStyle = row.left_out ? look.faint : state.colorOf(kind);
    context.lineWidth = 1.5;
    traceGlyph(context, kind.shape, 16, middle, 4.5);
    context.stroke();
    context.lineWidth = 1;
    context.textAlign = "left";
    context.fillStyle = row.number < 0 || row.left_out ? look.dim : look.text;
    context.fillText(row.name, 30, middle);
    if (row.notes.length) this.#bubble(context, 88, middle, row.notes.some(({ unsure }) => unsure) ? look.warning : look.dim);
    context.textAlign = "right";
    context.fillStyle = look.dim;
    context.fillText(`${row.views}`, 128, middle);
    const worst = row.worst_px;
    if (worst !== null && worst > RESIDUAL_LIMITS_PX[1]) context.fillStyle = look.warning;
    context.fillText(worst === null ? "–" : worst.toFixed(1), NAMES - 8, middle);
    context.textAlign = "left";
  }

  /** The sign of a note: a speech bubble.
   *
   * @param {Context} context
   * @param {number} x
   * @param {number} y
   * @param {string} color
   */
  #bubble(context, x, y, color) {
    context.strokeStyle = color;
    context.beginPath();
    context.roundRect(x - 5, y - 5, 11, 8, 2);
    context.moveTo(x - 2, y + 3);
    context.lineTo(x - 3, y + 6);
    context.lineTo(x + 1, y + 3);
    context.stroke();
  }
}

/** The level of a residual on the absolute scale.
 *
 * @param {number} px
 */
export function levelOf(px) {
  const level = RESIDUAL_LIMITS_PX.findIndex((limit) => px <= limit);
  return level < 0 ? RESIDUAL_LIMITS_PX.length : level;
}

/** @typedef {ReturnType<typeof theme>} Look */
/** The colours of the present theme. */
export function theme() {
  return {
    text: cssColor("--text"), dim: cssColor("--dim"), faint: cssColor("--faint"), hairline: cssColor("--hairline"),
    panel: cssColor("--panel"), accent: cssColor("--accent"), ground: cssColor("--accent-ground"), chosen: cssColor("--accent-ground"),
    warning: cssColor("--ambiguous"), residual: [0, 1, 2, 3, 4].map((level) => cssColor(`--residual-${level}`)),
  };
}
