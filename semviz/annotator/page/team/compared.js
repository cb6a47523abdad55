// @ts-check
// Two versions of a frame, side by side: of two people who labelled it blind, or an earlier one and the present one.
/** @import {annotator} from "/static/protocol" */
/** @import {Child} from "/static/dom.js" */
/** @import {Page} from "../main.js" */
/** @import {State} from "../state.js" */
/** @import {Side} from "../values.js" */
import { Surface } from "/static/canvas.js";
import { byId, el } from "/static/dom.js";
import { drawText } from "/static/glyphs.js";
import { drawVersions } from "./two_versions.js";
import { uuid7 } from "../values.js";
import { RenderCache, badge, row } from "../panels/widgets.js";

/** What is taken of an element: the label of one of both, the mean, or nothing.
 * @typedef {"first" | "second" | "mean" | "none"} Taken */
/** @typedef {annotator.ComparedElement} ComparedElement */

export class Compared {
  /**
   * @param {State} state
   * @param {Page} page
   */
  constructor(state, page) {
    this.state = state;
    this.page = page;
    this.cache = new RenderCache(state);
    /** @type {annotator.ComparedEvent | null} */
    this.known = null;
    /** @type {string | null} */
    this.chosen = null; // the element whose pictures are shown
    /** @type {Map<string, Taken>} by element, as somebody decided */
    this.taken = new Map();
    this.asked = "";
    /** @type {Map<Side, ImageBitmap>} */
    this.bitmaps = new Map();
    this.trouble = ""; // why there is no image
    this.surface = new Surface(byId("compared-picture", HTMLCanvasElement), (context, width, height) => this.#draw(context, width, height));
    page.socket.on("compared", (event) => {
      this.known = event;
      if (!event.elements.some(({ id }) => id === this.chosen)) this.chosen = event.elements[0]?.id ?? null;
      this.#load(event.frame);
      state.set({});
    });
  }

  /** The versions of the frame on screen, if they were asked for. */
  get shown() {
    return this.asked && this.known?.frame === this.state.frame ? this.known : null;
  }

  get element() {
    return this.shown?.elements.find(({ id }) => id === this.chosen) ?? null;
  }

  /** Elements that wait for a decision before the frame can be merged. */
  get open() {
    return this.shown?.elements.filter((element) => !this.#takenOf(element)) ?? [];
  }

  /** Asks for the versions of a frame after an operation; null asks for none.
   *
   * @param {number | null} frame
   * @param {number} operation
   */
  ask(frame, operation) {
    const asked = frame === null ? "" : `${frame} ${operation}`;
    if (asked === this.asked) return;
    if (this.asked.split(" ")[0] !== asked.split(" ")[0]) {
      this.taken.clear();
      this.chosen = null;
      this.known = null;
    }
    this.asked = asked;
    if (frame !== null) this.page.socket.send("show_compared", { frame });
  }

  /** Chooses the next or previous element.
   *
   * @param {1 | -1} by
   */
  step(by) {
    const elements = this.shown?.elements ?? [];
    const at = elements.findIndex(({ id }) => id === this.chosen);
    this.chosen = elements[Math.max(0, Math.min(elements.length - 1, at + by))]?.id ?? null;
    this.state.set({});
  }

  /** Decides what is taken of the chosen element, and goes to the next that is open.
   *
   * @param {Taken} what
   */
  take(what) {
    const { element, shown } = this;
    if (!shown?.is_blind || !element) return;
    if (!this.#choices(element).includes(what)) {
      this.page.notify(what === "mean" ? "There is no mean: take one of both." : `${shown.people[what === "first" ? 0 : 1]} did not label it.`, "wrong");
      return;
    }
    this.taken.set(element.id, what);
    this.chosen = this.open[0]?.id ?? this.chosen;
    this.state.set({});
  }

  /** Takes what was decided as the labels of the frame, and marks it as reviewed. Returns whether it did. */
  merge() {
    const { shown, open, page } = this;
    if (!shown?.is_blind) return false;
    if (open.length) {
      page.notify(`${open.length === 1 ? "One element waits" : `${open.length} elements wait`} for a decision.`, "wrong");
      this.chosen = open[0].id;
      this.state.set({});
      return false;
    }
    page.submit({ kind: "merge frame", frame_index: shown.frame, marks: shown.elements.flatMap((element) => this.#marks(element, shown.frame)), of_second: shown.elements.filter((element) => this.#takenOf(element) === "second").map(({ id }) => id) });
    return true;
  }

  /**
   * @param {ComparedElement} element
   * @param {number} frame
   */
  #marks(element, frame) {
    const taken = this.#takenOf(element);
    if (!taken || taken === "none") return [];
    const kind = element.classes[taken === "second" ? 1 : 0] ?? element.classes[0];
    return element.views.flatMap((view) => {
      const mark = taken === "mean" ? view.mean ?? view.first ?? view.second : view[taken];
      return mark ? [{ observation_id: uuid7(), element_id: element.id, frame_index: frame, side: view.side, anchor_px: mark.anchor, end_px: mark.end, anchor_known: mark.anchor_known, end_known: mark.end_known, class_id: kind }] : [];
    });
  }

  /** What can be taken of an element.
   *
   * @param {ComparedElement} element
   * @returns {Taken[]}
   */
  #choices({ names, views }) {
    const [first, second] = names;
    const hasMean = views.some(({ mean }) => mean) && views.every(({ mean, first: mine, second: theirs }) => mean || !(mine && theirs));
    return [...first ? [/** @type {const} */ ("first")] : [], ...second ? [/** @type {const} */ ("second")] : [], ...hasMean ? [/** @type {const} */ ("mean")] : [], "none"];
  }

  /** What was decided; of labels that agree the mean.
   *
   * @param {ComparedElement} element
   * @returns {Taken | null}
   */
  #takenOf(element) {
    return this.taken.get(element.id) ?? (element.apart ? null : "mean");
  }

  /** Redraws; called whenever the state of the page changes. */
  show() {
    const { shown, cache } = this;
    byId("compared").hidden = !shown;
    byId("team-picture-box").hidden = Boolean(shown);
    if (!shown) return;
    cache.show("compared-names", [shown.people, shown.times, this.chosen, shown.elements.length], () => this.#names());
    cache.show("compared-elements", [shown, this.chosen, [...this.taken]], () => shown.elements.map((element) => this.#row(element)));
    this.surface.redraw();
  }

  /** @returns {Child[]} */
  #names() {
    const { shown, element } = this;
    if (!shown) return [];
    if (!shown.people[0]) return [el("p", { class: "dim", text: "There is one version of this frame: one person wrote it." })];
    if (!element) return [el("p", { class: "dim", text: shown.is_blind ? "Neither labelled anything here." : "Nothing in this frame differs." })];
    return shown.people.map((name, at) => el("div", {}, el("b", { text: element.names[at] ? name : `${name}: nothing` }), el("span", { class: "dim", text: ` ${shown.is_blind ? element.names[at] : time(shown.times[at])}` })));
  }

  /** @param {ComparedElement} element */
  #row(element) {
    const { shown, page } = this;
    const [first, second] = shown?.people ?? ["", ""];
    const taken = this.#takenOf(element);
    const words = { first, second, mean: "mean", none: "neither" };
    const keys = { first: "Y", second: "Shift Y", mean: "M", none: "X" };
    const buttons = !shown?.is_blind || element.id !== this.chosen ? [] : this.#choices(element).map((what) =>
      el("button", { class: "small", "aria-pressed": String(what === taken), onclick: () => this.take(what) }, `${words[what]} `, badge(page.keys, keys[what])));
    const px = element.views.map(({ px: found }) => found).filter((found) => found !== null);
    const said = element.apart || (px.length ? `within ${Math.max(...px).toFixed(1)} px` : "");
    return el("div", { class: "compared-element" },
      row({ chosen: element.id === this.chosen, onclick: () => { this.chosen = element.id; this.state.set({}); } },
        el("b", { text: element.names[0] || element.names[1] }),
        el("span", { class: "fill" }, element.apart ? el("span", { class: "warning", text: "◆ " }) : null, said),
        shown?.is_blind ? el("span", { class: taken ? "dim" : "warning", text: taken ? words[taken] : "decide" }) : null),
      buttons.length ? el("div", { class: "compared-choices" }, ...buttons) : null);
  }

  /** @param {number} frame */
  async #load(frame) {
    this.bitmaps.clear();
    this.trouble = "";
    for (const side of /** @type {Side[]} */ (["left", "right"])) {
      if (!this.known?.elements.some(({ views }) => views.some((view) => view.side === side))) continue;
      const { bitmap, message } = await this.page.pictures.get(frame, side);
      if (this.known?.frame !== frame) return;
      if (bitmap) this.bitmaps.set(side, bitmap);
      else this.trouble = message;
    }
    this.surface.redraw();
  }

  /**
   * @param {CanvasRenderingContext2D} context
   * @param {number} width
   * @param {number} height
   */
  #draw(context, width, height) {
    const view = this.element?.views.toSorted((a, b) => (b.px ?? 1e9) - (a.px ?? 1e9))[0];
    const bitmap = view && this.bitmaps.get(view.side);
    if (view && !bitmap) drawText(context, this.trouble || "Loading the image …", width / 2, height / 2, { align: "center" });
    if (!view || !bitmap) return;
    const kind = (/** @type {0 | 1} */ at) => this.state.classOf(this.element?.classes[at] ?? this.element?.classes[1 - at] ?? 0);
    drawVersions(context, width, height, bitmap, [{ mark: view.first, kind: kind(0) }, { mark: view.second, kind: kind(1) }]);
    drawText(context, `${view.side} image`, 6, height - 10);
  }
}

/** @param {string} text of a time, UTC */
const time = (text) => (text ? new Date(text).toLocaleString([], { month: "numeric", day: "numeric", hour: "numeric", minute: "2-digit" }) : "");
