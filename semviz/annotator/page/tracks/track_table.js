// @ts-check
// What the server has sent of all tracks: rows, and what is expected in frames. No DOM here.
/** @import {annotator} from "/static/protocol" */
/** @import {Side} from "../values.js" */

/** @typedef {annotator.TrackRow} Row */
/** Codes of cells without a residual; see `TrackRow`. */
export const NOTHING = -1, PROPOSED = -2, REJECTED = -3, HIDDEN = -4, ABSENT = -5, UNPLACED = -6;
const BITS = { left: 1, right: 2 };

/** Whether a cell is a label.
 *
 * @param {number} code
 */
export const isLabel = (code) => code >= 0 || code === UNPLACED;

export class TrackTable {
  constructor() {
    /** @type {Map<string, Row>} by id */
    this.rows = new Map();
    /** @type {Map<number, Map<number, number>>} sides by place, by number of the element */
    this.expected = new Map();
    /** @type {Map<number, number[]>} numbers by place */
    this.numbersAt = new Map();
    /** @type {number | null} */
    this.total = null; // rows, once the server has told
    this.waiting = 0; // rows whose residuals are still being computed
    this.version = 0; // counts changes
  }

  /** Adds rows and frames to those known, or replaces them.
   *
   * @param {Pick<annotator.TracksEvent, "rows" | "frames" | "total" | "waiting">} event
   * @param {Map<number, number>} places of frames in the order of time, by index
   */
  merge({ rows, frames, total, waiting }, places) {
    this.version += 1;
    this.waiting = waiting;
    this.total = total ?? this.total;
    for (const row of rows) {
      if (row.views) this.rows.set(row.id, row);
      else this.rows.delete(row.id);
    }
    for (const frame of frames) {
      const place = places.get(frame.index);
      if (place !== undefined) this.#expect(place, frame);
    }
  }

  /**
   * @param {number} place
   * @param {annotator.TrackFrame} frame
   */
  #expect(place, frame) {
    for (const number of this.numbersAt.get(place) ?? []) this.expected.get(number)?.delete(place);
    for (const side of /** @type {Side[]} */ (["left", "right"])) {
      for (const number of frame[side]) {
        const of = this.expected.get(number) ?? new Map();
        of.set(place, (of.get(place) ?? 0) | BITS[side]);
        this.expected.set(number, of);
      }
    }
    this.numbersAt.set(place, [...new Set([...frame.left, ...frame.right])]);
  }

  /** The code of a cell.
   *
   * @param {Row} row
   * @param {number} place
   * @param {Side} side
   */
  cell(row, place, side) {
    const code = row[side][place - row.first] ?? NOTHING;
    if (code !== NOTHING) return code;
    return (this.expected.get(row.number)?.get(place) ?? 0) & BITS[side] ? PROPOSED : NOTHING;
  }

  /** Both cells of a frame.
   *
   * @param {Row} row
   * @param {number} place
   */
  cells(row, place) {
    return [this.cell(row, place, "left"), this.cell(row, place, "right")];
  }

  /** The places between the first and the last label at which the element is in view and not labelled.
   *
   * @param {Row} row
   * @returns {number[]}
   */
  gaps(row) {
    const of = this.expected.get(row.number);
    if (!of || !of.size) return [];
    const [first, last] = this.span(row);
    return [...of.keys()].filter((place) => place > first && place < last && !this.cells(row, place).some(isLabel) && this.cells(row, place).includes(PROPOSED)).sort((a, b) => a - b);
  }

  /** The places of the first and last label, or detection of a track.
   *
   * @param {Row} row
   * @returns {[number, number]}
   */
  span(row) {
    const isOwn = (/** @type {number} */ _, /** @type {number} */ at) => [row.left[at], row.right[at]].some((code) => isLabel(code) || code === PROPOSED);
    const first = row.left.findIndex(isOwn);
    return first < 0 ? [row.first, row.first] : [row.first + first, row.first + row.left.findLastIndex(isOwn)];
  }

  /** The number of frames in which a row has open proposals.
   *
   * @param {Row} row
   */
  proposed(row) {
    if (row.number < 0) return row.left.length ? row.views : 0;
    return [...this.expected.get(row.number)?.keys() ?? []].filter((place) => this.cells(row, place).includes(PROPOSED)).length;
  }

  /** The worst residual between two places, px; null without one.
   *
   * @param {Row} row
   * @param {number} first
   * @param {number} last
   */
  worst(row, first, last) {
    const codes = [...row.left.slice(...cut(row, first, last)), ...row.right.slice(...cut(row, first, last))];
    const worst = Math.max(-1, ...codes);
    return worst < 0 ? null : worst / 10;
  }

  /** Whether a row shows anything between two places.
   *
   * @param {Row} row
   * @param {number} first
   * @param {number} last
   */
  isIn(row, first, last) {
    const [from, to] = this.span(row);
    if (to >= first && from <= last) return true;
    return [...this.expected.get(row.number)?.keys() ?? []].some((place) => place >= first && place <= last);
  }
}

/** The part of a row's cells between two places, for `slice`.
 *
 * @param {Row} row
 * @param {number} first
 * @param {number} last
 * @returns {[number, number]}
 */
const cut = (row, first, last) => [Math.max(0, first - row.first), Math.max(0, last + 1 - row.first)];
