// @ts-check
// The hint line under the images: what the keys do now.

/** @import {annotator} from "/static/protocol" */
/** @import {State} from "../state.js" */
/** @import {Drawing, Ghost, Proposal, Selected, ShownElement} from "../values.js" */

import { SIDES } from "../values.js";

/** @typedef {{keys: string[], text: string}} Hint */

/** The hints for the present state, most useful first; a narrow window shows only the first six.
 *
 * @param {State} state
 * @returns {Hint[]}
 */
export function hints(state) {
  const { drawing, selectedElement: element, selectedCandidate: candidate, selected } = state;
  if (drawing) return forDrawing(state, drawing);
  if (state.ghost) return forGhost(state.ghost);
  const kind = state.classOf(state.classId).kind;
  const draw = kind === "line" ? hint("peak, then bottom", "Click") : hint(`${state.middleOf(state.classId)}, or drag a box`, "Click");
  if (state.review && !selected) return forReview(state.review.entry);
  if (state.isSeveral && selected) return forSeveral(state, selected);
  const proposal = state.currentProposal;
  if (proposal && (!element || element.id === proposal.id)) return forProposal(state, proposal);
  if (element && selected) return forElement(state, element, selected);
  if (candidate) return [hint(`${candidate.name} here`, "Click"), hint("not this one", "Esc")];
  return [
    ...backToStrip(state), draw, hint("class", ...state.workspace.classes.filter(({ key }) => key).map(({ key }) => key)), hint("zoom", "Wheel"), hint("pan", "Right drag"),
    hint("frame", ",", "."), hint("reviewed", "Enter"), hint("all keys", "?"),
  ];
}

/** @param {State} state */
const backToStrip = ({ isOfStrip }) => (isOfStrip ? [hint("reviewed, back to the filmstrip", "Ctrl Enter")] : []);

/** @param {Ghost} ghost */
const forGhost = ({ joins }) => [
  hint(joins ? `${joins} as dashed` : "the whole pole as dashed", "Click"), hint("peak, then bottom", "Shift Click"), hint("one stroke", "Drag"), hint("no whole poles", "Shift P"),
];

/**
 * @param {State} state
 * @param {Selected} selected
 */
function forSeveral(state, { side }) {
  const labelled = state.selectedObservations, proposals = state.selectedProposals;
  const kinds = new Set(state.selectedElements.map((element) => state.classOf(element.class_id).kind));
  const classes = state.workspace.classes.filter(({ key, kind }) => key && kinds.has(kind)).map(({ key }) => key);
  return [
    ...(proposals.length ? [hint(`accept ${proposals.length}`, "Space"), hint(`reject ${proposals.length}`, "X")] : []),
    ...(labelled.length ? [hint(`delete ${labelled.length} in the ${side} image`, "Del")] : []),
    ...(classes.length > 1 ? [hint("class", "Shift", ...classes)] : []),
    ...(kinds.has("line") ? [hint("bottoms hidden", "O"), hint("peaks cut", "C")] : []),
    ...(state.selectedElements.length > 1 ? [hint("link", "P")] : []),
    hint("clear", "Esc"),
  ];
}

/** @param {annotator.EntryView} entry */
function forReview({ answers }) {
  const options = answers.slice(0, 2).map(({ title }, index) => hint(title.toLowerCase(), ["Y", "Shift Y"][index]));
  return [...options, hint("zoom to it", "Z"), hint("next", "Shift ."), hint("previous", "Shift ,"), hint("close", "Esc")];
}

/**
 * @param {State} state
 * @param {Proposal} proposal
 */
function forProposal(state, proposal) {
  const confident = state.confidentProposals.length;
  const found = state.foundProposals.length;
  const next = state.isOfStrip ? "and back to the filmstrip" : "and next frame";
  if (proposal.track) return forTrack(state, proposal, proposal.track);
  const second = proposal.marks.left?.runner_up ?? proposal.marks.right?.runner_up;
  return [
    hint(`accept ${proposal.name}`, "Space"),
    ...(confident > 1 || found > 1 ? [] : backToStrip(state)),
    ...(confident > 1 ? [hint(`accept ${confident} confident`, "Shift Space"), hint(next, "Ctrl Enter")] : []),
    ...(found > Math.max(confident, 1) ? [hint(`accept all ${found}`, "Shift G"), hint(next, "Ctrl Shift Enter")] : []),
    hint("reject", "X"), hint("next", "Tab"), ...(second ? [hint("second-best", "K")] : []),
    hint("gone", "N"), hint("hidden", "O"), hint("draw it", "Click"),
  ];
}

/**
 * @param {State} state
 * @param {Proposal} proposal
 * @param {annotator.TrackView} track
 */
function forTrack(state, { name }, { frames }) {
  const sure = state.labels.map.sure_tracks;
  const all = frames === 1 ? "" : ` in ${frames} frames`;
  return [
    hint(`accept ${name}${all}`, "Space"), hint("reject", "X"), hint("next", "Tab"), hint("correct here", "Drag"),
    ...(sure > 1 ? [hint(`${sure} sure tracks`, "Shift A")] : []), hint("draw it", "Shift Click"),
  ];
}

/**
 * @param {State} state
 * @param {Drawing} drawing
 */
function forDrawing(state, drawing) {
  const snapped = state.preview?.snapped;
  if (state.classOf(drawing.class).kind === "point") return [hint(`sets the ${state.middleOf(drawing.class)}`, "Release"), hint("cancel", "Esc")];
  return [
    hint("bottom", "Click"), hint("cancel", "Esc"), hint(snapped?.end_known === false ? "bottom not hidden" : "bottom hidden", "O"), hint("peak cut", "C"),
    hint("zoom", "Wheel"), hint("pan", "Right drag"),
  ];
}

/**
 * @param {State} state
 * @param {ShownElement} element
 * @param {Selected} selected
 */
function forElement(state, element, { side }) {
  const here = element.observations[side];
  const isLine = state.classOf(element.class_id).kind === "line";
  const confident = state.confidentProposals.length;
  const missing = state.hasRight && SIDES.find((other) => !element.observations[other]);
  return [
    ...(confident ? [hint(`accept ${confident} confident`, "Shift Space")] : []),
    ...backToStrip(state),
    ...(missing ? [hint(`${element.name} in the ${missing} image`, "Click")] : []),
    ...(here ? [hint("0.1 px", "Arrows"), hint("delete", "Del")] : []),
    ...(here && isLine ? [hint("bottom hidden", "O"), hint("peak cut", "C"), hint("swap", "R")] : []),
    hint("draw on top", "Shift Click"), hint("zoom to it", "Z"), hint("frame", ",", "."),
  ];
}

/**
 * @param {string} text
 * @param {...string} keys
 * @returns {Hint}
 */
const hint = (text, ...keys) => ({ keys, text });
