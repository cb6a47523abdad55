/* The tab "Selected": what is known of the selected detection, element or pair, and where it comes from. */

import { byId, el, fixed } from "/static/dom.js";
import { classGlyph } from "/static/glyphs.js";
import { currentTheme } from "/static/theme.js";
import { SAID } from "./decisions.js";

const HINT = "Nothing is selected. Click a detection in the image, an element in the map, or a cell of the matrix.";

export class SelectedCard {
  constructor(page) {
    this.page = page;
    this.shown = null; // what the server said of the selection
    this.origins = null;
    this.isNew = false; // not asked for its labels yet
    const parts = ["selected-head", "selected-actions", "selected-rest"];
    byId("selected-body").replaceChildren(...parts.map((id) => el("span", { id })));
  }

  showRun(run) {
    this.run = run;
    this.origins = null;
  }

  showTheme() {
    this.fill();
  }

  showTabs() {
    this.fill();
  }

  showSelected(selected) {
    if (selected?.element !== this.shown?.element) this.origins = null;
    this.shown = selected;
    this.isNew = true;
    this.fill();
  }

  showOrigins(origins) {
    if (origins.element !== this.shown?.element) return;
    this.origins = origins;
    byId("selected-origins")?.replaceChildren(...this.originParts());
  }

  /** Only while it is seen. */
  fill() {
    if (this.page.right.shown !== "selected") return;
    this.askForOrigins();
    byId("selected-actions").hidden = !this.shown;
    byId("selected-head").replaceChildren(...(this.shown ? this.headParts(this.shown) : [el("p", { class: "dim", text: HINT })]));
    byId("selected-rest").replaceChildren(...(this.shown ? this.restParts(this.shown) : []));
  }

  /** Once for what was told: a label file may take a second to read. */
  askForOrigins() {
    if (this.isNew && (this.shown?.element ?? null) !== null) this.page.socket.send({ verb: "origins" });
    this.isNew = false;
  }

  headParts({ name, class: id, said }) {
    const sentence = said.filter(Boolean).join(" ");
    return [el("h3", {}, this.glyph(id), name), el("p", { class: "sentence", text: sentence })];
  }

  restParts({ name, observed, element, residuals, ofRow = [], ofColumn = [], place, meaning, inRun, decisions }) {
    const parts = [];
    if (residuals.length) parts.push(group(`Residual of ${residuals[0].pair}`, el("dl", {}, ...residuals.flatMap(residualRow))));
    const lists = [];
    if (ofRow.length) lists.push(group(`#${observed} may be`, this.candidates(ofRow)));
    if (ofColumn.length) lists.push(group(`${name} may be`, this.candidates(ofColumn)));
    if (lists.length) parts.push(el("div", { class: "lists" }, ...lists));
    if (element === null) return parts;
    parts.push(group("Its place", placeTable(place), el("p", { class: "faint", text: meaning })));
    parts.push(group("In this run", rows(inRun)));
    parts.push(el("div", { id: "selected-origins" }, ...this.originParts()));
    if (decisions.length) parts.push(group("Decided for the map", ...decisions.map(decisionLine)));
    return parts;
  }

  glyph(id) {
    const one = this.run.classes.find((other) => other.id === id);
    return one ? classGlyph(one, currentTheme() === "light" ? one.colorLight : one.color) : null;
  }

  /** Candidates with their probability, in numbers and as a bar; a click selects the pair. */
  candidates(listed) {
    return el("ol", { class: "candidates" }, ...listed.map(({ name, observed, element, probability, rank, isTrue }) => {
      const isSelected = observed === this.shown.observed && element === this.shown.element;
      const row = el("li", { "aria-current": isSelected, title: rank === 1 ? "The likeliest" : `${rank - 1} are likelier`, onclick: () => this.page.select({ observed, element }) },
        el("span", { class: "faint", text: rank }), el("span", { text: name }), el("span", { class: "faint", text: isTrue ? "true" : "" }),
        el("b", { text: fixed(probability, 3) }));
      row.style.setProperty("--share", `${100 * probability}%`);
      return row;
    }));
  }

  originParts() {
    if (!this.origins) return [group("Its labels", el("p", { class: "faint", text: "Reading the label file …" }))];
    const { entries, reason } = this.origins;
    if (!entries.length) return [group("Its labels", el("p", { class: "faint", text: reason }))];
    return [group(entries.length > 1 ? `Its labels, of ${entries.length} label elements` : "Its labels", ...entries.map((one) => this.origin(one)))];
  }

  origin({ name, class: id, left, right, frames, others, writer, isNewer }) {
    const perFrame = frames.map(([index, sides]) => `${index} ${sides}`).join(", ");
    const counts = `${left + right} labels: ${left} left, ${right} right, in ${frames.length} ${frames.length === 1 ? "frame" : "frames"}`;
    const more = others ? `; ${others} more not used` : "";
    return el("div", { class: "origin" },
      el("p", { title: `By frame: ${perFrame}` }, this.glyph(id), el("b", { text: name }), ` ${counts}${more}`),
      ...(writer ? [el("p", { class: "dim", text: writerLine(writer) })] : []),
      ...(isNewer ? [el("p", { class: "warning", text: "Changed since this map was built." })] : []));
  }
}

function group(title, ...children) {
  return el("section", {}, el("h4", { text: title }), ...children);
}

function rows(values) {
  return el("dl", {}, ...values.flatMap(([label, value]) => [el("dt", { text: label }), el("dd", { text: value })]));
}

/** Size of the residual, and chi2 with its limit; or why there is none. */
function residualRow({ at, reason, px, acrossPx, alongPx, chi2, limit, fits }) {
  const name = el("dt", { text: at === "truth" ? "At the true pose" : "At the estimate" });
  if (reason) return [name, el("dd", { class: "faint", text: reason })];
  const along = alongPx === null ? "along the pole nothing is known" : `${fixed(Math.abs(alongPx), 1)} px along`;
  const verdict = `χ² ${fixed(chi2, 1)}, limit ${fixed(limit, 1)}`;
  return [name, el("dd", { title: `${fixed(Math.abs(acrossPx), 1)} px across, ${along}` },
    `${fixed(px, 1)} px · `, el("span", { class: fits ? "" : "wrong", text: verdict }))];
}

function placeTable(place) {
  const head = ["1σ, m", "across", "along", "up", "away"].map((text) => el("th", { text }));
  const body = place.map(({ end, known, sigmaM, distanceM }) => el("tr", { title: known ? "" : "No label shows this end: only the line counts" },
    el("td", { text: known ? end : `${end}, not seen` }), ...sigmaM.map((value) => el("td", { text: fixed(value, 3) })), el("td", { text: `${fixed(distanceM, 0)} m` })));
  return el("table", {}, el("thead", {}, el("tr", {}, ...head)), el("tbody", {}, ...body));
}

function decisionLine({ kind, by, reason, names }) {
  return el("p", {}, el("b", { text: names.join(", ") }), ` ${SAID[kind] ?? kind} by ${by === "human" ? "a person" : "the machine"}: ${reason}`);
}

function writerLine({ author, origin, time, number, kind }) {
  const who = origin === "human" ? author : `a machine (${author})`;
  return `Drawn last by ${who}, ${time.slice(0, 16).replace("T", " ")} UTC, operation ${number} (${kind})`;
}
