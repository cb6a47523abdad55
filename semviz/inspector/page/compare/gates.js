/* Conditions of `semviz compare --fail-if`, judged by the same code as the command's. */

import { byId, el } from "/static/dom.js";
import { statusMark } from "/static/glyphs.js";

const STORED = "semviz.gates";
const EXAMPLES = ["median_rte_m > 1.05*base", "broken > fixed"];
const TYPED_MS = 150;

export class Gates {
  constructor(page) {
    this.page = page;
    this.texts = JSON.parse(localStorage.getItem(STORED) ?? "null") ?? EXAMPLES;
    this.judged = [];
    this.input = byId("gate-input");
    this.input.addEventListener("input", () => { clearTimeout(this.typing); this.typing = setTimeout(() => this.ask(), TYPED_MS); });
    this.input.addEventListener("keydown", (event) => {
      if (event.key === "Escape") this.input.blur();
    });
    byId("gate-form").addEventListener("submit", (event) => { event.preventDefault(); this.add(); });
    byId("copy-gate").addEventListener("click", () => this.copy());
  }

  showComparison({ command, names }) {
    this.command = command;
    byId("gate-names").replaceChildren(...names.map((value) => el("option", { value })));
    this.ask();
  }

  /** Has all conditions judged, and what is being typed. */
  ask() {
    this.page.socket.send({ verb: "gates", texts: [...this.texts, this.typed].filter(Boolean) });
  }

  get typed() {
    return this.input.value.trim();
  }

  showGates(judged) {
    const kept = judged.slice(0, this.texts.length);
    const failed = kept.filter(({ fails }) => fails).length;
    const untold = kept.filter(({ fails }) => fails === null).length;
    const told = `${failed} of ${kept.length} failed${untold ? `, ${untold} cannot be told` : ""}`;
    byId("gates-about").textContent = kept.length ? told : "none yet";
    byId("gate-list").replaceChildren(...kept.map((one, place) => this.row(one, place)));
    const draft = judged[this.texts.length];
    const said = draft && (draft.fails === null ? draft.said : `${draft.said}: ${draft.fails ? "fails" : "passes"}; Enter keeps it`);
    byId("gate-said").textContent = said ?? "";
    byId("gate-said").classList.toggle("warning", draft?.fails === null);
    this.draft = draft;
  }

  row({ text, fails, said }, place) {
    const mark = statusMark(fails === null ? "ambiguous" : fails ? "cannot" : "ok");
    mark.setAttribute("aria-label", fails === null ? "cannot be told" : fails ? "fails" : "passes");
    return el("li", { title: said }, mark, el("code", { text }), el("button", { class: "plain", "aria-label": `Remove ${text}`, title: "Remove", text: "×", onclick: () => this.keep(this.texts.filter((_, other) => other !== place)) }),
      el("span", { class: fails === null ? "warning" : "dim", text: said }));
  }

  /** A metric's name, where the cursor is. */
  write(name) {
    this.input.setRangeText(name, this.input.selectionStart, this.input.selectionEnd, "end");
    this.input.focus();
    this.ask();
  }

  /** What was typed becomes one of the conditions, unless it is none. */
  add() {
    if (!this.draft || this.draft.fails === null || this.draft.text !== this.typed.replace(/\s+/g, " ")) return;
    this.input.value = "";
    this.keep([...this.texts, this.draft.text]);
  }

  keep(texts) {
    this.texts = texts;
    localStorage.setItem(STORED, JSON.stringify(texts));
    this.ask();
  }

  async copy() {
    const conditions = this.texts.map((text) => ` --fail-if '${text}'`);
    await navigator.clipboard.writeText(this.command + conditions.join(""));
    byId("copy-gate").textContent = "Copied";
    setTimeout(() => { byId("copy-gate").textContent = "Copy command"; }, 1200);
  }
}
