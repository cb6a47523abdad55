// @ts-check
// What can be done with a track, or with a range of it. Each action is one edit; those that change many
// labels are previewed first.
/** @import {annotator} from "/static/protocol" */
/** @import {Edit} from "../values.js" */
/** @import {Tracks} from "./tracks.js" */
/** @import {Row} from "./track_table.js" */
import { lastOfBoth } from "../state.js";
import { counted, uuid7 } from "../values.js";

const LEAST_SCORE = 0.05; // of a proposal that was found in the image
const REST_MS = 250;

/** An edit that waits for `Ctrl Enter`; `frames`: those it changes; `moved`: new places of labels, by their id.
 * @typedef {{text: string, apply: string, edit: Edit, frames: Set<number>, moved?: Map<string, annotator.SnapMove>}} Pending */

export class TrackActions {
  /** @param {Tracks} tracks */
  constructor(tracks) {
    this.tracks = tracks;
    /** @type {Pending | null} */
    this.pending = null;
    /** @type {annotator.TrackProposalsEvent | null} */
    this.proposals = null; // of the chosen element, in the frames searched last
    /** @type {((found: annotator.TrackProposal[]) => void) | null} */
    this.then = null; // what waits for them
    this.isSearching = false;
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.timer = undefined;
  }

  // -- preview

  /** @param {Pending} pending */
  #preview(pending) {
    this.pending = pending;
    this.tracks.state.set({});
  }

  /** Drops the preview. Returns whether there was one. */
  drop() {
    const had = this.pending !== null;
    this.pending = this.then = null;
    if (had) this.tracks.state.set({});
    return had;
  }

  /** Makes the previewed edit. */
  apply() {
    const { pending } = this;
    if (!pending) return;
    this.drop();
    this.#submit(pending.edit);
  }

  /** Makes an edit of what the card shows: what others changed since is not overwritten.
   *
   * @param {Edit} edit
   */
  #submit(edit) {
    const { details, page, state } = this.tracks;
    page.submit(edit, lastOfBoth(state.lastShown, details));
  }

  /** The labels of the chosen element changed: what is previewed may no longer hold. */
  changed() {
    if (this.pending) {
      this.pending = null;
      this.tracks.page.notify("The track was changed a moment ago: the preview was dropped. Look again.", "wrong");
    }
    this.proposals = null;
  }

  // -- the labels concerned

  /** The chosen element, if it is one of labels; if not, a message says what to do. */
  #element() {
    const { row, page } = this.tracks;
    if (!row) page.notify("Choose an element first: arrows, or a click.", "wrong");
    else if (row.number < 0) page.notify("This is a track of detections: Space accepts it, X rejects it.", "wrong");
    else return row;
    return null;
  }

  /** The chosen element with its labels as they are now. Null while they are read: then `again` is called.
   *
   * @param {() => void} again
   */
  #labelled(again) {
    const row = this.#element(), { tracks } = this;
    if (!row) return null;
    if (tracks.details && tracks.isRead) return { row, details: tracks.details };
    tracks.onceRead = again;
    return null;
  }

  /** The labels of the chosen element in the range or the chosen cell.
   *
   * @param {annotator.TrackDetails} details
   */
  inRange(details) {
    const [first, last] = this.tracks.frames;
    return details.labels.filter(({ frame }) => frame >= first && frame <= last);
  }

  // -- the whole track

  resnap() {
    const found = this.#labelled(() => this.resnap());
    if (!found) return;
    const isSent = this.tracks.page.ask("preview_resnap", { element_id: found.row.id });
    if (isSent) this.tracks.page.notify(`Looking for the edges of ${counted(found.details.labels.length, "view")} …`);
  }

  /** @param {annotator.ReSnapEvent} event */
  snapped({ element, preview }) {
    const { tracks } = this, { details, page } = tracks;
    if (element !== tracks.chosenId || !details) return;
    const { moves, by_px: by, unclear, drawn } = preview;
    const stay = [unclear ? `${unclear} found no edge` : "", drawn ? `${drawn} drawn by hand` : ""].filter(Boolean).join(", ");
    if (!moves.length) {
      page.notify(`No label moves${stay ? `: ${stay}, the others are on their edges` : ": all are on their edges"}.`);
      return;
    }
    const moved = new Map(moves.map((move) => [move.observation_id, move]));
    this.#preview({
      text: `Re-snap ${counted(moves.length, "view")} by ${by.toFixed(1)} px (median).${stay ? ` ${stay}: stay.` : ""}`,
      apply: "Re-snap",
      edit: { kind: "re-snap", moves: moves.map((move) => ({ kind: "move", ...move })) },
      frames: new Set(details.labels.filter(({ id }) => moved.has(id)).map(({ frame }) => frame)),
      moved,
    });
  }

  /** Lets the labels from the chosen frame on be another element. */
  split() {
    const found = this.#labelled(() => this.split());
    if (!found) return;
    const [frame] = this.tracks.frames;
    const [before, after] = [found.details.labels.filter((label) => label.frame < frame), found.details.labels.filter((label) => label.frame >= frame)];
    if (!before.length || !after.length) {
      this.tracks.page.notify(`Nothing to split: all labels of ${found.row.name} are ${before.length ? "before" : "from"} frame ${frame}${before.length ? "" : " on"}.`, "wrong");
      return;
    }
    this.#preview({
      text: `Split ${found.row.name} before frame ${frame}: ${counted(after.length, "label")} become another element.`,
      apply: "Split",
      edit: { kind: "unlink", observation_ids: after.map(({ id }) => id), new_element_id: uuid7() },
      frames: new Set(after.map((label) => label.frame)),
    });
  }

  merge() {
    const found = this.#labelled(() => this.merge());
    if (!found) return;
    const { merge } = found.details;
    if (!merge) {
      this.tracks.page.notify(`Nothing to merge: no ${this.tracks.state.classOf(found.row.class_id).name} within 3 m is missing from all images of ${found.row.name}.`, "wrong");
      return;
    }
    this.#preview({
      text: `Merge ${found.row.name} with ${merge.name}, ${merge.away_m.toFixed(2)} m away: one element.`,
      apply: "Merge",
      edit: { kind: "link", element_ids: [found.row.id, merge.id] },
      frames: new Set(found.details.labels.map(({ frame }) => frame)),
    });
  }

  /** Flags the chosen element; of tracks of detections, rejects all that the filter leaves. */
  toggleUnsure() {
    if ((this.tracks.row?.number ?? 0) < 0) return this.rejectTracks();
    const row = this.#element();
    if (!row) return;
    const flags = row.notes.filter(({ unsure, text }) => unsure && !text);
    if (flags.length) this.#submit({ kind: "delete note", note_id: flags[0].id });
    else this.note("", true);
  }

  /** Writes a note on the chosen element, at the chosen frame.
   *
   * @param {string} text
   * @param {boolean} unsure
   */
  note(text, unsure = false) {
    const { chosenId, frames } = this.tracks;
    this.#submit({ kind: "note", note_id: uuid7(), element_id: chosenId, frame_index: frames[0], unsure, text });
  }

  /** @param {string} id */
  deleteNote(id) {
    this.#submit({ kind: "delete note", note_id: id });
  }

  // -- a range

  /** @param {number} id */
  setClass(id) {
    const found = this.#labelled(() => this.setClass(id));
    if (!found || found.row.class_id === id) return;
    const { state, range, page } = this.tracks;
    const [now, next] = [state.classOf(found.row.class_id), state.classOf(id)];
    if (now.kind !== next.kind) {
      page.notify(`A ${now.name} cannot become a ${next.name}: delete it and draw it anew.`, "wrong");
      return;
    }
    const labels = range ? this.inRange(found.details) : found.details.labels;
    if (!labels.length) {
      page.notify("There are no labels in this range.", "wrong");
      return;
    }
    const isWhole = labels.length === found.details.labels.length;
    this.#preview({
      text: `${counted(labels.length, "label")} of ${found.row.name} become ${next.name}${isWhole ? "." : ", and an element of their own."}`,
      apply: "Change class",
      edit: { kind: "set class of views", observation_ids: labels.map((label) => label.id), class_id: id, new_element_id: uuid7() },
      frames: new Set(labels.map(({ frame }) => frame)),
    });
  }

  remove() {
    const found = this.#labelled(() => this.remove());
    if (!found) return;
    const labels = this.inRange(found.details);
    const frames = new Set(labels.map(({ frame }) => frame));
    if (!labels.length) {
      this.tracks.page.notify("There are no labels here.", "wrong");
      return;
    }
    this.#preview({
      text: `Delete ${counted(labels.length, "label")} in ${counted(frames.size, "frame")} of ${found.row.name}.`,
      apply: "Delete",
      edit: { kind: "delete many", observation_ids: labels.map(({ id }) => id) },
      frames,
    });
  }

  acceptSure() {
    const { row, range, page } = this.tracks;
    if (!row) page.notify("Choose an element first: arrows, or a click.", "wrong");
    else if (row.number < 0) this.#acceptSureTracks();
    else if (!range) page.notify("Choose a range first: Shift and arrows.", "wrong");
    else this.#withProposals((found) => this.#acceptFound(row, found.filter((mark) => mark.is_confident), found));
  }

  /** Accepts the sure ones of the tracks of detections that the filter leaves, in the range. */
  #acceptSureTracks() {
    const { page } = this.tracks;
    const open = this.#openTracks();
    const sure = open.filter((row) => !row.doubt);
    if (!sure.length) {
      page.notify(`None of ${counted(open.length, "open track")} here is sure; accept them one by one.`, "wrong");
      return;
    }
    this.#preview({
      text: `Accept ${counted(sure.length, "sure track")}${open.length > sure.length ? `, ${open.length - sure.length} to look at first stay` : ""}.`,
      apply: "Accept",
      edit: { kind: "accept tracks", track_ids: sure.map(({ id }) => id), corrections: [] },
      frames: new Set(),
    });
  }

  /** The tracks of detections that the filter leaves, in the range. */
  #openTracks() {
    const { table, shown, range, places } = this.tracks;
    const [first, last] = range ?? [0, places - 1];
    return shown.filter((row) => row.number < 0 && table.isIn(row, first, last));
  }

  /** Rejects all tracks of detections that the filter leaves, in the range. */
  rejectTracks() {
    const { filterText, range, page } = this.tracks;
    const open = this.#openTracks();
    if (!filterText && !range) {
      page.notify(`This would reject all ${counted(open.length, "open track")}: filter first (/), or choose a range.`, "wrong");
      return;
    }
    this.#preview({
      text: `Reject ${counted(open.length, "track")}: no map will have ${open.length === 1 ? "it" : "them"}.`,
      apply: "Reject",
      edit: { kind: "reject tracks", track_ids: open.map(({ id }) => id) },
      frames: new Set(),
    });
  }

  /**
   * @param {Row} row
   * @param {annotator.TrackProposal[]} sure
   * @param {annotator.TrackProposal[]} found
   */
  #acceptFound(row, sure, found) {
    if (!sure.length) {
      this.tracks.page.notify(found.length ? `None of ${counted(found.length, "proposal")} here is sure; Space accepts one.` : "Nothing is proposed in this range.", "wrong");
      return;
    }
    const weak = found.length - sure.length;
    this.#preview({
      text: `Accept ${sure.length} sure ${sure.length === 1 ? "one" : "ones"}${weak ? `, ${weak} weak ${weak === 1 ? "stays" : "stay"}` : ""}.`,
      apply: "Accept",
      edit: { kind: "accept", marks: sure.map((mark) => accepted(row.id, mark)) },
      frames: new Set(sure.map(({ frame }) => frame)),
    });
  }

  // -- one cell

  acceptCell() {
    const { row, page } = this.tracks;
    if (!row) return;
    if (row.number < 0) {
      this.#submit({ kind: "accept tracks", track_ids: [row.id], corrections: [] });
      return;
    }
    this.#withProposals((found) => {
      const marks = found.filter(({ score }) => score >= LEAST_SCORE);
      if (marks.length) this.#submit({ kind: "accept", marks: marks.map((mark) => accepted(row.id, mark)) });
      else page.notify("Nothing is found here: open the frame (Enter) and draw it.", "wrong");
    }, true);
  }

  rejectCell() {
    const { row, page } = this.tracks;
    if (!row) return;
    if (row.number < 0) {
      this.#submit({ kind: "reject tracks", track_ids: [row.id] });
      return;
    }
    this.#withProposals((found) => {
      const dismissals = found.map(({ id, frame, side }) =>
        ({ id, frame_index: frame, side, why: /** @type {const} */ ("rejected"), element_id: row.id }));
      if (dismissals.length) this.#submit({ kind: "dismiss", dismissals });
      else page.notify("Nothing is proposed here.", "wrong");
    }, true);
  }

  // -- what the images show

  /** Runs `then` with the proposals of the chosen element in the range, or in the chosen cell only; the images
   * are searched first.
   *
   * @param {(found: annotator.TrackProposal[]) => void} then
   */
  #withProposals(then, onlyCell = false) {
    const { tracks } = this;
    const cell = tracks.frameAt(tracks.place ?? 0);
    const [first, last] = onlyCell ? [cell, cell] : tracks.frames;
    const { proposals: known } = this;
    if (known && known.element === tracks.chosenId && known.first <= first && known.last >= last) {
      then(known.proposals.filter(({ frame }) => frame >= first && frame <= last));
      return;
    }
    this.then = then;
    this.#search(first, last);
  }

  /**
   * @param {number} first
   * @param {number} last
   */
  #search(first, last) {
    clearTimeout(this.timer);
    this.isSearching = this.tracks.page.ask("search_track", { element_id: this.tracks.chosenId, first, last });
    this.tracks.state.set({});
  }

  /** @param {annotator.TrackProposalsEvent} event */
  found(event) {
    if (event.element !== this.tracks.chosenId) return;
    this.isSearching = false;
    this.proposals = event;
    const { then } = this;
    this.then = null;
    then?.(event.proposals);
    this.tracks.state.set({});
  }

  /** Searches a new range once the keys rest, so that the card can tell how many are sure. */
  rangeChanged() {
    this.pending = this.then = null;
    clearTimeout(this.timer);
    const { row, range, table } = this.tracks;
    if (!row || row.number < 0 || !range) return;
    const [first, last] = range;
    const expects = [...table.expected.get(row.number)?.keys() ?? []].some((place) => place >= first && place <= last);
    if (expects) this.timer = setTimeout(() => this.#search(...this.tracks.frames), REST_MS);
  }
}

/** A mark of the server, as a label.
 *
 * @param {string} element
 * @param {annotator.TrackProposal} mark
 * @returns {annotator.DrawnMark}
 */
function accepted(element, { id, frame, side, anchor, end, anchor_known, end_known }) {
  return { observation_id: id, element_id: element, frame_index: frame, side, anchor_px: anchor, end_px: end, anchor_known, end_known };
}
