// @ts-check
// Several elements and proposals selected together, and the commands on all of them.
/** @import {Page} from "./main.js" */
/** @import {State} from "./state.js" */
/** @import {Point, Rectangle, Selected, Side} from "./values.js" */
import { other } from "./values.js";

/** The selection with one more element, or without it if it was selected.
 *
 * @param {State} state
 * @param {string} id
 * @param {Side} side
 */
export function toggled({ selectedIds: ids }, id, side) {
  return selectionOf(ids.includes(id) ? ids.filter((one) => one !== id) : [id, ...ids], side);
}

/** The selection of all that a rectangle touches.
 *
 * @param {State} state
 * @param {Rectangle} rectangle
 */
export function touched(state, { side, from, to }) {
  const shown = marksIn(state, side);
  return selectionOf(shown.filter(({ mark: { anchor, end } }) => touches(anchor, end ?? anchor, from, to)).map(({ id }) => id), side);
}

/** The selection of all in one image.
 *
 * @param {State} state
 * @param {Side} side
 */
export function all(state, side) {
  return selectionOf(marksIn(state, side).map(({ id }) => id), side);
}

/** The edits of all selected elements; each returns whether several are selected, and makes one edit or none.
 *
 * @param {State} state
 * @param {Pick<Page, "submit" | "select" | "notify">} actions
 */
export function severalEdits(state, actions) {
  const isLine = (/** @type {number} */ id) => state.classOf(id).kind === "line";
  return {
    /** @param {number} id */
    setClass(id) {
      if (!state.isSeveral) return false;
      const alike = state.selectedElements.filter((element) => isLine(element.class_id) === isLine(id));
      const ids = alike.filter((element) => element.class_id !== id).map((element) => element.id);
      if (ids.length) actions.submit({ kind: "set class of many", element_ids: ids, class_id: id });
      const others = state.selectedElements.length - alike.length;
      if (others) actions.notify(`${others} of ${state.selectedElements.length} stay as they are: a line cannot become a point, nor a point a line.`);
      return true;
    },
    /** Says that ends are not visible; if none is, that all are.
     *
     * @param {"anchor_known" | "end_known"} end
     */
    flag(end) {
      const poles = state.selectedObservations.filter(({ element }) => isLine(element.class_id)).map(({ observation }) => observation);
      if (!poles.length) return false;
      const known = poles.every((pole) => !pole[end]);
      actions.submit({ kind: "set known of many", observation_ids: poles.filter((pole) => pole[end] !== known).map(({ id }) => id), [end]: known });
      return true;
    },
    /** Deletes the views in this image; those in the other one stay selected. */
    remove() {
      const { selected, isSeveral } = state;
      if (!isSeveral || !selected) return false;
      const ids = state.selectedObservations.map(({ observation }) => observation.id);
      if (ids.length) actions.submit({ kind: "delete many", observation_ids: ids });
      const left = state.selectedElements.map(({ id }) => id);
      if (left.length) state.set({ selected: selectionOf(left, other(selected.side)) });
      else actions.select(null);
      return true;
    },
  };
}

/**
 * @param {string[]} ids
 * @param {Side} side
 * @returns {Selected | null}
 */
const selectionOf = ([element, ...also], side) => (element ? { element, side, also } : null);

/** What an image shows: the marks of elements and proposals.
 *
 * @param {State} state
 * @param {Side} side
 */
function marksIn(state, side) {
  const elements = state.elements.filter((element) => !state.isHidden(element)).map(({ id, observations }) => ({ id, mark: observations[side] }));
  const proposals = state.aids.proposals ? state.proposals.map(({ id, marks }) => ({ id, mark: marks[side] })) : [];
  const seen = new Map([...elements, ...proposals].flatMap(({ id, mark }) => (mark ? [[id, mark]] : [])));
  return [...seen].map(([id, mark]) => ({ id, mark }));
}

/** Whether a segment touches a rectangle given by two corners (Liang and Barsky, 1984).
 *
 * @param {Point} start
 * @param {Point} end
 * @param {Point} from
 * @param {Point} to
 */
export function touches(start, end, from, to) {
  let [first, last] = [0, 1];
  for (const axis of [0, 1]) {
    const along = end[axis] - start[axis];
    const [low, high] = [Math.min(from[axis], to[axis]) - start[axis], Math.max(from[axis], to[axis]) - start[axis]];
    if (along === 0) {
      if (low > 0 || high < 0) return false;
      continue;
    }
    const [enters, leaves] = [low / along, high / along].sort((a, b) => a - b);
    [first, last] = [Math.max(first, enters), Math.min(last, leaves)];
  }
  return first <= last;
}
