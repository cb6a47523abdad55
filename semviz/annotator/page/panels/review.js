// @ts-check
// Review of the last map: open decisions and lint findings.
/** @import {annotator} from "/static/protocol" */
/** @import {Keys} from "/static/keys.js" */
/** @import {Page} from "../main.js" */
/** @import {State} from "../state.js" */
/** @import {OpenReview} from "../values.js" */
import { byId, el } from "/static/dom.js";
import { classGlyph } from "/static/glyphs.js";
import { acceptedTracks } from "../proposals.js";
import { RenderCache, badge, capital, header } from "./widgets.js";

/** @typedef {annotator.ReviewEntry["list_name"]} ListName */

/** The lists by the server's names.
 *
 * @type {Record<ListName, {title: string, noun: string, none: string}>} */
export const REVIEWS = {
  tracks: { title: "Open tracks", noun: "track", none: "No track is open." },
  decisions: { title: "Map decisions", noun: "decision", none: "No decision is open." },
  findings: { title: "Lint findings", noun: "finding", none: "The last map has no findings." },
};
/** @type {Record<string, string>} */
const QUESTIONS = { track: "One landmark?", merge: "Same landmark?", split: "Different landmarks?", apart: "Different landmarks?", "leave out": "Leave out?" };
const KEYS = ["Y", "Shift Y"]; // for the first two answers

/** Commands for `Keys`.
 *
 * @param {Review} review
 * @param {Pick<Page, "answer">} page
 * @returns {import("/static/keys.js").Command[]}
 */
export function reviewCommands(review, page) {
  const group = "Map";
  return [
    { key: "y", group, title: "First answer: agree, mine", run: () => page.answer(0) || review.answer(0) },
    { key: "y", shift: true, group, title: "Second answer: disagree", run: () => page.answer(1) || review.answer(1) },
    { key: "m", shift: true, group, title: "Build the map; again: stop", run: () => review.build() },
  ];
}

export class Review {
  /**
   * @param {State} state
   * @param {Keys} keys
   * @param {Pick<Page, "ask" | "socket" | "submit" | "go" | "select" | "notify" | "images">} page
   */
  constructor(state, keys, page) {
    this.state = state;
    this.keys = keys;
    this.page = page;
    this.cache = new RenderCache(state);
    this.requestedFor = ""; // the labels and map of the last request
    this.answered = ""; // key of the entry answered last
    this.failure = "";
    byId("build").addEventListener("click", () => this.build());
  }

  /** Opens a list, or steps through the open one.
   *
   * @param {ListName} list
   * @param {-1 | 0 | 1} by
   */
  step(list, by) {
    if (list !== "tracks" && this.state.labels.map.built === null) {
      this.page.notify("No map yet: press Build map, or run semviz map build.");
      return;
    }
    const { review } = this.state;
    if (!this.state.connected) this.page.notify("Offline: the list opens when the server is back.", "wrong");
    if (review?.list_name === list) this.#request(list, review.entry.key, review.place, by);
    else this.#request(list, null, 0, 0);
  }

  /** Opens an entry of a list by its key.
   *
   * @param {ListName} list
   * @param {string} key
   */
  open(list, key) {
    this.#request(list, key, 0, 0);
  }

  /** @param {number} place */
  answer(place) {
    const { review, pending } = this.state;
    const answer = review && this.#answers(review)[place];
    if (!review || !answer || (this.answered === review.entry.key && pending.length)) return; // pressed twice
    this.answered = review.entry.key;
    this.page.submit(answer.edit); // once it is saved, the next entry is requested
  }

  /** The answers to an entry, and their edits.
   *
   * @param {OpenReview} review
   * @returns {{name: string, title: string, edit: import("../values.js").Edit}[]}
   */
  #answers({ list_name: list, entry }) {
    if (list !== "tracks") return entry.answers;
    return [
      { name: "accept", title: "Accept", edit: acceptedTracks(this.state, [entry.key]) },
      { name: "reject", title: "Reject", edit: { kind: "reject tracks", track_ids: [entry.key] } },
    ];
  }

  /** Builds the map, or stops a running build. */
  build() {
    this.page.ask(this.state.labels.map.building === null ? "build_map" : "stop_map_build", {});
  }

  /** Closes the open entry. Returns whether there was one. */
  close() {
    const wasOpen = Boolean(this.state.review);
    if (wasOpen) {
      this.state.set({ review: null });
      this.page.socket.send("close_review", {});
    }
    return wasOpen;
  }

  /** Shows the server's answer. A new entry leads to its frame; an updated one does not.
   *
   * @param {annotator.ReviewEntry | null} review
   */
  received(review) {
    if (!review) return;
    const { entry, list_name: list } = review;
    const before = this.state.review;
    if (!entry) {
      this.state.set({ review: null });
      if (list === "tracks" && before) return; // the message about the last one stays
      this.page.notify(`${REVIEWS[list].none}${this.#isDue() ? " Press Build map to apply your answers." : ""}`);
      return;
    }
    this.state.set({ review: { ...review, entry } });
    if (before?.list_name === list && before.entry.key === entry.key) return;
    this.page.images.fit();
    if (entry.frame !== null) this.page.go(entry.frame);
    this.page.select(list === "decisions" ? null : entry.elements[0]?.id ?? null);
  }

  show() {
    const { labels, review, theme } = this.state;
    const { map, operation } = labels;
    const now = JSON.stringify([operation, map]);
    if (review && this.requestedFor !== now) this.#request(review.list_name, review.entry.key, review.place, 0);
    if (map.failure && map.failure !== this.failure) this.page.notify(map.failure, "wrong");
    this.failure = map.failure;
    this.#showBuild(map);
    document.body.classList.toggle("reviewing", Boolean(review));
    byId("review").hidden = !review;
    const { sure_tracks: sure } = map;
    if (review) this.cache.show("review", [review, this.state.frame, theme, sure, this.state.corrected], () => this.#card(review));
  }

  /**
   * @param {ListName} list
   * @param {string | null} key
   * @param {number} place
   * @param {-1 | 0 | 1} by
   */
  #request(list, key, place, by) {
    const { map, operation } = this.state.labels;
    this.requestedFor = JSON.stringify([operation, map]);
    this.page.socket.send("show_review", { list_name: list, key, place, by });
  }

  /** Whether the map is older than the labels. */
  #isDue() {
    const { map, operation } = this.state.labels;
    return operation > 0 && map.built !== operation;
  }

  /** Updates the build button; it is highlighted if labels have changed since the last build.
   *
   * @param {annotator.MapSummary} map
   */
  #showBuild(map) {
    const node = byId("build");
    node.textContent = map.building === null ? "Build map" : `Stop, ${map.building.match(/\d+ %/)?.[0] ?? "0 %"}`;
    node.classList.toggle("due", map.building === null && this.#isDue());
    const present = map.built === null ? "There is no map yet" : `The map contains the labels up to operation ${map.built}`;
    node.title = map.building === null ? present : `Building the map: ${map.building}`;
  }

  /** @param {OpenReview} review */
  #card(review) {
    const { list_name: list, place, count, entry } = review;
    const { kind, severity, reason, evidence, elements, about } = entry;
    const answers = this.#answers(review);
    const title = QUESTIONS[kind] ?? capital(kind);
    const chip = severity ? el("span", { class: `push chip ${severity}`, text: severity }) : null;
    return [
      header(title, `${REVIEWS[list].noun} ${place + 1} of ${count}`, null, chip),
      el("div", { class: "seen-list" }, ...elements.map((element) => this.#element(element, answers))),
      about.length ? el("p", { class: "seen" }, "in question", ...this.#frames(about)) : null,
      el("p", { class: "reason", text: reason }),
      el("dl", { class: "evidence" }, ...evidence.flatMap(({ name, value }) => [el("dt", { text: name }), el("dd", { text: value })])),
      answers.length ? el("div", { class: "buttons" }, ...answers.slice(0, KEYS.length).map((answer, index) => this.#answer(answer, index))) : null,
      list === "tracks" ? this.#sure() : null,
    ];
  }

  /** The button that accepts all sure tracks; null if there is none. */
  #sure() {
    const { sure_tracks: sure } = this.state.labels.map;
    if (!sure) return null;
    const title = "Seen in 3 frames or more, with a residual of 2 px at most, and scores that leave little doubt";
    const run = () => this.page.submit({ kind: "accept sure tracks", count: sure });
    return el("div", { class: "buttons" }, el("button", { class: "small", title, onclick: run }, `Accept ${sure} sure ${sure === 1 ? "track" : "tracks"}`, badge(this.keys, "Shift A")));
  }

  /** The line of one element; it has a button if an answer excludes only this element.
   *
   * @param {annotator.EntryElement} element
   * @param {Pick<annotator.AnswerView, "name" | "title">[]} answers
   */
  #element({ id, number, name, class_id: classId, frames }, answers) {
    const other = answers.findIndex((answer) => answer.name === `not ${number}`);
    const elementClass = classId === null ? null : this.state.classOf(classId);
    const glyph = elementClass && classGlyph(elementClass, this.state.colorOf(elementClass));
    const label = el("b", { text: name });
    if (elementClass) label.style.color = this.state.colorOf(elementClass);
    return el("p", { class: "seen" }, glyph, id ? el("button", { class: "small", onclick: () => this.page.select(id) }, label) : label, ...this.#frames(frames),
      other < 0 ? null : el("button", { class: "push small", title: answers[other].title, onclick: () => this.answer(other), text: "exclude" }));
  }

  /** Buttons that lead to frames.
   *
   * @param {number[]} frames
   */
  #frames(frames) {
    return frames.map((frame) => el("button", {
      class: frame === this.state.frame ? "small frame chosen" : "small frame", title: `To frame ${frame}`,
      onclick: () => this.page.go(frame), text: frame,
    }));
  }

  /**
   * @param {Pick<annotator.AnswerView, "title">} answer
   * @param {number} index
   */
  #answer({ title }, index) {
    return el("button", { class: "small", onclick: () => this.answer(index) }, title, KEYS[index] ? badge(this.keys, KEYS[index]) : null);
  }
}
