// @ts-check
/* The list of changes of the map, by kind, and its filters. */

import { byId, el, fill } from "/static/dom.js";
import { VirtualList } from "/static/virtual_list.js";
import { changeMark } from "./change_marks.js";
import { KINDS, ORDER, decided, listRows, openSure } from "./model.js";

/** @typedef {import("/static/protocol").inspector.OverTimeView} OverTimeView */
/** @typedef {import("./model.js").Kind} Kind */
/** @typedef {import("./model.js").ListRow} ListRow */
/** @typedef {import("./model.js").Answers} Answers */
/** @typedef {import("./over_time.js").OverTime} OverTime */

const ROW_PX = 40;

export class ChangeList {
  /** @param {OverTime} view */
  constructor(view) {
    this.view = view;
    /** @type {Kind | null} */
    this.only = null;
    /** @type {ListRow[]} */
    this.rows = [];
    this.list = new VirtualList(byId("change-rows"), ROW_PX, (index) => this.row(this.rows[index]));
  }

  /** Shows only one kind of changes; null shows all.
   *
   * @param {Kind | null} only
   */
  filter(only) {
    this.only = only;
    this.view.fill();
  }

  /** The changes in the list, in its order. */
  get changes() {
    return this.rows.flatMap(({ change }) => (change ? [change] : []));
  }

  /**
   * @param {OverTimeView} found
   * @param {Answers} answers
   */
  show({ changes, elements, passes }, answers) {
    this.rows = listRows(changes, this.only);
    byId("change-list-about").textContent = changes.length ? `${changes.length} of ${elements.toLocaleString("en")} elements` : "";
    fill(byId("change-filters"), changes.length ? [this.chip(null, changes.length), ...ORDER.map((kind) => this.chip(kind, changes.filter((change) => change.kind === kind).length))] : []);
    byId("change-none").hidden = changes.length > 0;
    byId("change-none").textContent = `${elements.toLocaleString("en")} elements, ${passes.length} passes, no change.`;
    this.list.show(this.rows.length);
    const [done, sure] = [changes.filter(({ name }) => answers.has(name)).length, openSure(changes, answers).length];
    byId("change-done").textContent = changes.length ? `${done} of ${changes.length} decided` : "";
    byId("change-sure").hidden = !sure || !this.view.canDecide;
    fill(byId("change-sure"), [`Make ${sure} sure `, el("kbd", { text: "Shift" }), el("kbd", { text: "Enter" })]);
    this.mark();
  }

  mark() {
    this.list.mark(this.rows.findIndex(({ change }) => change !== null && change.name === this.view.selected));
  }

  /**
   * @param {Kind | null} kind
   * @param {number} count
   */
  chip(kind, count) {
    if (kind && !count) return null;
    return el("button", { class: "chip", "aria-pressed": this.only === kind, title: kind ? KINDS[kind].title : "All changes", onclick: () => this.filter(kind) },
      kind ? changeMark(kind) : el("span", { text: "All" }), el("span", { text: count }));
  }

  /** @param {ListRow} row */
  row({ kind, count, change }) {
    if (!change) return el("li", { class: "change-title" }, changeMark(kind), el("b", { text: KINDS[kind].title }), el("span", { class: "dim", text: count }));
    const word = decided(change, this.view.answers);
    return el("li", { class: "change-row", onclick: () => this.view.select(change.name) },
      this.view.glyph(change.class_id), el("b", { text: change.name }),
      el("span", { class: "exists", title: "Probability that it exists now", text: change.existence.toFixed(2) }),
      el("span", { class: word === "open" ? "faint" : "strong", text: word }),
      el("span", { class: "dim told", title: change.story, text: change.story }));
  }
}
