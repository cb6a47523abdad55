// @ts-check
// The state of the page and what follows from it. No DOM here.
/** @import {annotator} from "/static/protocol" */
/** @import {Aids, Brightness, Correction, Dragged, Drawing, ElementClass, Entry, Ghost, Proposal, OpenReview, PageLabels, Point, Question, Rectangle, Selected, ShownElement, Side} from "./values.js" */
import { find, isSettled, standing, swapped, withPending } from "./saving/pending.js";
import { NONE_CHOSEN, SIDES } from "./values.js";

export const LEAST_SCORE = 0.05; // of a proposal that was found in the image; below, it is where the element should be

/** The default of the aid `bright`. */
export const PLAIN_LIGHT = { brightness: 1.7, contrast: 1.15 };

/** A class that was declared a moment ago: the workspace with it is on its way.
 * @type {ElementClass} */
const UNKNOWN = { id: -1, name: "new class", kind: "line", letter: "?", shape: "line", color: "#CCCCCC", color_light: "#555555", key: "" };

/** The last operation that the labels and another part of the page both show, if there is such a part.
 *
 * @param {{operation: number, hash: string}} labels
 * @param {{operation: number, hash: string} | null} part
 */
export function lastOfBoth(labels, part) {
  const { operation, hash } = part && part.operation < labels.operation ? part : labels;
  return { operation, hash };
}

/** The page's state: the labels from the server, the pending edits, and the state of this page only. */
export class State {
  constructor() {
    /** @type {annotator.WorkspaceView | null} */
    this.known = null; // fixed while the page is open
    /** @type {PageLabels | null} */
    this.received = null; // the last summary and frame from the server
    /** @type {number | null} */
    this.frame = null; // number of the frame on screen
    /** @type {annotator.SecondImage | null} */
    this.wish = null; // for another second image than the usual one; see second.js
    /** @type {"images" | "filmstrip" | "tracks" | "poses" | "team" | "drive"} */
    this.view = "images"; // the tab
    /** @type {number[]} */
    this.leftStrip = []; // the frames of the filmstrip that was left for one of them, to draw what it lacks there
    this.classId = 0; // for the next element; see nextClass
    /** @type {Selected | null} */
    this.selected = null; // with the side of the selected observation
    /** @type {Rectangle | null} */
    this.rectangle = null; // being drawn to select several
    /** @type {"anchor" | "end"} */
    this.vertex = "anchor"; // which end of the selected pole the arrows move
    /** @type {Aids} */
    this.aids = { snap: true, whole: true, loupe: true, guides: true, proposals: true, bright: false, map: true, backdrop: false };
    /** @type {Brightness} */
    this.light = { ...PLAIN_LIGHT }; // of the images while the aid `bright` is on
    /** @type {annotator.PastFrame | null} */
    this.past = null; // the earlier state shown in the images
    /** @type {{side: Side, pixel: Point} | null} */
    this.cursor = null; // the keyboard cursor
    /** @type {Drawing | null} */
    this.drawing = null;
    /** @type {Dragged | null} */
    this.dragged = null;
    /** @type {annotator.DraftPreview | null} */
    this.preview = null; // guides, snapped drawing and card of the draft, from the server
    /** @type {{frame: number | null, subject: string}} */
    this.previewed = { frame: null, subject: "" }; // what `preview` is about
    /** @type {Ghost | null} */
    this.ghost = null; // the whole pole under the pointer or the cursor
    /** @type {string | null} */
    this.pointed = null; // the element of the proposal under the pointer
    /** @type {Set<string>} */
    this.swapped = new Set(); // ids of proposed marks that are swapped with their runner-up
    /** @type {Map<string, Correction>} */
    this.corrected = new Map(); // corrected marks of tracks, by the id of the mark
    this.asked = { text: "", until: 0 }; // the question that the next press of the same key answers
    this.jump = "unreviewed"; // the chosen jump list; see jumps.js
    /** @type {OpenReview | null} */
    this.review = null; // the open decision or finding; see review.js
    /** @type {Question | null} */
    this.question = null; // about a refused edit
    this.chosen = NONE_CHOSEN; // what a person selected last, and where
    /** @type {Entry[]} */
    this.pending = []; // unsaved edits, oldest first
    /** @type {{request: string, operation: number} | null} */
    this.onDisk = null; // the edit saved last; its labels may still be on their way
    this.connected = false;
    /** @type {"dark" | "light"} */
    this.theme = "dark";
    /** @type {import("/static/keys.js").Keys["changed"]} */
    this.changedKeys = {}; // a change redraws the badges
    /** @type {string | null} */
    this.trouble = null; // why the server could not save
    /** @type {Pick<annotator.LabelFileEvent, "state" | "text">} */
    this.labelFile = { state: "checking", text: "" };
    /** @type {{frames: annotator.FrameSummary[] | null, order: number[]}} */
    this.ordered = { frames: null, order: [] }; // the cached `order` of these frames
    /** @type {(() => void)[]} */
    this.listeners = [];
    /** @type {ShownElement[] | null} */
    this.shown = null; // cached `elements`, until the next change
    /** @type {Proposal[] | null} */
    this.proposed = null; // cached `proposals`, until the next change
  }

  /** Whether workspace and labels have arrived. */
  get isReady() {
    return this.known !== null && this.received !== null;
  }

  /** Names, classes and image sizes. Throws before they have arrived. */
  get workspace() {
    if (!this.known) throw new Error("the workspace has not arrived yet");
    return this.known;
  }

  /** The last summary and frame from the server. Throws before they have arrived. */
  get labels() {
    if (!this.received) throw new Error("the labels have not arrived yet");
    return this.received;
  }

  /** What the card is about: the drawing or the selected element. */
  get subject() {
    return this.drawing ? "drawing" : this.selectedId ?? "";
  }

  /** Numbers and guides of the drawing or selected element; null until they have arrived. */
  get ownPreview() {
    return this.previewed.frame === this.frame && this.previewed.subject === this.subject ? this.preview : null;
  }

  /** Whether the frame on screen was opened from the filmstrip, which is shown next as it was left. */
  get isOfStrip() {
    return this.leftStrip.includes(this.frame ?? -1);
  }

  /** Whether a person selected the selected element in this frame: it did not only stay selected. */
  get isChosen() {
    return this.selected?.element === this.chosen.element && this.frame === this.chosen.frame;
  }

  /** The class of what is drawn next in an image: that of an element that a person selected to be drawn there, else the
   * chosen one.
   *
   * @param {Side} side
   */
  nextClass(side) {
    const selected = this.selectedElement ?? this.selectedCandidate;
    const isLabelled = Boolean(this.selectedElement?.observations[side]);
    return selected && this.isChosen && !isLabelled ? selected.class_id : this.classId;
  }

  /** The last operation that both the frame and the list of frames show. */
  get lastShown() {
    return lastOfBoth(this.labels, this.labels.frame);
  }

  /** @param {() => void} listener */
  onChange(listener) {
    this.listeners.push(listener);
  }

  /** Sets fields and calls every listener once.
   *
   * @param {Partial<State>} fields
   */
  set(fields) {
    Object.assign(this, fields, { shown: null, proposed: null });
    this.listeners.forEach((listener) => listener());
  }

  /** The labels of the frame on screen, of the present or an earlier state; null until they arrive. */
  get shownFrame() {
    const frame = this.past?.frame ?? this.received?.frame;
    return frame && frame.index === this.frame ? frame : null;
  }

  /** Whether the labels of the frame on screen are not known, and nobody can be asked. */
  get isUnknown() {
    return !this.connected && !this.shownFrame;
  }

  /** Labelled elements of the frame on screen, with pending edits applied. */
  get elements() {
    this.shown ??= this.#elements();
    return this.shown;
  }

  /** @returns {ShownElement[]} */
  #elements() {
    if (this.past) return this.shownFrame?.elements ?? [];
    const { elements: saved, proposals } = this.shownFrame ?? { elements: [], proposals: [] };
    const elements = withPending(saved, this.pending, this.frame, proposals, this.second);
    if (this.dragged) {
      const { observation, anchor, end } = this.dragged;
      const target = find(elements, observation);
      const now = target?.observation;
      if (now) Object.assign(now, { anchor: anchor ?? now.anchor, end: end ?? now.end });
    }
    return elements;
  }

  /** The proposals in the images of the frame on screen, by element. */
  get proposals() {
    this.proposed ??= this.#proposals();
    return this.proposed;
  }

  #proposals() {
    if (!this.shownFrame) return [];
    const observed = new Map(this.elements.map(({ id, observations }) => [id, observations]));
    const pending = standing(this.pending);
    return this.shownFrame.proposals.map((proposal) => {
      const marks = { ...proposal.marks };
      for (const side of SIDES) {
        const mark = marks[side];
        if (!mark) continue;
        const placed = this.dragged?.observation === mark.id ? this.dragged : this.corrected.get(mark.id);
        if (observed.get(proposal.id)?.[side] || isSettled(pending, mark.id, proposal.id)) delete marks[side];
        else if (this.swapped.has(mark.id)) marks[side] = swapped(mark);
        else if (placed) marks[side] = { ...mark, anchor: placed.anchor ?? mark.anchor, end: placed.end ?? mark.end };
      }
      return { ...proposal, marks };
    }).filter(({ marks }) => SIDES.some((side) => marks[side]));
  }

  /** Whether the open decision or finding is about an element.
   *
   * @param {string} id
   */
  isReviewed(id) {
    return Boolean(this.review?.entry.elements.some((element) => element.id === id));
  }

  /** Whether an element is left out of maps and not drawn: it is not selected, nor asked about.
   *
   * @param {ShownElement} element
   */
  isHidden({ id, left_out: isLeftOut }) {
    return Boolean(isLeftOut) && id !== this.selected?.element && !this.isReviewed(id);
  }

  /** Elements of near frames to continue, without a known position. */
  get nearby() {
    if (!this.shownFrame) return [];
    const here = new Set([...this.elements, ...this.proposals].map(({ id }) => id));
    return this.shownFrame.nearby.filter(({ id }) => !here.has(id));
  }

  /** Proposals of elements that are labelled in neither image of this frame. */
  get expected() {
    const here = new Set(this.elements.map(({ id }) => id));
    return this.proposals.filter((proposal) => !here.has(proposal.id));
  }

  /** The proposal that keys act on: the one under the pointer, else the selected one, else the first. */
  get currentProposal() {
    const { proposals, selected, pointed } = this;
    if (!this.aids.proposals || this.drawing) return null;
    const named = (/** @type {string | null | undefined} */ id) => proposals.find((proposal) => proposal.id === id);
    return named(pointed) ?? named(selected?.element) ?? proposals[0] ?? null;
  }

  /** The proposals among several that are selected; none if it is one only. */
  get selectedProposals() {
    const ids = new Set(this.isSeveral && this.aids.proposals ? this.selectedIds : []);
    return this.proposals.filter(({ id }) => ids.has(id));
  }

  /** The proposals that keys act on: all selected ones if they are several, else the current one. */
  get currentProposals() {
    const { selectedProposals: several, currentProposal: current } = this;
    return several.length ? several : current ? [current] : [];
  }

  /** Proposals whose marks are all confident. */
  get confidentProposals() {
    return this.aids.proposals ? this.proposals.filter((proposal) => proposal.is_confident) : [];
  }

  /** Proposals that one look at the frame can accept together: found in the images, and of known elements if weak. */
  get foundProposals() {
    const isFound = (/** @type {Proposal} */ { origin, score }) => origin !== "detector" && (score ?? 0) >= LEAST_SCORE;
    return this.aids.proposals ? this.proposals.filter((proposal) => proposal.is_confident || isFound(proposal)) : [];
  }

  /** Numbers of all frames, in order of time. */
  get order() {
    const { frames } = this.labels;
    if (this.ordered.frames !== frames) this.ordered = { frames, order: frames.map(({ index }) => index) };
    return this.ordered.order;
  }

  /** The ids of all that is selected. */
  get selectedIds() {
    return this.selected ? [this.selected.element, ...(this.selected.also ?? [])] : [];
  }

  get isSeveral() {
    return Boolean(this.selected?.also?.length);
  }

  /** The id of what is selected, if it is one only. */
  get selectedId() {
    return this.isSeveral ? null : this.selected?.element ?? null;
  }

  /** The selected element, if it is one only. */
  get selectedElement() {
    return this.elements.find(({ id }) => id === this.selectedId) ?? null;
  }

  /** The labelled ones of several selected elements; none if it is one only. */
  get selectedElements() {
    const ids = new Set(this.isSeveral ? this.selectedIds : []);
    return this.elements.filter(({ id }) => ids.has(id));
  }

  /** The observations of several selected elements on the selected side, with their elements. */
  get selectedObservations() {
    return this.selectedElements.flatMap((element) => {
      const observation = this.selected && element.observations[this.selected.side];
      return observation ? [{ element, observation }] : [];
    });
  }

  /** The range of all frames, as people type one. */
  get wholeDrive() {
    const { order } = this;
    return `${order[0] ?? 0}-${order.at(-1) ?? 0}`;
  }

  /** A selected element that is not labelled here: a proposal or an element of near frames. */
  get selectedCandidate() {
    const id = this.selectedId;
    return [...this.proposals, ...this.nearby].find((candidate) => candidate.id === id) ?? null;
  }

  /** The selected element's observation on the selected side. */
  get selectedObservation() {
    return (this.selected && this.selectedElement?.observations[this.selected.side]) ?? null;
  }

  /** The CSS filter of the images and the loupe. */
  get filter() {
    return this.aids.bright ? `brightness(${this.light.brightness}) contrast(${this.light.contrast})` : "none";
  }

  /** The images on the page; with one camera, right is another frame's left image, or missing.
   *
   * @returns {Partial<Record<Side, annotator.PaneView>>}
   */
  get panes() {
    if (this.frame === null) return {};
    const here = this.received?.frame;
    if (here && here.index === this.frame) return here.panes;
    const pane = (/** @type {Side} */ side) => ({ frame: this.frame ?? 0, side, camera: "" });
    return this.knowsPanes ? { left: pane("left"), right: pane("right") } : { left: pane("left") };
  }

  /** @param {number} id */
  classOf(id) {
    return this.workspace.classes.find((candidate) => candidate.id === id) ?? UNKNOWN;
  }

  /** What the point of a sign is: of a triangle, what the workspace's labels mark.
   *
   * @param {number} id
   * @returns {"centroid" | "middle"}
   */
  middleOf(id) {
    const isCentroid = this.workspace.triangle_center === "centroid" && this.classOf(id).shape === "triangle";
    return isCentroid ? "centroid" : "middle";
  }

  /** A class's colour on panels; on images it is always `color`.
   *
   * @param {ElementClass} elementClass
   */
  colorOf(elementClass) {
    return this.theme === "light" ? elementClass.color_light : elementClass.color;
  }

  get hasRight() {
    return this.known?.has_right ?? false;
  }

  /** Whether the images of a frame are known before the server names them. */
  get knowsPanes() {
    return this.hasRight && !this.wish;
  }

  /** The frame of the second image; null for the frame's own right one, or none. */
  get second() {
    const { right } = this.panes;
    return right && right.frame !== this.frame ? right.frame : null;
  }
}
