// @ts-check
/* The card of a change: why the passes think so, pictures of then and now, and the answers. */

import { byId, el, fill } from "/static/dom.js";
import { strokeCased, traceRing } from "/static/glyphs.js";
import { ImageCache } from "../image/image_cache.js";
import { changeMark } from "./change_marks.js";
import { KINDS, decided, shortDate } from "./model.js";

/** @typedef {import("/static/protocol").inspector.OverTimeChange} OverTimeChange */
/** @typedef {import("/static/protocol").inspector.PassShot} PassShot */
/** @typedef {import("/static/canvas.js").Point} Point */
/** @typedef {import("./over_time.js").OverTime} OverTime */

const LEAST_PX = 130; // of the image around an element
const ACCENT = "#4DABF7";

export class ChangeCard {
  /** @param {OverTime} view */
  constructor(view) {
    this.view = view;
    /** @type {Map<string, ImageCache>} */
    this.images = new Map();
    this.shown = "";
  }

  /** @param {OverTimeChange | null} change */
  show(change) {
    const body = byId("change-card");
    byId("change-card-about").textContent = change ? `exists ${change.existence.toFixed(2)}` : "";
    fill(byId("change-card-name"), change ? [this.view.glyph(change.class_id), change.name] : ["Change"]);
    if (!change) {
      this.shown = "";
      fill(body, [el("p", { class: "dim", text: this.view.found?.changes.length ? "Nothing is selected. Click a change in the list, the map or the table." : "" })]);
      return;
    }
    if (change.name !== this.shown) {
      fill(body, [el("div", { id: "change-why" }), el("div", { class: "shots" }, this.shot(change.before, "before"), this.shot(change.after, "after")), el("dl", {}, ...change.facts.flatMap(({ name, value }) => [el("dt", { text: name }), el("dd", { text: value })])), el("div", { id: "change-answers" })]);
    }
    this.shown = change.name;
    fill(byId("change-why"), [el("h3", {}, changeMark(change.kind), change.title), el("p", { text: change.sentence })]);
    fill(byId("change-answers"), this.answers(change));
  }

  /** @param {OverTimeChange} change */
  answers(change) {
    const { view } = this;
    const found = view.answers.get(change.name);
    /** @type {(text: string, key: string, answer: "make" | "keep" | "label", run: () => void) => HTMLElement} */
    const button = (text, key, answer, run) => el("button", { class: "small", disabled: view.canDecide ? null : "", "aria-pressed": found?.answer === answer, onclick: run }, `${text} `, el("kbd", { text: key }));
    const isAsked = found?.answer === "label";
    return [
      el("div", { class: "buttons" },
        button(KINDS[change.kind].make, "Del", "make", () => view.decide("make")),
        button(change.kind === "new" ? "Leave out" : "Keep", "Enter", "keep", () => view.decide("keep")),
        button(isAsked ? "Open in annotate" : "Ask for a label", "O", "label", () => view.label())),
      el("p", { class: "dim" }, found ? `${decided(change, view.answers)}, decided by ${found.author} on ${shortDate(found.time.slice(0, 10))}${found.label ? `: ${found.label}` : ""}.` : view.canDecide ? "Open." : "",
        found && view.canUndo ? el("button", { class: "small plain", onclick: () => view.undo() }, "Undo ", el("kbd", { text: "Ctrl" }), el("kbd", { text: "Z" })) : null),
    ];
  }

  /** A picture that leads to its frame.
   *
   * @param {PassShot | null} shot
   * @param {"before" | "after"} when
   */
  shot(shot, when) {
    if (!shot) return el("figure", {}, el("div", { class: "none faint", text: when === "before" ? "No pass before had it in view." : "No later pass had it in view." }));
    const canvas = el("canvas", { width: 300, height: 210 });
    const reason = el("span", { class: "none faint" });
    const date = shot.date ? `${shortDate(shot.date)}, ` : "";
    this.paint(shot, canvas, reason);
    return el("figure", {},
      el("button", { class: "picture", title: `Show frame ${shot.frame} of ${shot.run}`, onclick: () => this.view.goTo(when === "after") }, canvas, reason),
      el("figcaption", {}, el("span", { text: `${date}${shot.run}` }), el("span", { class: "dim", text: `frame ${shot.frame}, ${shot.is_seen ? "detected" : "not detected"}` })));
  }

  /**
   * @param {PassShot} shot
   * @param {HTMLCanvasElement} canvas
   * @param {HTMLElement} reason shows why there is no image
   */
  async paint(shot, canvas, reason) {
    let cache = this.images.get(shot.run);
    if (!cache) {
      cache = new ImageCache();
      cache.open({ name: shot.run, created: "", frames: [] });
      this.images.set(shot.run, cache);
    }
    const { bitmap, reason: why } = await cache.get(shot.position, "left");
    reason.textContent = bitmap ? "" : why;
    const context = canvas.getContext("2d");
    if (bitmap && context && shot.ends.length) drawCrop(context, bitmap, shot);
  }
}

/** The image around an element, with a ring around it: dashed if it is not detected.
 *
 * @param {CanvasRenderingContext2D} context
 * @param {ImageBitmap} bitmap
 * @param {PassShot} shot
 */
function drawCrop(context, bitmap, { ends, is_seen: isSeen }) {
  const { width, height } = context.canvas;
  const [first, last] = [ends[0], ends[ends.length - 1]];
  const length = Math.hypot(first[0] - last[0], first[1] - last[1]);
  const size = Math.min(Math.max(LEAST_PX, 1.4 * length), bitmap.height);
  const scale = height / size;
  const middle = [(first[0] + last[0]) / 2, (first[1] + last[1]) / 2];
  const left = Math.min(Math.max(middle[0] - width / scale / 2, 0), bitmap.width - width / scale);
  const top = Math.min(Math.max(middle[1] - size / 2, 0), bitmap.height - size);
  context.drawImage(bitmap, left, top, width / scale, size, 0, 0, width, height);
  const screen = (/** @type {Point} */ [u, v]) => /** @type {Point} */ ([scale * (u + 0.5 - left), scale * (v + 0.5 - top)]);
  traceRing(context, screen(first), screen(last), 16);
  strokeCased(context, ACCENT, 3, isSeen ? [] : [8, 6]);
}
