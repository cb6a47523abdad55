// @ts-check
// The question about a refused edit, beside the images: an edit of a label that somebody changed meanwhile shows both versions.
/** @import {Command} from "/static/keys.js" */
/** @import {Page} from "../main.js" */
/** @import {Version} from "../team/two_versions.js" */
/** @import {Side} from "../values.js" */
import { Surface } from "/static/canvas.js";
import { byId, el } from "/static/dom.js";
import { drawText } from "/static/glyphs.js";
import { find } from "./pending.js";
import { differs, drawVersions } from "../team/two_versions.js";
import { RenderCache, badge, header } from "../panels/widgets.js";

/** Where the panel is in each view. */
const HOMES = { images: ".right", filmstrip: "#filmstrip > .panel", tracks: "#track-side", team: "#team-frame-panel", poses: "#poses .pose-side", drive: ".drive-side" };
const ANSWERS = ["Y", "Shift Y"];
/** @type {Intl.DateTimeFormatOptions} */
const WHEN = { hour: "2-digit", minute: "2-digit", second: "2-digit" };

export class Conflict {
  /** @param {Page} page */
  constructor(page) {
    this.page = page;
    this.cache = new RenderCache(page.state);
    this.pictured = ""; // the image that is shown or was asked for
    /** @type {ImageBitmap | null} */
    this.bitmap = null;
    this.trouble = "";
    this.surface = new Surface(byId("conflict-picture", HTMLCanvasElement), (context, width, height) => this.#draw(context, width, height));
  }

  /** Commands for `Keys`: the views of the images answer with the keys of their questions.
   *
   * @returns {Command[]}
   */
  commands() {
    return ["tracks", "poses", "drive"].flatMap((view) => [false, true].map((shift) => (
      { key: "y", shift, view, group: "General", title: shift ? "Keep theirs" : "Keep mine", words: "conflict", run: () => void this.page.answer(shift ? 1 : 0) })));
  }

  /** Whether the other version has not come from the server yet. */
  get isOnItsWay() {
    const { question, labels } = this.page.state;
    return Boolean(question?.conflict && labels.operation < question.conflict.operation);
  }

  /** The label that both changed, as it is here and on disk; null if the question is of something else, or of another frame. */
  get versions() {
    const { state } = this.page;
    const { question, frame } = state;
    const edit = question?.entry.edit;
    if (!question?.conflict || !edit || !("observation_id" in edit) || question.entry.shown?.frame !== frame) return null;
    if (this.isOnItsWay) return null;
    const mine = find(state.elements, edit.observation_id), theirs = find(state.labels.frame?.elements ?? [], edit.observation_id);
    const one = mine ?? theirs;
    return one && { name: one.element.name, side: one.side, mine, theirs };
  }

  /** Shows what is asked; called whenever the state of the page changes. */
  show() {
    const { state } = this.page;
    const { question, view } = state;
    const isShown = question !== null && (view !== "images" || Boolean(question.conflict));
    document.body.classList.toggle("conflicting", isShown);
    byId("conflict").hidden = !isShown;
    if (!isShown) return;
    const home = document.querySelector(HOMES[view]);
    if (home && byId("conflict").parentElement !== home) home.prepend(byId("conflict"));
    const { versions, isOnItsWay } = this;
    byId("conflict-box").hidden = !versions;
    this.cache.show("conflict-text", [question.text, versions?.name, versions?.side, state.frame], () => this.#text(question));
    this.cache.show("conflict-versions", versions, () => (versions ? this.#about(question) : []));
    this.cache.show("conflict-answers", [question.text, question.entry.request, isOnItsWay], () => question.answers.map(({ title }, at) =>
      el("button", { class: "small", disabled: isOnItsWay ? "" : null, onclick: () => this.page.answer(at) }, `${title} `, ANSWERS[at] ? badge(this.page.keys, ANSWERS[at]) : null)));
    if (versions) this.#load(versions.side);
    this.surface.redraw();
  }

  /** @param {import("../values.js").Question} question */
  #text({ text, conflict, entry }) {
    const { versions, page } = this;
    const frame = entry.shown?.frame;
    const title = versions ? `Two versions of ${versions.name}` : "A question";
    const where = versions ? `frame ${frame}, ${versions.side}` : "";
    const goes = frame !== null && frame !== undefined && frame !== page.state.frame;
    return [
      header(title, where, el("span", { class: "warning", text: "◆" })),
      el("p", { text: conflict && versions ? `${conflict.author} changed ${versions.name} while you did.${versions.mine ? " Both stay in the history." : ""}` : text }),
      goes ? el("button", { class: "small", onclick: () => page.go(frame), text: `Show frame ${frame}` }) : null,
    ];
  }

  /** @param {import("../values.js").Question} question */
  #about({ conflict }) {
    const { versions } = this;
    if (!versions || !conflict) return [];
    const { mine, theirs } = versions;
    const what = !mine ? "deleted" : theirs ? differs(mine.observation, theirs.observation) || "the same" : "";
    return [
      el("p", {}, el("b", { text: "Mine" }), el("span", { class: "dim", text: what })),
      el("p", {}, el("b", { text: `Theirs, ${conflict.author}` }), el("span", { class: "dim", text: `${theirs ? "" : "deleted, "}${new Date(conflict.time).toLocaleTimeString([], WHEN)}` })),
    ];
  }

  /** @param {Side} side */
  async #load(side) {
    const pane = this.page.state.panes[side];
    const wanted = pane ? `${pane.frame}/${pane.side}` : "";
    if (!pane || wanted === this.pictured) return;
    this.pictured = wanted;
    this.bitmap = null;
    const { bitmap, message } = await this.page.pictures.get(pane.frame, pane.side);
    if (wanted !== this.pictured) return;
    this.bitmap = bitmap;
    this.trouble = message;
    if (!bitmap) this.pictured = ""; // asked for again when the page changes
    this.surface.redraw();
  }

  /**
   * @param {CanvasRenderingContext2D} context
   * @param {number} width
   * @param {number} height
   */
  #draw(context, width, height) {
    const { versions, bitmap } = this;
    if (!versions) return;
    if (!bitmap) {
      drawText(context, this.trouble || "Loading the image …", width / 2, height / 2, { align: "center" });
      return;
    }
    const version = (/** @type {import("../values.js").LocatedObservation | null} */ at) =>
      /** @type {Version} */ ({ mark: at?.observation ?? null, kind: this.page.state.classOf((at ?? versions.mine ?? versions.theirs)?.element.class_id ?? 0) });
    drawVersions(context, width, height, bitmap, [version(versions.mine), version(versions.theirs)]);
  }
}
