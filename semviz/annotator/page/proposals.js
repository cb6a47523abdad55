// What the proposal keys do: accept, turn down, pick the runner-up, step through.
import { SIDES, uuid7 } from "./state.js";

/** Commands for `Keys`; `nextFrame()` goes on to the frame after. */
export function proposalCommands(state, actions, nextFrame) {
  const does = proposing(state, actions);
  const group = "Proposals";
  return [
    { key: " ", group, title: "Accept the current one", run: does.accept },
    { key: " ", shift: true, group, title: "Accept all that are sure", run: does.acceptSure },
    { key: "Enter", ctrl: true, group, title: "Accept the sure ones, reviewed, next frame", run: () => {
      does.acceptSure();
      actions.sayReviewed();
      nextFrame();
    } },
    { key: "x", group, title: "Reject: not here", run: () => does.dismiss("rejected") },
    { key: "n", group, title: "Not there any more", run: () => does.dismiss("absent") },
    { key: "k", group, title: "Pick the runner-up", run: does.swap },
    { key: "Tab", group, title: "Next", run: () => does.step(1) },
    { key: "Tab", shift: true, group, title: "The one before", run: () => does.step(-1) },
  ];
}

/** What can be done with proposals, on the state as it is now. */
export function proposing(state, { submit, select }) {
  const accepted = (offers) => {
    const marks = offers.flatMap((offer) => SIDES.filter((side) => offer[side]).map((side) => mark(state.frame, offer, side)));
    if (marks.length) submit({ kind: "accept", marks });
  };
  return {
    accept() {
      if (state.currentOffer) accepted([state.currentOffer]);
    },
    acceptSure() {
      accepted(state.sureOffers);
    },
    /** `why`: rejected, absent or occluded. Returns whether there was something to turn down. */
    dismiss(why) {
      const offer = state.currentOffer;
      if (!offer) return false;
      const dismissals = SIDES.filter((side) => offer[side]).map((side) => ({
        id: offer[side].id,
        frame_index: offer[side].frame,
        side: offer[side].side,
        why,
        element_id: offer.origin === "detector" ? null : offer.id,
      }));
      submit({ kind: "dismiss", dismissals });
      return true;
    },
    swap() {
      const changed = SIDES.map((side) => state.currentOffer?.[side]).filter((one) => one?.runner_up);
      const swapped = new Set(state.swapped);
      for (const { id } of changed) if (!swapped.delete(id)) swapped.add(id);
      state.set({ swapped });
    },
    /** Steps through the proposals or, where there are none, through the elements. */
    step(by) {
      const ids = (state.offers.length ? state.offers : state.elements).map((one) => one.id);
      if (!ids.length) return;
      const place = ids.indexOf(state.selected?.element);
      select(ids[place < 0 ? (by > 0 ? 0 : ids.length - 1) : (place + by + ids.length) % ids.length]);
    },
  };
}

/** One accepted mark. A detector's becomes an observation under its own id, of a new element
 * unless all its marks fit one that is expected there. */
function mark(frame, offer, side) {
  const { id, anchor, end, anchor_known, end_known } = offer[side];
  const isNew = offer.origin === "detector";
  return {
    observation_id: isNew ? id : uuid7(),
    element_id: offer.id,
    frame_index: frame,
    side,
    anchor_px: anchor,
    end_px: end,
    anchor_known,
    end_known: end !== null && end_known,
    ...(isNew ? { class_id: offer.class } : {}),
  };
}
