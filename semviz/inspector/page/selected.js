// @ts-check
/* The tab "Selected": the selected detection, element or pair, and the labels behind it. */

import { byId, el, fixed } from "/static/dom.js";
import { classGlyph } from "/static/glyphs.js";
import { currentTheme } from "/static/theme.js";
import { KINDS } from "./decisions.js";

/** @typedef {import("/static/protocol").inspector.MatrixCell} MatrixCell */
/** @typedef {import("/static/protocol").inspector.ElementCard} ElementCard */
/** @typedef {import("/static/protocol").inspector.EndView} EndView */
/** @typedef {import("/static/protocol").inspector.MapDecision} MapDecision */
/** @typedef {import("/static/protocol").inspector.OriginView} OriginView */
/** @typedef {import("/static/protocol").inspector.OriginsEvent} OriginsEvent */
/** @typedef {import("/static/protocol").inspector.ResidualView} ResidualView */
/** @typedef {import("/static/protocol").inspector.SelectionCard} SelectionCard */
/** @typedef {import("/static/protocol").inspector.WriterView} WriterView */
/** @typedef {import("./main.js").Page} Page */

const HINT = "Nothing is selected. Click a detection in the image, a map element, or a cell of the matrix.";

export class SelectedCard {
  /** @param {Page} page */
  constructor(page) {
    this.page = page;
    /** @type {SelectionCard | null} */
    this.shown = null;
    /** @type {OriginsEvent | null} */
    this.origins = null;
    this.isNew = false; // its labels are not requested yet
    page.socket.on("selection", ({ card }) => this.showSelection(card));
    page.socket.on("origins", (event) => this.showOrigins(event));
    const parts = ["selected-head", "selected-actions", "selected-rest"];
    byId("selected-body").replaceChildren(...parts.map((id) => el("span", { id })));
  }

  showRun() {
    this.origins = null;
  }

  showTheme() {
    this.fill();
  }

  showTabs() {
    this.fill();
  }

  /** @param {SelectionCard | null} card */
  showSelection(card) {
    if (card?.element !== this.shown?.element) this.origins = null;
    this.shown = card;
    this.isNew = true;
    this.fill();
  }

  /** @param {OriginsEvent} origins */
  showOrigins(origins) {
    if (origins.element !== this.shown?.element) return;
    this.origins = origins;
    document.querySelector("#selected-origins")?.replaceChildren(...this.originParts());
  }

  /** Only while the tab is shown. */
  fill() {
    if (this.page.right.shown !== "selected") return;
    this.requestOrigins();
    byId("selected-actions").hidden = !this.shown;
    byId("selected-head").replaceChildren(...(this.shown ? this.headParts(this.shown) : [el("p", { class: "dim", text: HINT })]));
    byId("selected-rest").replaceChildren(...(this.shown ? this.restParts(this.shown) : []));
  }

  /** Once a selection: reading a label file may take a second. */
  requestOrigins() {
    if (this.isNew && (this.shown?.element ?? null) !== null) this.page.socket.send("get_origins");
    this.isNew = false;
  }

  /** @param {SelectionCard} card */
  headParts({ name, class_id: id, summary }) {
    const sentence = summary.filter(Boolean).join(" ");
    return [el("h3", {}, this.glyph(id), name), el("p", { class: "sentence", text: sentence })];
  }

  /** @param {SelectionCard} card */
  restParts({ name, observed, residuals, of_row: ofRow, of_column: ofColumn, mapped }) {
    const parts = [];
    if (residuals.length) parts.push(group(`Residual of ${residuals[0].pair}`, el("dl", {}, ...residuals.flatMap(residualRow))));
    const lists = [];
    if (ofRow.length) lists.push(group(`Candidates of #${observed}`, this.candidates(ofRow)));
    if (ofColumn.length) lists.push(group(`Candidates of ${name}`, this.candidates(ofColumn)));
    if (lists.length) parts.push(el("div", { class: "lists" }, ...lists));
    return mapped ? [...parts, ...this.mappedParts(mapped)] : parts;
  }

  /** @param {ElementCard} card */
  mappedParts({ place, meaning, existence, in_run: inRun, decisions }) {
    const parts = [
      group("Position", placeTable(place), el("p", { class: "faint", text: meaning })),
      ...(existence ? [group("Existence", el("p", { class: "dim", text: `${existence}, judged from its detections` }))] : []),
      group("In this run", rows(inRun)),
      el("div", { id: "selected-origins" }, ...this.originParts()),
    ];
    if (decisions.length) parts.push(group("Decisions of map building", ...decisions.map(decisionLine)));
    return parts;
  }

  /** @param {number} id */
  glyph(id) {
    const kind = this.page.store.run.classes.find((other) => other.id === id);
    return kind ? classGlyph(kind, currentTheme() === "light" ? kind.color_light : kind.color) : null;
  }

  /** Candidates with their probability as number and bar; a click selects the pair.
   *
   * @param {MatrixCell[]} cells
   */
  candidates(cells) {
    return el("ol", { class: "candidates" }, ...cells.map(({ name, observed, element, probability, rank, is_true: isTrue }) => {
      const isSelected = observed === this.shown?.observed && element === this.shown.element;
      const row = el("li", { "aria-current": isSelected, title: rank === 1 ? "Most likely" : `${rank - 1} more likely`, onclick: () => this.page.select({ observed, element }) },
        el("span", { class: "faint", text: rank }), el("span", { text: name }), el("span", { class: "faint", text: isTrue ? "true" : "" }),
        el("b", { text: fixed(probability, 3) }));
      row.style.setProperty("--share", `${100 * probability}%`);
      return row;
    }));
  }

  originParts() {
    if (!this.origins) return [group("Labels", el("p", { class: "faint", text: "Reading labels …" }))];
    const { entries, reason } = this.origins;
    if (!entries.length) return [group("Labels", el("p", { class: "faint", text: reason }))];
    return [group(entries.length > 1 ? `Labels of ${entries.length} label elements` : "Labels", ...entries.map((origin) => this.origin(origin)))];
  }

  /** @param {OriginView} origin */
  origin({ name, class_id: id, left, right, frames, others, writer, is_newer: isNewer }) {
    const perFrame = frames.map(([index, sides]) => `${index} ${sides}`).join(", ");
    const counts = `${left + right} labels: ${left} left, ${right} right, in ${frames.length} ${frames.length === 1 ? "frame" : "frames"}`;
    const more = others ? `; ${others} more unused` : "";
    return el("div", { class: "origin" },
      el("p", { title: `By frame: ${perFrame}` }, this.glyph(id), el("b", { text: name }), ` ${counts}${more}`),
      ...(writer ? [el("p", { class: "dim", text: writerLine(writer) })] : []),
      ...(isNewer ? [el("p", { class: "warning", text: "Edited after this map was built." })] : []));
  }
}

/**
 * @param {string} title
 * @param {...Node} children
 */
function group(title, ...children) {
  return el("section", {}, el("h4", { text: title }), ...children);
}

/** @param {[string, string][]} values */
function rows(values) {
  return el("dl", {}, ...values.flatMap(([label, value]) => [el("dt", { text: label }), el("dd", { text: value })]));
}

/** Length of the residual, and chi2 with its limit; or the reason for its absence.
 *
 * @param {ResidualView} residual
 */
function residualRow({ at, reason, px, across_px: acrossPx, along_px: alongPx, chi2, limit, fits }) {
  const name = el("dt", { text: at === "truth" ? "At the true pose" : "At the estimate" });
  if (reason) return [name, el("dd", { class: "faint", text: reason })];
  const along = alongPx === null ? "unknown along the pole" : `${fixed(Math.abs(alongPx), 1)} px along`;
  const test = `χ² ${fixed(chi2, 1)}, limit ${fixed(limit, 1)}`;
  return [name, el("dd", { title: `${fixed(Math.abs(acrossPx ?? 0), 1)} px across, ${along}` },
    `${fixed(px, 1)} px · `, el("span", { class: fits ? "" : "wrong", text: test }))];
}

/** @param {EndView[]} place */
function placeTable(place) {
  const head = ["1σ, m", "across", "along", "up", "distance"].map((text) => el("th", { text }));
  const body = place.map(({ end, known, sigma_m: sigmaM, distance_m: distanceM }) => el("tr", { title: known ? "" : "No label shows this end: its position along the pole is unknown" },
    el("td", { text: known ? end : `${end}, unseen` }), ...sigmaM.map((value) => el("td", { text: fixed(value, 3) })), el("td", { text: `${fixed(distanceM, 0)} m` })));
  return el("table", {}, el("thead", {}, el("tr", {}, ...head)), el("tbody", {}, ...body));
}

/** @param {MapDecision} decision */
function decisionLine({ kind, by, reason, names }) {
  return el("p", {}, el("b", { text: names.join(", ") }), ` ${KINDS.get(kind) ?? kind} by ${by === "human" ? "a person" : "map building"}: ${reason}`);
}

/** @param {WriterView} writer */
function writerLine({ author, origin, time, number, kind }) {
  const who = origin === "human" ? author : `software (${author})`;
  return `Last edited by ${who}, ${time.slice(0, 16).replace("T", " ")} UTC, operation ${number} (${kind})`;
}
