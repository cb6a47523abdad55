// @ts-check
/* Metrics and settings of A and B. */

import { byId, el } from "/static/dom.js";
import { changeMark } from "./marks.js";

/** @typedef {import("/static/protocol").inspector.ComparisonView} ComparisonView */
/** @typedef {import("/static/protocol").inspector.MetricRow} MetricRow */
/** @typedef {import("/static/protocol").inspector.SetupRow} SetupRow */
/** @typedef {import("../main.js").Page} Page */

/** @type {{worse: "broken", better: "fixed", same: null}} */
const MARK = { worse: "broken", better: "fixed", same: null };
const LABEL = { worse: "worse in B", better: "better in B", same: "" };

export class Numbers {
  /** `named` gets the name of a clicked metric.
   *
   * @param {Page} page
   * @param {(name: string) => void} named
   */
  constructor(page, named) {
    this.named = named;
    page.socket.on("comparison", ({ comparison }) => this.showComparison(comparison));
  }

  /** @param {ComparisonView} comparison */
  showComparison({ metrics, setups, notes, frames }) {
    byId("numbers-about").textContent = `${frames.length} frames in both`;
    byId("metric-table").replaceChildren(el("span"), el("span", { class: "dim", text: "A" }), el("span", { class: "dim", text: "B" }), el("span"),
      ...metrics.flatMap((metric) => this.metric(metric)));
    const different = setups.filter(({ base: a, other: b }) => a !== b);
    byId("setup-table").replaceChildren(...[...different, ...setups.filter((setup) => !different.includes(setup))].flatMap(setupRow));
    byId("compare-notes").replaceChildren(...notes.map((text) => el("p", { text: `${text[0].toUpperCase()}${text.slice(1)}.` })));
  }

  /** @param {MetricRow} metric */
  metric({ name, label, a, b, trend }) {
    const change = MARK[trend];
    const mark = change ? changeMark(change) : el("span");
    mark.setAttribute("aria-label", LABEL[trend]);
    const write = el("button", { class: "plain", title: `${name}: insert into a condition`, text: label, onclick: () => this.named(name) });
    return [write, el("span", { text: a }), el("b", { class: "value", text: b }), mark];
  }
}

/** @param {SetupRow} setup */
function setupRow({ what, base, other }) {
  const isSame = base === other;
  const text = isSame ? (other ? `same (${other})` : "same") : `${base} → ${other}`;
  return [el("dt", { text: what }), el("dd", { class: isSame ? "dim" : "strong", title: text, text })];
}
