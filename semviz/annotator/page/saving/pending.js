// @ts-check
// Shows unsaved edits as if they were applied. All functions are pure.
/** @import {annotator} from "/static/protocol" */
/** @import {State} from "../state.js" */
/** @import {Edit, Entry, LocatedObservation, Observation, Observations, Proposal, SeenObservation, ShownAt, ShownElement, Side} from "../values.js" */
import { SIDES, uuid7 } from "../values.js";

/** The observation that `edit` changes, as shown; null if there is none, or if it is not on disk yet,
 * so that nobody else can have changed it.
 *
 * @param {ShownElement[]} elements
 * @param {Edit} edit
 */
export function startOf(elements, edit) {
  const start = "observation_id" in edit ? find(elements, edit.observation_id) : null;
  return start?.observation.frame === undefined ? null : start;
}

/** The observation as it is shown, to draw it again if others delete it.
 *
 * @param {LocatedObservation} start
 * @returns {SeenObservation | undefined}
 */
export function seen({ element, observation }) {
  const { anchor, end, anchor_known, end_known, frame, side } = observation;
  if (frame === undefined || side === undefined) return undefined;
  return { element: element.id, frame, side, anchor, end, anchor_known, end_known };
}

/** The drawing that recreates an edited observation which others deleted; null if the edit deletes it.
 *
 * @param {Edit} edit
 * @param {ShownAt} shown
 * @returns {Edit | null}
 */
export function drawnAgain(edit, { frame, side, second = null, class: id }) {
  if (!edit.seen || frame === null) return null;
  const { element, anchor, end, anchor_known, end_known } = edit.seen;
  /** @type {Observations} */
  const observations = { [side]: { id: "", anchor, end, anchor_known, end_known } };
  change(observations, side, edit);
  const mark = observations[side];
  return mark ? {
    kind: "draw",
    observation_id: uuid7(),
    element_id: uuid7(),
    frame_index: frame,
    side,
    second,
    class_id: id,
    anchor_px: mark.anchor,
    end_px: mark.end,
    anchor_known: mark.anchor_known,
    end_known: mark.end_known,
    selected_id: element,
    snap: false,
  } : null;
}

/** Whether `edit` changes nothing, for example a drag that ends where it began.
 *
 * @param {ShownElement[]} elements
 * @param {Edit} edit
 */
export function isIdle(elements, edit) {
  if (!("observation_id" in edit) || !find(elements, edit.observation_id)) return false;
  return JSON.stringify(withPending(elements, [{ edit }], null)) === JSON.stringify(elements);
}

/** The pending edits that those among them which undo and redo leave.
 *
 * @template {{edit: Edit, request?: string}} Pending
 * @param {Pending[]} pending
 */
export function standing(pending) {
  /** @type {Pending[]} */
  let done = [];
  /** @type {Pending[]} */
  let undone = [];
  for (const entry of pending) {
    const { edit } = entry;
    if (edit.kind === "undo") {
      const taken = edit.request ? done.find(({ request }) => request === edit.request) : done.at(-1);
      done = done.filter((one) => one !== taken);
      if (taken) undone.push(taken);
    } else if (edit.kind === "redo") {
      const again = undone.pop();
      if (again) done.push(again);
    } else {
      done.push(entry);
      undone = [];
    }
  }
  return done;
}

/** Returns `elements` with the `pending` edits of `frame` applied. `proposals` name accepted elements;
 * `second` is the frame of the second image, or null for the frame's own right one.
 *
 * @param {ShownElement[]} elements
 * @param {{edit: Edit}[]} pending
 * @param {number | null} frame
 * @param {Proposal[]} proposals
 * @param {number | null} second
 */
export function withPending(elements, pending, frame, proposals = [], second = null) {
  const result = structuredClone(elements);
  for (const { edit } of standing(pending)) {
    const marks = edit.kind === "draw" ? [edit]
      : edit.kind === "accept" ? edit.marks
        : edit.kind === "accept tracks" ? markedByTracks(edit, frame, proposals, second) : null;
    if (marks) {
      for (const mark of marks) if (isShown(mark, frame, second)) add(result, mark, proposals);
      continue;
    }
    const ids = "observation_id" in edit ? [edit.observation_id] : "observation_ids" in edit ? edit.observation_ids : [];
    for (const target of ids.map((id) => find(result, id))) {
      if (target) change(target.element.observations, target.side, edit);
    }
  }
  return result.filter(({ observations }) => SIDES.some((side) => observations[side]));
}

/** Whether a mark was drawn in one of the images on the page.
 *
 * @param {annotator.DrawnMark} mark
 * @param {number | null} frame
 * @param {number | null} second
 */
function isShown(mark, frame, second) {
  return mark.frame_index === frame && (mark.side === "left" || (mark.second ?? null) === second);
}

/** Applies an `edit` of one observation to the observation on one side.
 *
 * @param {Observations} observations
 * @param {Side} side
 * @param {Edit} edit
 */
function change(observations, side, edit) {
  const now = observations[side];
  if (!now) return;
  const { anchor, end, anchor_known, end_known } = now;
  if (edit.kind === "move") {
    Object.assign(now, { anchor: edit.anchor_px ?? anchor, end: edit.end_px ?? end });
  } else if (edit.kind === "set known" || edit.kind === "set known of many") {
    Object.assign(now, { anchor_known: edit.anchor_known ?? anchor_known, end_known: edit.end_known ?? end_known });
  } else if (edit.kind === "swap ends") {
    Object.assign(now, { anchor: end, end: anchor, anchor_known: end_known, end_known: anchor_known });
  } else if (edit.kind === "delete" || edit.kind === "delete many") {
    delete observations[side];
  }
}

/** Adds an unsaved mark, to a shown element or a new one.
 *
 * @param {ShownElement[]} elements
 * @param {annotator.DrawnMark} mark
 * @param {Proposal[]} proposals
 */
function add(elements, mark, proposals) {
  if (find(elements, mark.observation_id)) return;
  const known = elements.find(({ id }) => id === mark.element_id);
  if (known) known.observations[mark.side] ??= observed(mark);
  else elements.push(drawn(mark, proposals.find(({ id }) => id === mark.element_id)));
}

/** The marks that accepted tracks add to a frame.
 *
 * @param {annotator.AcceptTracksEdit} edit
 * @param {number | null} frame
 * @param {Proposal[]} proposals of this frame
 * @param {number | null} second
 * @returns {annotator.DrawnMark[]}
 */
function markedByTracks({ track_ids: ids, corrections }, frame, proposals, second) {
  return proposals.filter(({ id, track }) => track && ids.includes(id)).flatMap((proposal) =>
    SIDES.flatMap((side) => {
      const mark = proposal.marks[side];
      if (!mark) return [];
      const placed = corrections?.find(({ observation_id: id }) => id === mark.id);
      return [{
        observation_id: mark.id,
        element_id: proposal.id,
        frame_index: frame ?? 0,
        side,
        second,
        anchor_px: placed?.anchor_px ?? mark.anchor,
        end_px: placed?.end_px ?? mark.end,
        anchor_known: mark.anchor_known,
        end_known: mark.end_known,
      }];
    }));
}

/** Whether a pending edit accepts or rejects a proposed mark, or the track that it belongs to.
 *
 * @param {Entry[]} pending
 * @param {string} id
 * @param {string} element
 */
export function isSettled(pending, id, element) {
  return pending.some(({ edit }) =>
    ((edit.kind === "accept tracks" || edit.kind === "reject tracks") && edit.track_ids.includes(element)) ||
    (edit.kind === "dismiss" && edit.dismissals.some((dismissal) => dismissal.id === id)) ||
    (edit.kind === "accept" && edit.marks.some((mark) => mark.observation_id === id)));
}

/** Swaps a mark with its runner-up; returns the same mark if there is none.
 *
 * @param {annotator.ProposalMark} mark
 * @returns {annotator.ProposalMark}
 */
export function swapped({ runner_up: second, ...mark }) {
  const { anchor, end, anchor_known, end_known, score } = mark;
  if (!second || score === null) return { ...mark, runner_up: second };
  return { ...mark, ...second, runner_up: { anchor, end, anchor_known, end_known, score } };
}

/**
 * @param {ShownElement[]} elements
 * @param {string} id of an observation
 * @returns {LocatedObservation | null}
 */
export function find(elements, id) {
  for (const element of elements) {
    for (const side of SIDES) {
      const observation = element.observations[side];
      if (observation?.id === id) return { element, side, observation };
    }
  }
  return null;
}

/**
 * @param {annotator.DrawnMark} mark
 * @returns {Observation}
 */
function observed(mark) {
  return {
    id: mark.observation_id,
    anchor: mark.anchor_px,
    end: mark.end_px ?? null,
    anchor_known: mark.anchor_known ?? true,
    end_known: mark.end_known ?? true,
  };
}

/**
 * @param {annotator.DrawnMark} mark
 * @param {Proposal | undefined} proposal
 * @returns {ShownElement}
 */
function drawn(mark, proposal) {
  return {
    id: mark.element_id,
    name: proposal?.name ?? "new",
    class_id: proposal?.class_id ?? mark.class_id ?? 0,
    unsaved: true, // not on disk yet
    observations: { [mark.side]: observed(mark) },
  };
}

/** The selected or drawn element, for guides and numbers.
 *
 * @param {State} state
 * @returns {annotator.PreviewDraftRequest["draft"]}
 */
export function draftOf(state) {
  const { drawing, dragged, selected, selectedId, pending, aids, frame } = state;
  const held = dragged && find(state.elements, dragged.observation)?.observation;
  const isSaved = selectedId && !pending.some(({ edit }) => "element_id" in edit && edit.element_id === selectedId);
  return {
    frame_index: frame ?? 0,
    selected_id: isSaved ? selectedId : null,
    is_chosen: state.isChosen,
    side: selected?.side ?? "left",
    second: state.second,
    drawing: drawing && {
      side: drawing.side,
      class_id: drawing.class,
      anchor_px: drawing.anchor,
      end_px: drawing.end,
      anchor_known: drawing.anchor_known,
      end_known: drawing.end_known,
      snap: aids.snap && !drawing.box,
      asks_bottom: aids.snap && drawing.asks_bottom,
    },
    moved: held ? { [held.id]: [held.anchor, held.end] } : {},
  };
}
