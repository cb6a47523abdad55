// The lists of what wants a visit, frames and questions of the last map, and the way through them.
import { byId, el } from "/static/dom.js";
import { REVIEWS } from "./review.js";
import { Kept, badge, row } from "./widgets.js";

const FEW = 4; // elements that a frame needs for a pose without doubt

/** Every list of frames: what belongs in it, which comes first, what its row shows, and the element
 * that it is about. */
export const JUMPS = {
  unreviewed: {
    title: "Unreviewed", has: ({ state }) => !state.startsWith("reviewed"), about: (frames) => frames.length,
  },
  worst: {
    title: "Worst residual", has: ({ worst }) => worst?.px > 0, rank: (one) => -one.worst.px,
    about: ([first]) => (first ? `${first.worst.px.toFixed(1)} px` : "none"), meant: ({ worst }) => worst?.element,
  },
  few: {
    title: `Under ${FEW} elements`, has: ({ elements }) => elements < FEW, about: (frames) => frames.length,
  },
  proposals: {
    title: "With proposals", has: ({ proposed }) => proposed > 0, about: (frames) => frames.length,
  },
  disagree: {
    title: "Detector disagrees", has: ({ disagreement }) => disagreement?.weight > 0, rank: (one) => -one.disagreement.weight,
    about: ([first]) => (first ? `${first.disagreement.new} new, ${first.disagreement.unseen} unseen` : "none"),
    meant: ({ disagreement }) => disagreement?.worst_id,
  },
};

/** Frames of a list: in order of time, or worst first where it ranks them. */
export function jumpFrames(state, name = state.jump) {
  const { has, rank } = JUMPS[name];
  const frames = state.labels.frames.filter(has);
  return rank ? frames.sort((one, two) => rank(one) - rank(two)) : frames;
}

/** Commands for `Keys`. */
export function jumpCommands(state, actions) {
  const group = "Frames";
  const names = [...Object.keys(JUMPS), ...Object.keys(REVIEWS)];
  return [
    { key: ",", shift: true, group, title: "Before, in the jump list", run: () => jump(state, actions, -1) },
    { key: ".", shift: true, group, title: "After, in the jump list", run: () => jump(state, actions, 1) },
    { key: "j", group, title: "Choose the jump list", run: () => {
      state.set({ jump: names[(names.indexOf(state.jump) + 1) % names.length] });
    } },
  ];
}

/** Goes on in the list: from the frame on screen or, where that is not in it, to the next in time. */
function jump(state, actions, by) {
  if (state.jump in REVIEWS) {
    actions.stepReview(state.jump, by);
    return;
  }
  const frames = jumpFrames(state).map(({ index }) => index);
  if (!frames.length) return;
  const here = frames.indexOf(state.frame);
  if (here >= 0) actions.go(frames[here + by] ?? null);
  else if (JUMPS[state.jump].rank) actions.go(frames[0]);
  else actions.go((by > 0 ? frames.find((one) => one > state.frame) : frames.findLast((one) => one < state.frame)) ?? frames[0]);
  selectMeant(state, actions);
}

/** What the list is about in this frame is in hand at once. */
function selectMeant(state, actions) {
  const frame = state.labels.frames.find(({ index }) => index === state.frame);
  const element = frame && JUMPS[state.jump].meant?.(frame);
  if (element) actions.select(element);
}

/** The panel of jump lists. */
export class Jumps {
  constructor(state, keys, actions) {
    this.state = state;
    this.keys = keys;
    this.actions = actions;
    this.kept = new Kept(state);
    this.frames = null;
    this.lists = []; // of these frames
  }

  show() {
    const { labels, jump } = this.state;
    const { built, ...counts } = labels.map;
    if (this.frames !== labels.frames) {
      this.frames = labels.frames;
      this.lists = Object.entries(JUMPS).map(([name, { title, about }]) => [name, title, about(jumpFrames(this.state, name))]);
    }
    const reviews = Object.entries(REVIEWS).map(([name, { title }]) => [name, title, built === null ? "no map yet" : counts[name]]);
    const lists = [...this.lists, ...reviews];
    this.kept.show("jumps", [lists, jump], () => lists.map((one) => this.#row(one)));
  }

  #row([name, title, about]) {
    const chosen = name === this.state.jump;
    const choose = () => {
      this.state.set({ jump: name });
      jump(this.state, this.actions, 1);
    };
    return row({ chosen, onclick: choose },
      el("span", { class: "fill", text: title }), chosen ? badge(this.keys, "J") : null, el("span", { class: "dim", text: about }));
  }
}
