/* A and B in numbers, and what they were made with. */

import { byId, el } from "/static/dom.js";
import { changeMark } from "./marks.js";

const MARK = { worse: "broken", better: "fixed" };
const SAID = { worse: "worse in B", better: "better in B" };

export class Numbers {
  /** `named(metric)` is called with the name of a row that was clicked. */
  constructor(named) {
    this.named = named;
  }

  showComparison({ metrics, setups, notes, frames }) {
    byId("numbers-about").textContent = `${frames.length} frames in both`;
    byId("metric-table").replaceChildren(el("span"), el("span", { class: "dim", text: "A" }), el("span", { class: "dim", text: "B" }), el("span"),
      ...metrics.flatMap((one) => this.metric(one)));
    const differ = setups.filter(({ base: a, other: b }) => a !== b);
    byId("setup-table").replaceChildren(...[...differ, ...setups.filter((one) => !differ.includes(one))].flatMap(setupRow));
    byId("compare-notes").replaceChildren(...notes.map((text) => el("p", { text: `${text[0].toUpperCase()}${text.slice(1)}.` })));
  }

  metric({ name, label, a, b, trend }) {
    const mark = MARK[trend] ? changeMark(MARK[trend]) : el("span");
    mark.setAttribute("aria-label", SAID[trend] ?? "");
    const write = el("button", { class: "plain", title: `${name}: write it into a condition`, text: label, onclick: () => this.named(name) });
    return [write, el("span", { text: a }), el("b", { class: "value", text: b }), mark];
  }
}

function setupRow({ what, base, other }) {
  const isSame = base === other;
  const text = isSame ? (other ? `same (${other})` : "same") : `${base} → ${other}`;
  return [el("dt", { text: what }), el("dd", { class: isSame ? "dim" : "strong", title: text, text })];
}
