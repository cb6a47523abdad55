// @ts-check
// The panels around the images: classes, elements, card, hints, questions. Rebuilt from the state.
/** @import {annotator} from "/static/protocol" */
/** @import {Child, Click} from "/static/dom.js" */
/** @import {Keys} from "/static/keys.js" */
/** @import {Hint} from "./hints.js" */
/** @import {Images} from "../images/images.js" */
/** @import {Page} from "../main.js" */
/** @import {State} from "../state.js" */
/** @import {ElementClass, Proposal, ShownElement, Side} from "../values.js" */
import { byId, el, find, fixed, svg } from "/static/dom.js";
import { classGlyph } from "/static/glyphs.js";
import { Aids } from "../images/aids.js";
import { editing } from "../commands.js";
import { hints } from "./hints.js";
import { Jumps } from "./jumps.js";
import { Strip } from "./strip.js";
import { TopBar } from "./topbar.js";
import { toggled } from "../selection.js";
import { LOOK_FIRST, SIDES, counted, shownScore } from "../values.js";
import { QuestionBar } from "../saving/questions.js";
import { RenderCache, badge, capital, header, row } from "./widgets.js";

const MESSAGE_MS = 6000;

export class Panels {
  /**
   * @param {State} state
   * @param {Images} images
   * @param {Keys} keys
   * @param {Page} page
   * @param {{show: () => void}[]} more other parts of the page
   */
  constructor(state, images, keys, page, more) {
    this.state = state;
    this.images = images;
    this.keys = keys;
    this.page = page;
    this.edit = editing(state, page);
    this.topBar = new TopBar(state, keys, page);
    this.parts = [this.topBar, new Aids(state, keys), new Jumps(state, keys, page), new Strip(state, page), new QuestionBar(page), ...more];
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.timer = undefined;
    this.queued = false;
    /** @type {string | null} */
    this.revealed = null; // the element that the list was scrolled to
    this.cache = new RenderCache(state);
    state.onChange(() => this.#queue());
  }

  /** Fills in what does not change while the page is open. */
  start() {
    const { name, images } = this.state.workspace;
    document.title = `${name} · semviz annotate`;
    for (const side of SIDES) {
      const size = images[side];
      find(byId(`${side}-image`), ".about").textContent = size ? `${size.width} × ${size.height}` : "none";
    }
  }

  /** Shows a message below the images for a few seconds.
   *
   * @param {string} text
   */
  notify(text, kind = "") {
    if (!text) return;
    const message = byId("message");
    message.textContent = text;
    message.className = `toast ${kind}`;
    message.hidden = false;
    clearTimeout(this.timer);
    this.timer = setTimeout(() => { message.hidden = true; }, MESSAGE_MS);
  }

  #queue() {
    if (this.queued) return;
    this.queued = true;
    requestAnimationFrame(() => {
      this.queued = false;
      if (this.state.isReady) this.#show();
    });
  }

  #show() {
    const { state } = this;
    byId("scene").hidden = !state.aids.map; // a hidden scene is not drawn
    byId("map-panel").classList.toggle("off", !state.aids.map);
    this.parts.forEach((part) => part.show());
    this.cache.show("classes", [state.classId, state.labels.counts, state.workspace.classes], () => this.#classes());
    this.cache.show("elements", [state.elements, state.proposals, state.nearby, state.selected, state.isUnknown, state.aids.map], () => this.#elements());
    this.#revealChosen();
    this.cache.show("card", [state.selected, state.selectedElement, state.preview, state.previewed, state.connected, Boolean(state.drawing)], () => this.#card());
    this.cache.show("hints", hints(state), () => hints(state).map((hint) => hintItem(hint, this.keys)));
    this.#status();
  }

  /** @param {ElementClass} elementClass */
  #glyph(elementClass) {
    return classGlyph(elementClass, this.state.colorOf(elementClass));
  }

  #classes() {
    const { workspace, classId, labels } = this.state;
    return workspace.classes.map((elementClass) =>
      row({ chosen: elementClass.id === classId, onclick: () => this.edit.chooseClass(elementClass.id) },
        elementClass.key ? badge(this.keys, elementClass.key) : null, this.#glyph(elementClass),
        el("span", { class: "fill", text: capital(elementClass.name) }),
        el("span", { class: "dim", text: labels.counts[elementClass.id] ?? 0 })));
  }

  /** Selects an element; with Ctrl, together with those selected before, or not any more.
   *
   * @param {string} id
   * @param {Click} event
   */
  #choose(id, event) {
    const { state, page } = this;
    if ((event.ctrlKey || event.metaKey) && state.selected) page.tools.choose(toggled(state, id, state.selected.side));
    else page.select(id);
  }

  #elements() {
    const { state } = this;
    const line = (/** @type {Pick<ShownElement, "id" | "name" | "class_id">} */ { id, name, class_id: classId }, /** @type {Child[]} */ details) =>
      row({ chosen: state.selectedIds.includes(id), onclick: (/** @type {Click} */ event) => this.#choose(id, event) },
        this.#glyph(state.classOf(classId)), el("span", { class: "fill", text: name }), ...details);
    const rows = [...state.elements].sort((a, b) => Number(Boolean(a.left_out)) - Number(Boolean(b.left_out)));
    const labelled = rows.map((element) => {
      if (element.left_out) return line(element, [el("span", { class: "faint", text: "left out" })]);
      const sides = SIDES.filter((side) => element.observations[side]);
      const isMissing = state.hasRight && sides.length < 2;
      const proposal = state.proposals.find(({ id }) => id === element.id);
      return line(element, [
        proposal ? scoreBar(proposal) : null,
        el("span", { class: isMissing ? "warning" : "dim", text: isMissing ? `${sides[0]} only` : "left, right" }),
        el("span", { class: "views dim", text: element.views ? `${element.views}` : "" })]);
    });
    const proposed = state.expected.map((proposal) => line(proposal, [scoreBar(proposal), el("span", { class: "views dim", text: depthOrOrigin(proposal) })]));
    const near = state.nearby.map((element) => line(element, [el("span", { class: "faint", text: whyListed(element) })]));
    const unknown = state.isUnknown ? el("p", { class: "empty dim", text: "Offline: the other labels of this frame are not known here. They show when the server is back." }) : null;
    const leftOut = rows.filter(({ left_out: isLeftOut }) => isLeftOut);
    byId("elements-about").textContent = [`${rows.length - leftOut.length} ${unknown ? "drawn here" : "here"}`, count(proposed.length, "proposed"), count(near.length, "nearby"), count(leftOut.length, "left out")].filter(Boolean).join(", ");
    byId("map-about").textContent = state.aids.map ? String(state.labels.mapped) : `off: ${this.keys.shown("F")} shows it`;
    byId("map-about").title = counted(state.labels.mapped, "element");
    const kept = rows.length - leftOut.length;
    return [unknown, ...labelled.slice(0, kept), ...proposed, ...near, ...labelled.slice(kept)];
  }

  /** Scrolls the list to an element that was selected elsewhere. */
  #revealChosen() {
    const id = this.state.selected?.element ?? null;
    if (id === this.revealed) return;
    this.revealed = id;
    document.querySelector("#elements .chosen")?.scrollIntoView({ block: "nearest" });
  }

  #card() {
    const { state } = this;
    const { ownPreview: preview, drawing, selectedElement: element, selectedCandidate: candidate } = state;
    if (state.isSeveral && !drawing) return this.#several();
    const card = preview?.card ?? null;
    const id = drawing?.class ?? element?.class_id ?? candidate?.class_id;
    if (id === undefined) return [header("Element", "nothing selected"), el("p", { class: "empty dim", text: "Click an element to see its depth, height and errors." })];
    const name = drawing ? preview?.joins ?? `New ${state.classOf(id).name}` : (element ?? candidate)?.name ?? "";
    const about = drawing ? "not saved yet" : element?.unsaved ? "kept here" : element ? state.classOf(id).name : candidate ? whyListed(candidate) : "";
    const count = card?.views ?? element?.views;
    const views = count ? el("span", { class: "push chip", text: counted(count, "view") }) : null;
    const title = header(name, about, this.#glyph(state.classOf(id)), views);
    return [title, el("dl", { class: "numbers" }, ...numbers(card ?? this.#ownLengths(element), state.selected?.side ?? "left")), this.#notes(element), this.#decisions(element) ?? aboutTrack(candidate) ?? this.#missing() ?? this.#nearest(card) ?? warning(card), this.#buttons(element)];
  }

  /** The card of several selected elements and proposals: how many of each class. */
  #several() {
    const { workspace, selectedElements: elements, selectedProposals: proposals } = this.state;
    const ofClass = (/** @type {{class_id: number}[]} */ all, /** @type {number} */ id) => all.filter(({ class_id: one }) => one === id).length;
    const classes = workspace.classes.filter(({ id }) => ofClass([...elements, ...proposals], id));
    const counts = classes.map((kind) => el("li", {}, this.#glyph(kind), el("span", { class: "fill", text: capital(kind.name) }),
      el("span", { class: "dim", text: [count(ofClass(elements, kind.id), "labelled"), count(ofClass(proposals, kind.id), "proposed")].filter(Boolean).join(", ") })));
    return [header(`${elements.length + proposals.length} selected`, "keys act on all of them"), el("ul", { class: "several" }, ...counts)];
  }

  /** That no other view shows the element larger, so that its labels there may follow this one.
   *
   * @param {annotator.Card | null} card
   */
  #nearest(card) {
    if (!card?.smaller_views || this.state.drawing) return null;
    const text = `Align ${counted(card.smaller_views, "label")} farther away`;
    return el("p", { class: "about-card" }, el("button", { class: "small", onclick: this.edit.align }, text, badge(this.keys, "Shift R")));
  }

  /** Why the card lacks numbers, while the server cannot be asked. */
  #missing() {
    const { connected, ownPreview } = this.state;
    return connected || ownPreview?.card ? null : el("p", { class: "about-card dim", text: "Offline: depth and errors follow." });
  }

  /** What the page itself knows of an element: its length in each image.
   *
   * @param {ShownElement | null} element
   * @returns {{length_px: Partial<Record<Side, number>>}}
   */
  #ownLengths(element) {
    /** @type {Partial<Record<Side, number>>} */
    const lengths = {};
    for (const side of SIDES) {
      const { anchor, end } = element?.observations[side] ?? {};
      if (anchor && end) lengths[side] = Math.hypot(anchor[0] - end[0], anchor[1] - end[1]);
    }
    return { length_px: lengths };
  }

  /** The comments on the element in this frame, to be answered; null if there are none.
   *
   * @param {ShownElement | null} element
   */
  #notes(element) {
    if (!element?.notes?.length) return null;
    return el("div", { class: "card-notes" }, ...element.notes.map(({ id, author, text, unsure }) => el("p", {},
      el("span", { class: "warning", text: "◆" }), el("b", { text: author }), el("span", { class: "fill", text: text || (unsure ? "unsure" : "") }),
      el("button", { class: "small", title: "Answered: delete this comment", "aria-label": "Delete this comment", onclick: () => this.page.submit({ kind: "delete note", note_id: id }), text: "✕" }))));
  }

  /** The review decisions about the element; null if there are none.
   *
   * @param {ShownElement | null} element
   */
  #decisions(element) {
    if (!element?.review_decisions?.length) return null;
    const revokeButton = (/** @type {annotator.ReviewDecisionView} */ { id, text }) => el("button", {
      class: "small", title: "Revoke this decision", onclick: () => this.page.submit({ kind: "take back", judgement_id: id }),
    }, capital(text), " ✕");
    return el("p", { class: "about-card decisions" }, ...element.review_decisions.map(revokeButton));
  }

  /** @param {ShownElement | null} element */
  #buttons(element) {
    if (!element || this.state.drawing) return "";
    const observation = this.state.selectedObservation;
    const { kind } = this.state.classOf(element.class_id);
    /** @type {(text: string, key: string, run: () => void, pressed?: string) => HTMLElement} */
    const button = (text, key, run, pressed) =>
      el("button", { class: "small", "aria-pressed": pressed, onclick: run }, text, badge(this.keys, key));
    if (kind === "point") return el("div", { class: "buttons" }, ...this.#reclass(element), button("Delete", "Del", this.edit.remove));
    return el("div", { class: "buttons" },
      ...this.#reclass(element),
      button("Hidden", "O", () => this.edit.flag("end_known"), String(observation?.end_known === false)),
      button("Cut", "C", () => this.edit.flag("anchor_known"), String(observation?.anchor_known === false)),
      button("Delete", "Del", this.edit.remove));
  }

  /** The other classes that an element can be: of its kind.
   *
   * @param {ShownElement} element
   */
  #reclass(element) {
    const own = this.state.classOf(element.class_id).kind;
    const others = this.state.workspace.classes.filter(({ kind, id }) => kind === own && id !== element.class_id);
    return others.map((other) => {
      const title = `Make it a ${other.name}${other.key ? ` (${this.keys.shown(`Shift ${other.key}`)})` : ""}`;
      return el("button", { class: "small", title, "aria-label": title, onclick: () => this.edit.setClass(other.id) }, this.#glyph(other));
    });
  }

  /** The title of an image: of a pair its side, else the number of its frame, of a rig with its camera.
   *
   * @param {Side} side
   */
  #paneTitle(side) {
    const pane = this.state.panes[side];
    if (!pane || (this.state.hasRight && pane.frame === this.state.frame)) return capital(side);
    return pane.camera ? `${pane.camera} ${pane.frame}` : `Frame ${pane.frame}`;
  }

  #status() {
    const { state } = this;
    for (const side of SIDES) {
      find(byId(`${side}-image`), "h2").textContent = this.#paneTitle(side);
      const node = find(byId(`${side}-image`), ".status");
      const { drawing } = state;
      if (drawing?.side === side) {
        const { name, kind } = state.classOf(drawing.class);
        const next = kind === "line" ? "second click sets the bottom" : `release sets the ${state.middleOf(drawing.class)}`;
        const joins = state.preview?.joins ? ` of ${state.preview.joins}` : "";
        node.textContent = state.preview?.warning || `drawing ${name}${joins}: ${next}`;
      } else {
        const count = state.elements.filter(({ observations, left_out: isLeftOut }) => observations[side] && !isLeftOut).length;
        node.textContent = state.isUnknown ? "offline: labels not known" : counted(count, "element");
      }
    }
  }
}

/** A number with what it counts; "" for none.
 *
 * @param {number} number
 * @param {string} what
 */
const count = (number, what) => (number ? `${number} ${what}` : "");

/** Why an element that is not labelled here is listed.
 *
 * @param {Proposal | annotator.NearbyView} candidate
 */
const whyListed = (candidate) => {
  if ("labelled_in" in candidate) return `labelled in frame ${candidate.labelled_in}`;
  if (candidate.track) return trackedIn(candidate.track);
  return `proposed, ${depthOrOrigin(candidate)}${candidate.rejected_elsewhere ? ", rejected in another frame" : ""}`;
};

/** Where a track was detected: "track in frames 3 to 11".
 *
 * @param {annotator.TrackView} track
 */
const trackedIn = ({ first, last }) => (first === last ? `track in frame ${first}` : `track in frames ${first} to ${last}`);

/** The depth of a proposal or, if it is unknown, its origin.
 *
 * @param {Proposal} proposal
 */
const depthOrOrigin = ({ depth_m, origin, track }) => (track ? counted(track.frames, "frame") : depth_m !== null ? `${depth_m.toFixed(0)} m` : origin === "map" ? "far" : origin);

/** The score of a proposal, marked as weak if it is not confident; of a track, why to look at it first.
 *
 * @param {Proposal} proposal
 */
function scoreBar({ score, is_confident: isConfident, track }) {
  if (track) return track.doubt ? el("span", { class: "warning", text: track.doubt, title: LOOK_FIRST }) : null;
  if (score === null) return el("span", { class: "faint", text: "searching …" });
  const bar = svg("svg", { class: isConfident ? "score" : "score weak", viewBox: "0 0 40 6", preserveAspectRatio: "none" },
    svg("rect", { class: "track", width: 40, height: 6 }), svg("rect", { class: "done", width: 40 * score, height: 6 }));
  return el("span", { class: "scored" }, bar, el("span", { class: "dim", text: shownScore(score) }), isConfident ? null : el("span", { class: "faint", text: "weak" }));
}

/**
 * @param {Hint} hint
 * @param {Keys} keys
 */
function hintItem({ keys: names, text }, keys) {
  return el("span", { class: "hint" }, ...names.map((name) => badge(keys, name)), text);
}

/**
 * @param {Partial<annotator.Card>} card
 * @param {Side} side
 */
function numbers(card, side) {
  const lengths = card.length_px ?? {};
  const length = lengths[side] ?? Object.values(lengths)[0];
  return [
    number("Depth", card.depth_m, "m", 1, card.depth_sigma_m),
    number("Height", card.height_m, "m", 2, card.height_sigma_m),
    number("Ray angle", card.angle_deg, "°", 2),
    number("Length", length, "px", 1),
    number("Epipolar error", card.epipolar_px, "px", 2),
    number("RMS", card.rms_px, "px", 2),
  ];
}

/**
 * @param {string} name
 * @param {number | null | undefined} value
 * @param {string} unit
 * @param {number} decimals
 * @param {number | null} [sigma]
 */
function number(name, value, unit, decimals, sigma = null) {
  const known = value !== undefined && value !== null;
  return el("div", {}, el("dt", { text: name }),
    el("dd", {}, el("b", { text: known ? `${fixed(value, decimals)} ${unit}` : "—" }),
      sigma !== null ? el("span", { class: "dim", text: ` ± ${fixed(sigma, sigma < 0.1 ? 2 : 1)}` }) : null));
}

/** How sure a track is, and how well it fits; null for what is no track.
 *
 * @param {Proposal | annotator.NearbyView | null} candidate
 */
function aboutTrack(candidate) {
  if (!candidate || !("track" in candidate) || !candidate.track) return null;
  const { residual_px: residual, existence, doubt } = candidate.track;
  const sure = doubt ? el("span", { class: "warning", text: `Look first: ${doubt}`, title: LOOK_FIRST }) : "Sure";
  return el("p", { class: "about-card dim" }, sure, `. Residual ${residual.toFixed(1)} px, existence ${existence}`);
}

/** @param {annotator.Card | null} card */
function warning(card) {
  if (card?.is_thin) {
    return el("p", { class: "about-card" }, el("span", { class: "chip thin", text: "◆ Thin rays" }), " below 1°, add frames");
  }
  return el("p", { class: "about-card dim", text: card?.reason ? capital(card.reason) : "" });
}
