// @ts-check
// The proposal keys: accept, reject, swap with the runner-up, step through.
/** @import {annotator} from "/static/protocol" */
/** @import {Command} from "/static/keys.js" */
/** @import {Images} from "./images/images.js" */
/** @import {Page} from "./main.js" */
/** @import {State} from "./state.js" */
/** @import {Proposal, Side} from "./values.js" */
import { SIDES, uuid7 } from "./values.js";

const ASKED_MS = 6000; // as long as the message is shown

/** Commands for `Keys`; `nextFrame()` goes to the next frame.
 *
 * @param {State} state
 * @param {Pick<Images, "fit" | "unseen">} images
 * @param {Pick<Page, "submit" | "select" | "notify" | "markReviewed">} actions
 * @param {() => void} nextFrame
 * @returns {Command[]}
 */
export function proposalCommands(state, images, actions, nextFrame) {
  const proposal = proposing(state, actions);
  const group = "Proposals";
  /** Accepts what was in view; returns whether that was all. */
  const acceptSeen = (/** @type {Proposal[]} */ proposals) => {
    const { length } = images.unseen(proposals);
    if (!length) {
      proposal.acceptAll(proposals);
      return true;
    }
    images.fit();
    actions.notify(length === 1 ? "A proposal was out of view: look at it, then press again." : `${length} proposals were out of view: look at them, then press again.`);
    return false;
  };
  const goOn = (/** @type {Proposal[]} */ proposals, /** @type {KeyboardEvent | undefined} */ event) => {
    const reason = event?.repeat ? "" : whyIncomplete(state);
    if (event?.repeat || reason) { // a key that is held down looks at nothing
      actions.notify(reason);
      return;
    }
    if (!acceptSeen(proposals)) return;
    actions.markReviewed();
    images.fit(); // what is proposed next may be anywhere
    nextFrame();
  };
  return [
    { key: " ", group, title: "Accept the current proposal", run: proposal.accept },
    { key: " ", shift: true, group, title: "Accept all confident proposals", row: "Accept confident; all", run: () => acceptSeen(state.confidentProposals) },
    { key: "Enter", ctrl: true, group, title: "The same, mark as reviewed, next frame or back to the filmstrip", row: "Confident, reviewed; next or back to strip", run: (event) => goOn(state.confidentProposals, event) },
    { key: "Enter", ctrl: true, shift: true, group, title: "Accept every proposal, mark as reviewed, next frame", row: "All, reviewed; next or back to strip", words: "all looked", run: (event) => goOn(state.foundProposals, event) },
    { key: "g", shift: true, group, title: "Accept every proposal, weak ones too", row: "Accept confident; all", words: "all looked", run: () => acceptSeen(state.foundProposals) },
    { key: "x", group, title: "Reject: not here", run: () => proposal.dismiss("rejected") },
    { key: "n", group, title: "Reject: no longer there", run: () => proposal.dismiss("absent") },
    { key: "k", group, title: "Take the second-best candidate", run: proposal.swap },
    { key: "a", shift: true, group, title: "Accept all sure tracks; says how many first", row: "Accept all sure tracks", run: proposal.acceptSureTracks },
    { key: "Tab", group, title: "Next proposal", run: () => proposal.step(1) },
    { key: "Tab", shift: true, group, title: "Previous proposal", run: () => proposal.step(-1) },
  ];
}

/** Why not all that is proposed in the frame is on screen yet; "" if it is. Until then nobody can have seen it, and the
 * key that accepts it and goes on would lose it.
 *
 * @param {State} state
 */
export function whyIncomplete({ connected, shownFrame, frame, pending, question, trouble, labelFile }) {
  if (!shownFrame) return connected ? `Frame ${frame} is still loading: press again when it is there.` : "Offline: the labels of this frame are not known.";
  if (!connected || question || trouble || labelFile.text) return ""; // the answer may take long
  const isDrawn = pending.some(({ edit }) => edit.kind === "draw" && edit.frame_index === frame);
  return isDrawn || shownFrame.is_searching ? "The images are still being searched: press again in a moment." : "";
}

/** The actions on proposals, for the present state.
 *
 * @param {State} state
 * @param {Pick<Page, "submit" | "select" | "notify">} actions
 */
export function proposing(state, actions) {
  const acceptAll = (/** @type {Proposal[]} */ proposals) => {
    const tracks = proposals.filter(({ track }) => track).map(({ id }) => id);
    if (tracks.length) actions.submit(acceptedTracks(state, tracks));
    const marks = proposals.filter(({ track }) => !track).flatMap((proposal) => marksOf(proposal).map(([side, mark]) => ({ ...drawnMark(state.frame ?? 0, proposal, side, mark), second: state.second })));
    if (marks.length) actions.submit({ kind: "accept", marks });
  };
  return {
    acceptAll,
    accept() {
      acceptAll(state.currentProposals);
    },
    /** Accepts all sure tracks of the drive, once the user has been told how many. */
    acceptSureTracks() {
      const { tracks: open, sure_tracks: sure } = state.labels.map;
      const question = sure ? `${sure} of ${open} open tracks are sure. Press again to accept them in one operation.` : "No open track is sure.";
      if (sure && state.asked.text === question && Date.now() < state.asked.until) {
        state.set({ asked: { text: "", until: 0 } });
        actions.submit({ kind: "accept sure tracks", count: sure });
        return;
      }
      state.set({ asked: { text: question, until: Date.now() + ASKED_MS } });
      actions.notify(question);
    },
    /** Rejects the current proposal, or all selected ones. Returns whether there was one.
     *
     * @param {"rejected" | "absent" | "occluded"} why
     */
    dismiss(why) {
      const proposals = state.currentProposals;
      const [first] = proposals;
      const tracks = proposals.filter(({ track }) => track).map(({ id }) => id);
      const marked = proposals.filter(({ track }) => !track);
      if (!first) return false;
      if (tracks.length && why !== "rejected") {
        actions.notify("A track is accepted or rejected in all its images. Accept it, then delete single views.");
        return true;
      }
      if (tracks.length) actions.submit({ kind: "reject tracks", track_ids: tracks });
      if (marked.length) actions.submit({ kind: "dismiss", dismissals: marked.flatMap((proposal) => dismissals(proposal, why)) });
      if (proposals.length > 1) actions.select(null);
      else if (why === "rejected" && marked.length && first.origin !== "detector") actions.select(first.id); // what is drawn next continues it
      return true;
    },
    swap() {
      const swapped = new Set(state.swapped);
      for (const [, { id, runner_up }] of state.currentProposal ? marksOf(state.currentProposal) : []) {
        if (runner_up && !swapped.delete(id)) swapped.add(id);
      }
      state.set({ swapped });
    },
    /** Steps through the proposals; without any, through the elements.
     *
     * @param {number} by
     */
    step(by) {
      const ids = (state.proposals.length ? state.proposals : state.elements).map(({ id }) => id);
      if (!ids.length) return;
      const index = ids.indexOf(state.selected?.element ?? "");
      actions.select(ids[index < 0 ? (by > 0 ? 0 : ids.length - 1) : (index + by + ids.length) % ids.length]);
    },
  };
}

/** Accepts tracks with the corrections that were made in any of their images.
 *
 * @param {State} state
 * @param {string[]} tracks
 * @returns {annotator.AcceptTracksEdit}
 */
export function acceptedTracks(state, tracks) {
  const made = [...state.corrected].filter(([, { track }]) => tracks.includes(track));
  return {
    kind: "accept tracks",
    track_ids: tracks,
    corrections: made.map(([id, { anchor, end }]) => ({ observation_id: id, anchor_px: anchor, end_px: end })),
  };
}

/** Rejections of all marks of a proposal.
 *
 * @param {Proposal} proposal
 * @param {"rejected" | "absent" | "occluded"} why
 */
export function dismissals(proposal, why) {
  const element = proposal.origin === "detector" ? null : proposal.id;
  return marksOf(proposal).map(([, { id, frame, side }]) => ({ id, frame_index: frame, side, why, element_id: element }));
}

/** The marks of a proposal with their sides.
 *
 * @param {Proposal} proposal
 * @returns {[Side, annotator.ProposalMark][]}
 */
export function marksOf({ marks }) {
  return SIDES.flatMap((side) => {
    const mark = marks[side];
    return mark ? [/** @type {[Side, annotator.ProposalMark]} */ ([side, mark])] : [];
  });
}

/** An accepted mark. A detection keeps its id and starts a new element, unless all its marks fit an
 * expected one.
 *
 * @param {number} frame
 * @param {Proposal} proposal
 * @param {Side} side
 * @param {Pick<annotator.ProposalMark, "id" | "anchor" | "end" | "anchor_known" | "end_known">} mark
 * @returns {annotator.DrawnMark}
 */
export function drawnMark(frame, proposal, side, { id, anchor, end, anchor_known, end_known }) {
  const isNew = proposal.origin === "detector";
  return {
    observation_id: isNew ? id : uuid7(),
    element_id: proposal.id,
    frame_index: frame,
    side,
    anchor_px: anchor,
    end_px: end,
    anchor_known,
    end_known: end !== null && end_known,
    ...(isNew ? { class_id: proposal.class_id } : {}),
  };
}
