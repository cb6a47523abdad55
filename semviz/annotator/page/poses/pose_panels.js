// @ts-check
// The panels of the view "Poses": what is wrong, what to do, what that changes.
/** @import {annotator} from "/static/protocol" */
/** @import {Child} from "/static/dom.js" */
/** @import {Keys} from "/static/keys.js" */
/** @import {Poses} from "./poses.js" */
/** @import {State} from "../state.js" */
import { byId, el, fixed } from "/static/dom.js";
import { classGlyph, statusMark } from "/static/glyphs.js";
import { RenderCache, badge, capital, header, row } from "../panels/widgets.js";

/** @type {Record<string, string>} */
const KEYS = { refine: "Shift F", "leave out": "Shift O", keep: "Shift K" };
/** @type {Record<string, string>} */
const CHOSEN = { refine: "Refined poses are used", "leave out": "These frames are left out", keep: "The given poses are kept" };
const HINTS = [
  [[",", "."], "frame"], [["Shift ."], "next stretch"], [["Shift F"], "refine"], [["Shift O"], "leave out"], [["Shift K"], "keep"],
  [["Space"], "before, after in one place"], [["Esc"], "back"], [["F2"], "images"],
];

const NOT_YET = "Known once the poses are compared with the images.";

export class PosePanels {
  /**
   * @param {State} state
   * @param {Keys} keys
   * @param {Poses} poses
   */
  constructor(state, keys, poses) {
    this.state = state;
    this.keys = keys;
    this.poses = poses;
    this.cache = new RenderCache(state);
  }

  show() {
    const { known, place, tried, stretches, stretch, trying } = this.poses;
    const shown = [this.state.connected, known?.state, known?.done, known?.total, known?.failure, stretches, place, tried];
    byId("pose-bar").hidden = !trying;
    this.cache.show("pose-bar", [trying], () => this.#bar());
    this.cache.show("pose-wrong", shown, () => this.#wrong());
    this.cache.show("pose-answers", [stretch, tried, this.#isCompared], () => this.#answers());
    this.cache.show("pose-effects", [stretch, this.#isCompared], () => this.#effects());
    this.cache.show("pose-moved", [stretch, this.state.selected?.element], () => this.#moved());
    this.cache.show("pose-hints", [], () => HINTS.map(([keys, text]) => this.#hint(/** @type {string[]} */ (keys), String(text))));
    byId("pose-count").textContent = [known?.poses?.sentence, known?.poses?.unchecked].filter(Boolean).join("; ");
  }

  /** Whether all poses are compared with the images. */
  get #isCompared() {
    const { known } = this.poses;
    return Boolean(known?.poses) && known?.state !== "working";
  }

  #bar() {
    const { trying } = this.poses;
    if (!trying) return [];
    return [
      el("span", { class: "fill", text: trying.preview }),
      el("button", { onclick: () => this.poses.apply() }, "Apply", badge(this.keys, "Ctrl Enter")),
      el("button", { onclick: () => this.poses.drop() }, "Cancel", badge(this.keys, "Esc")),
    ];
  }

  #wrong() {
    const { stretch, stretches, known } = this.poses;
    if (!stretch) return [header("What is wrong", ""), el("div", { class: "pose-text" }, ...this.#state())];
    const sure = stretch.sigmas === null ? null : el("span", { class: "push about", title: "How far the poses are from the images", text: `${stretch.sigmas.toFixed(0)} sigma` });
    return [
      header("What is wrong", stretch.where, null, sure),
      stretches.length > 1 ? el("div", { class: "list" }, ...stretches.map((one, place) => this.#row(one, place))) : null,
      el("div", { class: "pose-text" },
        known?.state === "working" ? el("p", { class: "dim", text: progress(known) }) : null,
        el("h3", {}, statusMark(stretch.chosen ? "ok" : "cannot"), stretch.title),
        el("p", { text: stretch.sentence })),
      el("dl", { class: "pose-facts" }, ...stretch.facts.flatMap(({ name, value }) => [el("dt", { text: name }), el("dd", { text: value })])),
    ];
  }

  /** What is known while no stretch is on screen. */
  #state() {
    const { known } = this.poses;
    if ((!known || known.state === "unknown") && !this.state.connected) return [el("p", { text: "No connection. The poses load when the server is back." })];
    if (!known || known.state === "unknown") return [el("p", { text: "The poses have not been compared with the images yet." })];
    if (known.state === "failed") return [el("h3", {}, statusMark("cannot"), "Not compared"), el("p", { text: known.failure })];
    if (known.state === "working" || !known.poses) return [el("h3", {}, "Comparing poses and images"), el("p", { class: "dim", text: progress(known) })];
    const { sentence, unchecked } = known.poses;
    const missing = unchecked ? el("p", { class: "warning", text: `${capital(unchecked)}.` }) : null;
    return [el("h3", {}, statusMark(unchecked ? "ambiguous" : "ok"), unchecked ? "Too little evidence in places" : "Poses and images agree"), el("p", { text: sentence }), missing];
  }

  /**
   * @param {annotator.StretchView} stretch
   * @param {number} place
   */
  #row({ title, where, chosen }, place) {
    return row({ chosen: place === this.poses.place, onclick: () => this.poses.select(place) },
      statusMark(chosen ? "ok" : "ambiguous"), el("span", { class: "fill", text: title }), el("span", { class: "dim", text: where.replace(/^frames? /, "") }));
  }

  #answers() {
    const { stretch, tried } = this.poses;
    if (!stretch) return [header("What to do", ""), el("p", { class: "pose-text dim", text: this.#isCompared ? "Nothing: no pose is in question." : NOT_YET })];
    const chosen = stretch.chosen && [
      el("p", { class: "pose-text" }, el("b", { text: CHOSEN[stretch.chosen] }), ` (${stretch.chosen_by})`),
      el("div", { class: "buttons" }, el("button", { onclick: () => this.poses.askAgain() }, "Use the given poses, and ask again")),
    ];
    return [header("What to do", ""), ...(chosen ?? []), ...stretch.answers.filter(({ choice }) => choice !== stretch.chosen).map((answer) => this.#answer(answer, tried))];
  }

  /**
   * @param {annotator.PoseAnswer} answer
   * @param {string | null} tried
   */
  #answer({ choice, title, price, refusal }, tried) {
    return el("div", { class: "pose-answer" },
      el("button", { "aria-pressed": String(choice === tried), onclick: () => this.poses.try(choice) }, title, badge(this.keys, KEYS[choice])),
      el("p", { class: refusal ? "warning" : "dim", text: refusal || price }));
  }

  #effects() {
    const { stretch } = this.poses;
    if (!stretch?.effects.length) return [header("What it changes", ""), el("p", { class: "pose-text dim", text: this.#isCompared ? "Refining changes nothing here." : NOT_YET })];
    return [
      header("What refining changes", stretch.where),
      el("table", {}, el("tr", {}, el("th"), el("th", { text: "before" }), el("th", { text: "after" })),
        ...stretch.effects.map(({ name, before, after }) => el("tr", {}, el("td", { text: name }), el("td", { text: before }), el("td", {}, el("b", { text: after }))))),
    ];
  }

  #moved() {
    const moved = this.poses.stretch?.moved ?? [];
    return [
      header("Elements it moves", moved.length ? `${moved.length}, most first` : "none known"),
      el("div", { class: "scroll" }, el("table", {},
        el("tr", {}, el("th", { text: "element" }), el("th", { text: "moves" }), el("th", { text: "px before" }), el("th", { text: "after" })),
        ...moved.map((element) => this.#element(element)))),
    ];
  }

  /** @param {annotator.MovedElement} element */
  #element({ id, name, class_id: classId, moved_m: moved, before_px: before, after_px: after }) {
    const kind = this.state.classOf(classId);
    const isSelected = this.state.selected?.element === id;
    return el("tr", { class: isSelected ? "chosen" : "", onclick: () => this.state.set({ selected: { element: id, side: "left" } }) },
      el("td", {}, classGlyph(kind, this.state.colorOf(kind)), ` ${name}`), el("td", { text: `${moved.toFixed(2)} m` }),
      el("td", { text: fixed(before, 1) }), el("td", {}, el("b", { text: fixed(after, 1) })));
  }

  /**
   * @param {string[]} keys
   * @param {string} text
   * @returns {Child}
   */
  #hint(keys, text) {
    return el("span", { class: "hint" }, ...keys.map((name) => badge(this.keys, name)), text);
  }
}

/** @param {annotator.PosesEvent} event */
function progress({ done, total, seconds }) {
  return total ? `${done} of ${total} pairs of frames measured, ${seconds.toFixed(0)} s so far` : "starting …";
}
