// @ts-check
// Types and small functions shared by the parts of the page.
/** @import {annotator} from "/static/protocol" */

/** @typedef {"left" | "right"} Side */
/** @typedef {[number, number]} Point */
/** @typedef {annotator.KeyedClass} ElementClass */
/** @typedef {annotator.ProposalView} Proposal */
/** @typedef {annotator.LabelsView & {frame: annotator.LabelledFrameView | null}} PageLabels */
/** @typedef {annotator.ReviewEntry & {entry: annotator.EntryView}} OpenReview */
/** `seen`: the observation that it changes, as the page showed it; not sent.
 * @typedef {annotator.ApplyEditRequest["edit"] & {seen?: SeenObservation}} Edit */
/** @typedef {{element: string, frame: number, side: Side, anchor: Point, end: Point | null, anchor_known: boolean, end_known: boolean}} SeenObservation */

/** A mark as shown; with frame and side if it is on disk.
 * @typedef {Omit<annotator.ObservationView, "frame" | "side"> & {frame?: number, side?: Side}} Observation */
/** @typedef {Partial<Record<Side, Observation>>} Observations */
/** An element as shown; `unsaved`: it is not on disk yet.
 * @typedef {Omit<annotator.ElementView, "observations" | "views" | "review_decisions" | "left_out" | "attributes" | "notes"> & {
 *   observations: Observations, views?: number, review_decisions?: annotator.ReviewDecisionView[], left_out?: boolean, attributes?: {[name: string]: string}, notes?: annotator.NoteView[], unsaved?: boolean}} ShownElement */

/** Where on the page an edit was made.
 * @typedef {{frame: number | null, side: Side, second?: number | null, class: number}} ShownAt */
/** An observation with its element.
 * @typedef {{element: ShownElement, side: Side, observation: Observation}} LocatedObservation */

/** An edit that is not on disk yet; `base`: what the page had shown when it was begun.
 * @typedef {{request: string, place: number, edit: Edit, shown: ShownAt | null, base?: annotator.EditBase}} Entry */

/** An unfinished drawing; `box`: two corners of a sign's box; `on_top`: it may lie on an element.
 * @typedef {{side: Side, class: number, anchor: Point, end: Point | null, box?: [Point, Point],
 *   anchor_known: boolean, end_known: boolean, asks_bottom: boolean, on_top?: boolean}} Drawing */
/** The whole pole that a click would take; `joins`: the element that it would be of.
 * @typedef {{side: Side, frame: number, class: number, anchor: Point, end: Point,
 *   anchor_known: boolean, end_known: boolean, joins: string | null}} Ghost */
/** The observation being dragged; an end that the drag does not move is null.
 * @typedef {{observation: string, anchor: Point | null, end: Point | null}} Dragged */
/** The ends by which a mark of a track was replaced before it is accepted; `track`: the track's id.
 * @typedef {{track: string, anchor: Point, end: Point | null}} Correction */
/** The selection; `also`: more elements or proposals, for commands on several.
 * @typedef {{element: string, side: Side, also?: string[]}} Selected */
/** A rectangle that selects what it touches, in pixels of an image.
 * @typedef {{side: Side, from: Point, to: Point}} Rectangle */
/** @typedef {{snap: boolean, whole: boolean, loupe: boolean, guides: boolean, proposals: boolean, bright: boolean, map: boolean, backdrop: boolean}} Aids */
/** @typedef {{brightness: number, contrast: number}} Brightness */
/** A refused edit, and what the user may answer; the edit waits until then. `conflict`: who changed the same, and when. `notMade`: the edit is dropped.
 * @typedef {{entry: Entry, text: string, answers: {title: string, run: () => void}[], conflict?: {operation: number, author: string, time: string}, notMade?: boolean}} Question */

/** That nobody selected an element in this frame. */
export const NONE_CHOSEN = { element: "", frame: -1 };

/** @type {Side[]} */
export const SIDES = ["left", "right"];
/**
 * @param {Side} side
 * @returns {Side}
 */
export const other = (side) => (side === "left" ? "right" : "left");

/** A UUID of version 7 (RFC 9562, 5.7), which sorts by its time of creation (ms). */
export function uuid7() {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  new DataView(bytes.buffer).setUint16(0, Math.floor(Date.now() / 2 ** 32));
  new DataView(bytes.buffer).setUint32(2, Date.now() % 2 ** 32);
  bytes[6] = 0x70 | (bytes[6] & 0x0f);
  bytes[8] = 0x80 | (bytes[8] & 0x3f);
  const hex = [...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join("");
  return hex.replace(/(.{8})(.{4})(.{4})(.{4})(.{12})/, "$1-$2-$3-$4-$5");
}

/** A number with spaces between thousands: "4 213".
 *
 * @param {number} number
 */
export const spaced = (number) => String(number).replace(/\B(?=(\d{3})+(?!\d))/g, " ");

/** A range of frames as people type it ("0-309"); null if the text is none.
 *
 * @param {string} text
 * @returns {[number, number] | null}
 */
export function rangeOf(text) {
  const range = text.trim().match(/^(\d+)\s*[-–:]\s*(\d+)$/);
  return range && [Number(range[1]), Number(range[2])];
}

/** A number with its noun: "1 frame", "9 frames".
 *
 * @param {number} number
 * @param {string} noun
 */
export const counted = (number, noun) => `${number} ${noun}${number === 1 ? "" : "s"}`;

/** A score with two decimals, rounded down: 0.898 is below the confident 0.90.
 *
 * @param {number} score
 */
export const shownScore = (score) => (Math.floor(100 * score) / 100).toFixed(2);

/** What makes a track of detections sure, as a tooltip of why one is not. */
export const LOOK_FIRST = "Look at it before you accept it. A sure track is detected in 3 frames or more, exists with more than 99.9 %, and lies within 2 px (rms) of its detections.";
