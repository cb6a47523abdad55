/* What was decided when the run's map was built and what looks odd in it. */

import { byId, el } from "/static/dom.js";
import { classGlyph } from "/static/glyphs.js";
import { currentTheme } from "/static/theme.js";

// a finding's kind is its rule, in words
export const SAID = { merge: "taken as one", apart: "kept apart", split: "split in two", "leave out": "left out" };

export class DecisionList {
  constructor(page) {
    this.page = page;
    this.entries = [];
    this.chosen = null; // key of the entry that is open
  }

  showRun(run) {
    this.run = run;
    this.chosen = null;
    this.page.socket.send({ verb: "decisions" });
  }

  showDecisions({ entries, note }) {
    this.entries = entries;
    const open = entries.filter(({ answers }) => answers.length).length;
    byId("decisions-open").textContent = open || "";
    byId("decisions-open").title = `${open} open`;
    byId("decisions-note").textContent = entries.length ? note : "Nothing was merged, split or left out in this map, and nothing looks odd in it.";
    this.fill();
  }

  showTheme() {
    this.fill();
  }

  /** With findings, and of decisions the newest: others may have answered some. */
  showTabs() {
    const { left, run, socket } = this.page;
    if (left.shown === "map" && run) socket.send({ verb: "decisions", findings: true });
  }

  fill() {
    byId("decision-list").replaceChildren(...this.entries.map((entry) => this.row(entry)));
  }

  choose(key) {
    this.chosen = key;
    this.page.socket.send({ verb: "see", key });
    this.fill();
  }

  row(entry) {
    const { key, kind, reason, evidence, elements } = entry;
    const isChosen = key === this.chosen;
    const names = el("span", { class: "names" }, ...elements.map((one) => this.name(one)), SAID[kind] ?? kind);
    const head = el("header", {}, names, this.state(entry));
    const more = isChosen ? [
      el("p", { text: reason }),
      el("dl", {}, ...evidence.flatMap(({ name, value }) => [el("dt", { text: name }), el("dd", { text: value })])),
      this.answers(entry),
    ] : [];
    const choose = () => { if (!isChosen) this.choose(key); };
    const pressed = (event) => { if (event.key === "Enter") choose(); };
    return el("li", { class: "decision", "aria-current": isChosen, tabindex: 0, onclick: choose, onkeydown: pressed }, head, ...more);
  }

  state({ answers, undo, by, severity }) {
    const text = severity ?? (undo ? "answered" : answers.length ? "open" : `by ${by}`);
    return el("span", { class: severity ? `by ${severity}` : "by", text });
  }

  name({ name, class: id, map_id }) {
    const one = this.run.classes.find((other) => other.id === id);
    const color = one && (currentTheme() === "light" ? one.colorLight : one.color);
    const label = el("b", { title: map_id === null ? "not in the map" : "" }, one ? classGlyph(one, color) : null, name);
    if (color) label.style.color = color;
    return label;
  }

  answers({ key, answers, undo }) {
    const button = (text, message) => el("button", { class: "small", text, onclick: (event) => {
      event.stopPropagation();
      this.page.socket.send({ key, findings: true, ...message });
    } });
    const said = answers.map(({ name, title }) => button(title, { verb: "answer", name }));
    if (!said.length && !undo) return "";
    return el("div", { class: "answers" }, ...said, undo ? button("Undo the answer", { verb: "undo" }) : null);
  }
}
