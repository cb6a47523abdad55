// @ts-check
/* The tab "Map": decisions of map building, and findings of lint. */

import { byId, el } from "/static/dom.js";
import { classGlyph } from "/static/glyphs.js";
import { currentTheme } from "/static/theme.js";

/** @typedef {import("/static/protocol").inspector.DecidedElement} DecidedElement */
/** @typedef {import("/static/protocol").inspector.DecisionView} DecisionView */
/** @typedef {import("/static/protocol").inspector.DecisionsEvent} DecisionsEvent */
/** @typedef {import("./main.js").Page} Page */

/** Texts of the kinds of decisions. The kind of a finding is already a text. */
export const KINDS = new Map([["merge", "merged"], ["apart", "kept apart"], ["split", "split in two"], ["leave out", "left out"]]);

export class DecisionList {
  /** @param {Page} page */
  constructor(page) {
    this.page = page;
    /** @type {DecisionView[]} */
    this.entries = [];
    /** @type {string | null} */
    this.chosen = null; // key of the open entry
    /** @type {import("/static/protocol").inspector.EditBase | null} */
    this.base = null; // what this page has seen of the labels
    page.socket.on("decisions", (event) => this.showDecisions(event));
  }

  showRun() {
    this.chosen = null;
    this.page.socket.send("get_decisions");
  }

  /** @param {DecisionsEvent} event */
  showDecisions({ entries, note, seen }) {
    this.entries = entries;
    this.base = seen;
    const open = entries.filter(({ answers }) => answers.length).length;
    byId("decisions-open").textContent = open ? String(open) : "";
    byId("decisions-open").title = `${open} open`;
    byId("decisions-note").textContent = entries.length ? note : "No decisions of map building, and no findings of lint.";
    this.fill();
  }

  showTheme() {
    this.fill();
  }

  /** Requests findings, too, and updated decisions: another process may have answered some. */
  showTabs() {
    const { left, store, socket } = this.page;
    if (left.shown === "map" && store.isOpen) socket.send("get_decisions", { findings: true });
  }

  fill() {
    byId("decision-list").replaceChildren(...this.entries.map((entry) => this.row(entry)));
  }

  /** @param {string} key */
  choose(key) {
    this.chosen = key;
    this.page.socket.send("go_to_decision", { key });
    this.fill();
  }

  /** @param {DecisionView} entry */
  row(entry) {
    const { key, kind, reason, evidence, elements } = entry;
    const isChosen = key === this.chosen;
    const names = el("span", { class: "names" }, ...elements.map((element) => this.name(element)), KINDS.get(kind) ?? kind);
    const head = el("header", {}, names, this.state(entry));
    const more = isChosen ? [
      el("p", { text: reason }),
      el("dl", {}, ...evidence.flatMap(({ name, value }) => [el("dt", { text: name }), el("dd", { text: value })])),
      this.answers(entry),
    ] : [];
    const choose = () => { if (!isChosen) this.choose(key); };
    /** @param {KeyboardEvent} event */
    const pressed = (event) => { if (event.key === "Enter") choose(); };
    return el("li", { class: "decision", "aria-current": isChosen, tabindex: 0, onclick: choose, onkeydown: pressed }, head, ...more);
  }

  /** @param {DecisionView} entry */
  state({ answers, undo, by, severity }) {
    const text = severity ?? (undo ? "answered" : answers.length ? "open" : `by ${by}`);
    return el("span", { class: severity ? `by ${severity}` : "by", text });
  }

  /** @param {DecidedElement} element */
  name({ name, class_id: id, map_id: mapId }) {
    const kind = this.page.store.run.classes.find((other) => other.id === id);
    const color = kind && (currentTheme() === "light" ? kind.color_light : kind.color);
    const label = el("b", { title: mapId === null ? "not in the map" : "" }, kind ? classGlyph(kind, color) : null, name);
    if (color) label.style.color = color;
    return label;
  }

  /** @param {DecisionView} entry */
  answers({ key, answers, undo }) {
    const { socket } = this.page;
    /** @type {(text: string, send: () => void) => HTMLButtonElement} */
    const button = (text, send) => el("button", { class: "small", text, onclick: (/** @type {Event} */ event) => {
      event.stopPropagation();
      send();
    } });
    const options = answers.map(({ name, title }) => button(title, () => socket.send("answer_decision", { key, name, base: this.base })));
    if (!options.length && !undo) return "";
    return el("div", { class: "answers" }, ...options, undo ? button("Undo the answer", () => socket.send("undo_answer", { key, base: this.base })) : null);
  }
}
