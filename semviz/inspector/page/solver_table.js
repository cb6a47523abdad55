/* Tables of the tab "Solver". */

import { el } from "/static/dom.js";

export function table(name, head, rows) {
  return el("table", { class: name }, el("thead", {}, el("tr", {}, ...head.map((text) => el("th", { text })))), el("tbody", {}, ...rows));
}

/** Cells are texts, numbers or nodes; `properties` as of `el`. */
export function tableRow(cells, properties = {}) {
  const cell = (value) => (value instanceof Node ? el("td", {}, value) : el("td", { text: value }));
  return el("tr", properties, ...cells.map(cell));
}
