// @ts-check
// The jump lists: frames that need work, and the open decisions and findings of the last map.
/** @import {annotator} from "/static/protocol" */
/** @import {Command, Keys} from "/static/keys.js" */
/** @import {Page} from "../main.js" */
/** @import {ListName} from "./review.js" */
/** @import {State} from "../state.js" */
import { el } from "/static/dom.js";
import { REVIEWS } from "./review.js";
import { RenderCache, badge, row } from "./widgets.js";

const FEW = 4; // elements that a frame needs for a reliable pose

/** @typedef {annotator.FrameSummary} Frame */
/** @typedef {Pick<Page, "go" | "select" | "stepReview">} Actions */

/** A list of frames: its filter, its order, the summary in its row, and the element to select.
 *
 * @typedef {{
 *   title: string,
 *   has: (frame: Frame, state: State) => boolean,
 *   rank?: (frame: Frame) => number,
 *   summary: (frames: Frame[]) => string | number,
 *   element?: (frame: Frame) => string | null | undefined,
 * }} JumpList */

/** @type {Record<string, JumpList>} */
export const JUMPS = {
  "sent back": {
    title: "Sent back", has: ({ index }, state) => sentBackTo(state).includes(index), summary: (frames) => frames.length,
  },
  unreviewed: {
    title: "Unreviewed", has: ({ state }) => !state.startsWith("reviewed"), summary: (frames) => frames.length,
  },
  worst: {
    title: "Worst residual", has: ({ worst }) => (worst?.px ?? 0) > 0, rank: ({ worst }) => -(worst?.px ?? 0),
    summary: ([first]) => (first?.worst ? `${first.worst.px.toFixed(1)} px` : "none"), element: ({ worst }) => worst?.element,
  },
  few: {
    title: `Under ${FEW} elements`, has: ({ elements }) => elements < FEW, summary: (frames) => frames.length,
  },
  proposals: {
    title: "With proposals", has: ({ proposed }) => (proposed ?? 0) > 0, summary: (frames) => frames.length,
  },
  disagree: {
    title: "Detector disagrees", has: ({ disagreement }) => (disagreement?.weight ?? 0) > 0,
    rank: ({ disagreement }) => -(disagreement?.weight ?? 0),
    summary: (frames) => frames.length,
    element: ({ disagreement }) => disagreement?.worst_id,
  },
  asked: {
    title: "Labels asked for", has: ({ asked }) => asked.length > 0,
    summary: (frames) => (frames.length > 2 ? frames.length : frames.flatMap(({ asked }) => asked).join(", ")),
  },
};

const SOMETIMES = ["sent back", "asked"]; // lists that are there only with frames

/** The frames that a reviewer sent back, without those of another's range.
 *
 * @param {State} state
 */
export function sentBackTo(state) {
  return state.labels.team.sent_back.filter((frame) => !ownerOf(state, frame));
}

/** Who else has a frame, if it is not one's own, too; empty for nobody.
 *
 * @param {State} state
 * @param {number} frame
 */
export function ownerOf({ labels, workspace }, frame) {
  const has = (/** @type {[number, number][]} */ ranges) => ranges.some(([first, last]) => frame >= first && frame <= last);
  const names = Object.entries(labels.team.assigned).filter(([, ranges]) => has(ranges)).map(([name]) => name);
  return names.includes(workspace.author) ? "" : names[0] ?? "";
}

/** The frames of a list: in order of time, or worst first if the list has ranks.
 *
 * @param {State} state
 * @param {string} name
 */
export function jumpFrames(state, name = state.jump) {
  const { has, rank } = JUMPS[name];
  const frames = state.labels.frames.filter((frame) => has(frame, state));
  return rank ? frames.sort((first, second) => rank(first) - rank(second)) : frames;
}

/** Commands for `Keys`.
 *
 * @param {State} state
 * @param {Actions} actions
 * @returns {Command[]}
 */
export function jumpCommands(state, actions) {
  const group = "Frames";
  return [
    { key: ",", shift: true, group, title: "Previous in the jump list", row: "Previous, next in the jump list", run: () => jump(state, actions, -1) },
    { key: ".", shift: true, group, title: "Next in the jump list", row: "Previous, next in the jump list", run: () => jump(state, actions, 1) },
    { key: "j", group, title: "Choose the jump list", run: () => {
      const names = [...frameLists(state), ...reviewLists(state)];
      state.set({ jump: names[(names.indexOf(state.jump) + 1) % names.length] });
    } },
  ];
}

/** The lists of frames; those of sent back ones and of labels asked for only while there are some.
 *
 * @param {State} state
 */
function frameLists(state) {
  return Object.keys(JUMPS).filter((name) => !SOMETIMES.includes(name) || state.jump === name || jumpFrames(state, name).length);
}

/** The lists of the last map; that of tracks only if the map was built from detections.
 *
 * @param {State} state
 * @returns {ListName[]}
 */
function reviewLists(state) {
  const { tracks } = state.labels.map;
  return tracks || state.jump === "tracks" ? ["tracks", "decisions", "findings"] : ["decisions", "findings"];
}

/** Goes to the next entry of the list; if the frame on screen is not in it, to the next in time.
 *
 * @param {State} state
 * @param {Actions} actions
 * @param {-1 | 1} by
 */
function jump(state, actions, by) {
  if (state.jump in REVIEWS) {
    actions.stepReview(/** @type {ListName} */ (state.jump), by);
    return;
  }
  const frames = jumpFrames(state).map(({ index }) => index);
  if (!frames.length) return;
  const now = state.frame ?? -1;
  const here = frames.indexOf(now);
  if (here >= 0) actions.go(frames[here + by] ?? null);
  else if (JUMPS[state.jump].rank) actions.go(frames[0]);
  else actions.go((by > 0 ? frames.find((index) => index > now) : frames.findLast((index) => index < now)) ?? frames[0]);
  selectElement(state, actions);
}

/** Selects the element because of which the frame is in the list.
 *
 * @param {State} state
 * @param {Actions} actions
 */
function selectElement(state, actions) {
  const frame = state.labels.frames.find(({ index }) => index === state.frame);
  const element = frame && JUMPS[state.jump].element?.(frame);
  if (element) actions.select(element);
}

/** Name, title and summary.
 * @typedef {[string, string, string | number]} Row */

/** The panel of jump lists. */
export class Jumps {
  /**
   * @param {State} state
   * @param {Keys} keys
   * @param {Actions} actions
   */
  constructor(state, keys, actions) {
    this.state = state;
    this.keys = keys;
    this.actions = actions;
    this.cache = new RenderCache(state);
    /** @type {Frame[] | null} */
    this.frames = null;
    /** @type {annotator.TeamSummary | null} */
    this.team = null;
    /** @type {Row[]} */
    this.lists = []; // of these frames
  }

  show() {
    const { labels, jump } = this.state;
    const { built, tracks, decisions, findings } = labels.map;
    const counts = { tracks, decisions, findings };
    if (this.frames !== labels.frames || this.team !== labels.team) {
      this.frames = labels.frames;
      this.team = labels.team;
      this.lists = frameLists(this.state).map((name) => [name, JUMPS[name].title, JUMPS[name].summary(jumpFrames(this.state, name))]);
    }
    /** @type {Row[]} */
    const reviews = reviewLists(this.state).map((name) => [name, REVIEWS[name].title, built === null && name !== "tracks" ? (tracks ? "not built" : "no map") : counts[name]]);
    const lists = [...this.lists, ...reviews];
    this.cache.show("jumps", [lists, jump], () => lists.map((list) => this.#row(list)));
  }

  /** @param {Row} list */
  #row([name, title, summary]) {
    const chosen = name === this.state.jump;
    const choose = () => {
      this.state.set({ jump: name });
      jump(this.state, this.actions, 1);
    };
    return row({ chosen, onclick: choose },
      el("span", { class: "fill", text: title }), chosen ? badge(this.keys, "J") : null, el("span", { class: "dim", text: summary }));
  }
}
