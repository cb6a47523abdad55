// @ts-check
/* Tables of the tab "Solver". */

import { el } from "/static/dom.js";

/** @typedef {string | number | Node} Cell */

/**
 * @param {string} name
 * @param {string[]} head
 * @param {Node[]} rows
 */
export function table(name, head, rows) {
  return el("table", { class: name }, el("thead", {}, el("tr", {}, ...head.map((text) => el("th", { text })))), el("tbody", {}, ...rows));
}

/** A row of cells; `properties` as for `el`.
 *
 * @param {Cell[]} cells
 * @param {{[name: string]: any}} [properties]
 */
export function tableRow(cells, properties = {}) {
  /** @param {Cell} value */
  const cell = (value) => (value instanceof Node ? el("td", {}, value) : el("td", { text: value }));
  return el("tr", properties, ...cells.map(cell));
}
