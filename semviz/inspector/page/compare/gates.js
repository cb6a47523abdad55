// @ts-check
/* Conditions of `semviz compare --fail-if`, checked by the command's own code. */

import { byId, el } from "/static/dom.js";
import { statusMark } from "/static/glyphs.js";

/** @typedef {import("/static/protocol").inspector.ComparisonView} ComparisonView */
/** @typedef {import("/static/protocol").inspector.GateView} GateView */
/** @typedef {import("../main.js").Page} Page */

const STORED = "semviz.gates";
const EXAMPLES = ["median_rte_m > 1.05*base", "broken > fixed"];
const TYPING_DELAY_MS = 150;

export class Gates {
  /** @param {Page} page */
  constructor(page) {
    this.page = page;
    /** @type {string[]} */
    this.texts = JSON.parse(localStorage.getItem(STORED) ?? "null") ?? EXAMPLES;
    /** @type {GateView | undefined} */
    this.draft = undefined; // the condition being typed
    this.command = "";
    this.input = byId("gate-input", HTMLInputElement);
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.typing = undefined;
    page.socket.on("comparison", ({ comparison }) => this.showComparison(comparison));
    page.socket.on("gates", ({ gates }) => this.showGates(gates));
    this.input.addEventListener("input", () => { clearTimeout(this.typing); this.typing = setTimeout(() => this.check(), TYPING_DELAY_MS); });
    this.input.addEventListener("keydown", (event) => {
      if (event.key === "Escape") this.input.blur();
    });
    byId("gate-form").addEventListener("submit", (event) => { event.preventDefault(); this.add(); });
    byId("copy-gate").addEventListener("click", () => this.copy());
  }

  /** @param {ComparisonView} comparison */
  showComparison({ command, names }) {
    this.command = command;
    byId("gate-names").replaceChildren(...names.map((value) => el("option", { value })));
    this.check();
  }

  /** Requests a check of all conditions, including the one being typed. */
  check() {
    this.page.socket.send("check_gates", { conditions: [...this.texts, this.typed].filter(Boolean) });
  }

  get typed() {
    return this.input.value.trim();
  }

  /** @param {GateView[]} gates */
  showGates(gates) {
    const kept = gates.slice(0, this.texts.length);
    const failed = kept.filter(({ fails }) => fails).length;
    const unknown = kept.filter(({ fails }) => fails === null).length;
    const about = `${failed} of ${kept.length} failed${unknown ? `, ${unknown} unknown` : ""}`;
    byId("gates-about").textContent = kept.length ? about : "no conditions";
    byId("gate-list").replaceChildren(...kept.map((gate, place) => this.row(gate, place)));
    const draft = gates.at(this.texts.length);
    const status = draft && (draft.fails === null ? draft.values : `${draft.values}: ${draft.fails ? "fails" : "passes"}; Enter adds it`);
    byId("gate-said").textContent = status ?? "";
    byId("gate-said").classList.toggle("warning", draft?.fails === null);
    this.draft = draft;
  }

  /**
   * @param {GateView} gate
   * @param {number} place
   */
  row({ text, fails, values }, place) {
    const mark = statusMark(fails === null ? "ambiguous" : fails ? "cannot" : "ok");
    mark.setAttribute("aria-label", fails === null ? "unknown" : fails ? "fails" : "passes");
    return el("li", { title: values }, mark, el("code", { text }), el("button", { class: "plain", "aria-label": `Remove ${text}`, title: "Remove", text: "×", onclick: () => this.keep(this.texts.filter((_, other) => other !== place)) }),
      el("span", { class: fails === null ? "warning" : "dim", text: values }));
  }

  /** Inserts a metric's name at the cursor.
   *
   * @param {string} name
   */
  write(name) {
    const { input } = this;
    input.setRangeText(name, input.selectionStart ?? 0, input.selectionEnd ?? 0, "end");
    this.input.focus();
    this.check();
  }

  /** Adds the typed condition, if it is valid. */
  add() {
    if (!this.draft || this.draft.fails === null || this.draft.text !== this.typed.replace(/\s+/g, " ")) return;
    this.input.value = "";
    this.keep([...this.texts, this.draft.text]);
  }

  /** @param {string[]} texts */
  keep(texts) {
    this.texts = texts;
    localStorage.setItem(STORED, JSON.stringify(texts));
    this.check();
  }

  async copy() {
    const conditions = this.texts.map((text) => ` --fail-if '${text}'`);
    await navigator.clipboard.writeText(this.command + conditions.join(""));
    byId("copy-gate").textContent = "Copied";
    setTimeout(() => { byId("copy-gate").textContent = "Copy command"; }, 1200);
  }
}
