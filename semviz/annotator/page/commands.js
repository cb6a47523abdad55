// @ts-check
// All commands of the page with their keys, for the key handler and the help overlay.
/** @import {Command} from "/static/keys.js" */
/** @import {Images} from "./images/images.js" */
/** @import {Page} from "./main.js" */
/** @import {State} from "./state.js" */
/** @import {Aids, Observation, Point} from "./values.js" */
import { switchTheme } from "/static/theme.js";
import { backToImages, nextPanel } from "./panels/focus.js";
import { toggleHistory } from "./history/history.js";
import { jumpCommands } from "./panels/jumps.js";
import { proposalCommands, proposing, whyIncomplete } from "./proposals.js";
import { reviewCommands } from "./panels/review.js";
import { secondCommands } from "./images/second.js";
import { travelCommands } from "./travel.js";
import { all, severalEdits } from "./selection.js";
import { NONE_CHOSEN, SIDES, other, uuid7 } from "./values.js";

/** The commands, for `Keys`. Entries without `run` are mouse gestures, listed in the help.
 *
 * @param {State} state
 * @param {Images} images
 * @param {Page["tools"]} tools
 * @param {Page} actions
 * @returns {Command[]}
 */
export function commands(state, images, tools, actions) {
  const edit = editing(state, actions);
  const step = (/** @type {number} */ by) => actions.go(neighbour(state, by));
  const toggle = (/** @type {keyof Aids} */ aid) => () => state.set({ aids: { ...state.aids, [aid]: !state.aids[aid] } });
  const { cursor, past, review, tour } = actions;
  const nudge = (/** @type {string} */ key, /** @type {number} */ du, /** @type {number} */ dv) => {
    const by = (/** @type {number} */ px, /** @type {number} */ cursorPx) => () => {
      if (cursor.takesArrows) cursor.move(cursorPx * du, cursorPx * dv);
      else edit.nudge(px * du, px * dv);
    };
    return [
      { key, group: "Draw", title: "Move 0.1 px (cursor 1 px)", run: by(0.1, 1) },
      { key, shift: true, group: "Draw", title: "Move 1 px (cursor 10 px)", run: by(1, 10) },
      { key, ctrl: true, group: "Draw", title: "Move the cursor 0.1 px", run: () => cursor.move(0.1 * du, 0.1 * dv) },
    ];
  };
  const more = "Select more: one, a rectangle, all in the image";
  const keyed = state.workspace.classes.filter(({ key }) => key);
  return [
    { key: "Click", group: "Draw", title: `Pole: the whole one if it is dashed, else peak, then bottom. Sign: middle${state.workspace.triangle_center === "centroid" ? "; of a triangle the centroid, a third of its height from its base" : ""}` },
    { key: "Drag", group: "Draw", title: "Sign: a box around it. Pole: one stroke" },
    { key: "Click", shift: true, group: "Draw", title: "Draw, even on top of an element" },
    ...keyed.map(({ id, key, name }) => ({
      key, group: "Draw", title: `Class: ${name}`, row: "Class of the next element", run: () => edit.chooseClass(id),
    })),
    { key: "Escape", group: "Draw", title: "Cancel the drawing; clear the selection", run: () => {
      if (backToImages() || tools.cancel()) return;
      tour.end();
      if (!past.back() && !cursor.hide() && !review.close()) actions.select(null);
    } },

    { key: "Click element", group: "Draw", title: "Select; drag moves an end, or all of it" },
    { key: "Click element", ctrl: true, group: "Draw", title: "Select one more, or not any more", row: more },
    { key: "Drag", ctrl: true, group: "Draw", title: "Select all that the rectangle touches", row: more },
    { key: "a", ctrl: true, group: "Draw", title: "Select all in this image", row: more, words: "rectangle several many", run: () => tools.choose(all(state, state.cursor?.side ?? state.selected?.side ?? "left")) },
    { key: "p", group: "Draw", title: "Link the selected elements", run: edit.link },
    { key: "u", group: "Draw", title: "Unlink: this view is another element", words: "split", run: edit.unlink },
    ...keyed.map(({ id, key, name }) => ({
      key, shift: true, group: "Draw", title: `What is selected becomes ${name}`, row: "Class of the selection", run: () => edit.setClass(id),
    })),
    { key: "o", group: "Draw", title: "Bottom hidden; proposal: all hidden", run: () => edit.hide() },
    { key: "c", group: "Draw", title: "Peak cut off, or visible again", run: () => edit.flag("anchor_known") },
    { key: "r", group: "Draw", title: "Swap peak and bottom", run: edit.swap },
    { key: "r", shift: true, group: "Draw", title: "Align its other labels to this view", words: "snap track again whole", run: edit.align },
    ...nudge("ArrowLeft", -1, 0), ...nudge("ArrowRight", 1, 0),
    ...nudge("ArrowUp", 0, -1), ...nudge("ArrowDown", 0, 1),
    { key: "+", group: "Draw", title: "Show the cursor; again: set a point", run: () => cursor.setPoint() },
    { key: "-", group: "Draw", title: "Cursor or selection to the other image", run: () => {
      const { selected } = state;
      if (state.cursor || !selected) cursor.cross();
      else actions.select(selected.element, other(selected.side));
    } },
    { key: "v", group: "Draw", title: "Arrows move the other end", run: edit.otherEnd },
    { key: "Delete", group: "Draw", title: "Delete what is selected in this image", run: edit.remove },
    { key: "Delete", shift: true, group: "Draw", title: "Delete the element in all frames", run: edit.removeAll },

    ...proposalCommands(state, images, actions, () => actions.filmstrip.goOn()),

    { key: "Wheel", group: "View", title: "Zoom both images at the pointer" },
    { key: "Right drag", group: "View", title: "Pan; also middle button, or Alt" },
    { key: "z", group: "View", title: "Zoom to the selection or map decision", run: () => zoomToSelection(state, images) },
    { key: "PageUp", group: "View", title: "Zoom in, at the cursor or the middle", run: () => images.zoomBy(1.5, state.cursor?.pixel) },
    { key: "PageDown", group: "View", title: "Zoom out", run: () => images.zoomBy(1 / 1.5, state.cursor?.pixel) },
    { key: "0", group: "View", title: "Whole image", run: () => images.fit() },
    { key: "m", group: "View", title: "Snap to edges", run: toggle("snap") },
    { key: "p", shift: true, group: "View", title: "Whole pole by one click", words: "ghost", run: toggle("whole") },
    { key: "l", group: "View", title: "Loupe", run: toggle("loupe") },
    { key: "i", group: "View", title: "Epipolar line", run: toggle("guides") },
    { key: "g", group: "View", title: "Proposals", run: toggle("proposals") },
    { key: "b", group: "View", title: "Brightness and contrast", run: toggle("bright") },
    { key: "f", group: "View", title: "3D map; off is faster on slow machines", run: toggle("map") },
    { key: "b", shift: true, group: "View", title: "Backdrop of the 3D map", run: toggle("backdrop") },

    { key: ",", group: "Frames", title: "Previous frame", row: "Previous, next frame", run: () => step(-1) },
    { key: ".", group: "Frames", title: "Next frame", row: "Previous, next frame", run: () => step(1) },
    ...travelCommands(state, images, actions),
    ...secondCommands(state, actions),
    ...jumpCommands(state, actions),
    ...reviewCommands(review, actions),
    { key: "Enter", group: "Frames", title: "Mark as reviewed", run: () => edit.review("reviewed") },
    { key: "Enter", shift: true, group: "Frames", title: "Mark as reviewed, empty", run: () => edit.review("reviewed, empty") },

    { key: "z", ctrl: true, group: "History", title: "Undo, also after a restart", run: () => actions.submit({ kind: "undo" }) },
    { key: "z", ctrl: true, shift: true, group: "History", title: "Redo", run: () => actions.submit({ kind: "redo" }) },
    { key: "h", group: "History", title: "History: go back to any operation", run: toggleHistory },
    { key: "o", ctrl: true, group: "History", title: "Export the labels: how", row: "Export; name this state", words: "save write file", run: () => {
      actions.notify(`All labels are on disk. In a terminal: semviz labels export ${state.workspace.name} labels.jsonl`);
    } },
    { key: "b", ctrl: true, group: "History", title: "Name this state", row: "Export; name this state", run: () => actions.nameState() },

    { key: "t", group: "General", title: "Dark or light theme", run: () => {
      switchTheme();
      actions.sendTheme();
    } },
    { key: "k", ctrl: true, group: "General", title: "All commands", run: () => actions.palette() },
    { key: "?", group: "General", title: "All keys", run: () => actions.help() },
    { key: "F1", group: "General", title: "Tour in 3 steps", run: () => tour.open() },
    { key: "F6", group: "General", title: "Next panel; Tab and arrows inside", run: () => nextPanel(1) },
    { key: "F6", shift: true, group: "General", title: "Previous panel", run: () => nextPanel(-1) },
  ];
}

/** The actions of the editing keys on the selected observation; each makes one edit or none.
 *
 * @param {State} state
 * @param {Pick<Page, "submit" | "select" | "preview" | "notify">} actions
 */
export function editing(state, actions) {
  const pole = () => {
    const element = state.selectedElement;
    return element && state.classOf(element.class_id).kind === "line" ? state.selectedObservation : null;
  };
  const withPole = (/** @type {(observation: Observation) => void} */ run) => () => {
    const observation = pole();
    if (observation) run(observation);
  };
  const several = severalEdits(state, actions);
  return {
    /** @param {number} id */
    chooseClass(id) {
      if (state.drawing || !state.workspace.classes.some((kind) => kind.id === id)) return;
      const selected = state.selectedElement ?? state.selectedCandidate;
      const continues = !selected || selected.class_id === id; // what is drawn next
      state.set({ classId: id, ...(continues ? {} : { chosen: NONE_CHOSEN }) });
    },
    /** @param {number} id */
    setClass(id) {
      if (several.setClass(id)) return;
      const element = state.selectedElement;
      if (element && element.class_id !== id && state.classOf(id).kind === state.classOf(element.class_id).kind) actions.submit({ kind: "set class", element_id: element.id, class_id: id });
    },
    link() {
      if (state.isSeveral) actions.submit({ kind: "link", element_ids: state.selectedIds });
    },
    unlink() {
      const observation = state.selectedObservation;
      if (observation) actions.submit({ kind: "unlink", observation_ids: [observation.id], new_element_id: uuid7() });
    },
    align() {
      const { selectedElement: element, frame } = state;
      if (element && frame !== null) actions.submit({ kind: "align labels", element_id: element.id, frame_index: frame });
    },
    /** @param {"anchor_known" | "end_known"} end */
    flag(end) {
      const { drawing } = state;
      if (drawing?.end) {
        const shown = end === "end_known" ? state.preview?.snapped?.end_known : null; // the server may have marked the bottom as hidden
        const asks_bottom = drawing.asks_bottom && end !== "end_known";
        state.set({ drawing: { ...drawing, [end]: !(shown ?? drawing[end]), asks_bottom } });
        actions.preview();
        return;
      }
      if (several.flag(end)) return;
      const observation = pole();
      if (observation) actions.submit({ kind: "set known", observation_id: observation.id, [end]: !observation[end] });
    },
    hide() {
      if (state.drawing || state.selectedObservation || state.selectedObservations.length) this.flag("end_known");
      else proposing(state, actions).dismiss("occluded");
    },
    swap: withPole(({ id }) => actions.submit({ kind: "swap ends", observation_id: id })),
    otherEnd: withPole(() => state.set({ vertex: state.vertex === "anchor" ? "end" : "anchor" })),
    /**
     * @param {number} du
     * @param {number} dv
     */
    nudge(du, dv) {
      const observation = state.selectedObservation;
      if (!observation) return;
      const shifted = (/** @type {Point} */ [u, v]) => /** @type {Point} */ ([u + du, v + dv]);
      const { id, anchor, end } = observation;
      const movesEnd = state.vertex === "end" && end;
      actions.submit({
        kind: "move",
        observation_id: id,
        anchor_px: movesEnd ? null : shifted(anchor),
        end_px: movesEnd ? shifted(end) : null,
      });
    },
    remove() {
      if (several.remove()) return;
      const observation = state.selectedObservation;
      if (!observation) return;
      actions.submit({ kind: "delete", observation_id: observation.id });
      const left = SIDES.find((side) => state.selectedElement?.observations[side]);
      actions.select(left && state.selected ? state.selected.element : null);
    },
    removeAll() {
      const element = state.selectedElement;
      if (!element) return;
      actions.submit({ kind: "delete element", element_id: element.id });
      actions.select(null);
    },
    /** @param {"reviewed" | "reviewed, empty"} reviewState */
    review(reviewState) {
      const { frame, shownFrame, connected } = state;
      if (frame === null) return;
      if (connected && !shownFrame) {
        actions.notify(whyIncomplete(state));
        return;
      }
      const now = state.labels.frames.find(({ index }) => index === frame)?.state;
      if (now !== reviewState || state.pending.length) actions.submit({ kind: "review", frame_index: frame, state: reviewState });
    },
  };
}

/** The frame `by` frames further; null at the ends.
 *
 * @param {State} state
 * @param {number} by
 */
export function neighbour(state, by) {
  return state.order[state.order.indexOf(state.frame ?? -1) + by] ?? null;
}

/** Zooms to the selection or, without one, to the elements of the open decision or finding.
 *
 * @param {State} state
 * @param {Images} images
 */
export function zoomToSelection(state, images) {
  const { selectedElement: element, selectedCandidate: candidate } = state;
  const selected = element?.observations ?? (candidate && ("marks" in candidate ? candidate.marks : {}));
  const labelled = state.elements.filter(({ id }) => state.isReviewed(id)).map(({ observations }) => observations);
  const proposed = state.proposals.filter(({ id }) => state.isReviewed(id)).map(({ marks }) => marks);
  const all = selected ? [selected] : [...labelled, ...proposed];
  const sides = state.selected ? [state.selected.side, ...SIDES] : SIDES;
  const side = sides.find((candidate) => all.some((marks) => marks[candidate]));
  const shown = side ? all.flatMap((marks) => marks[side] ?? []) : [];
  if (shown.length) images.zoomTo(shown.flatMap(({ anchor, end }) => (end ? [anchor, end] : [anchor])));
}
