// @ts-check
/* All runs as a table: sorted by any column, each row opens its run. */

import { byId, el, fixed } from "/static/dom.js";
import { startTheme, switchTheme } from "/static/theme.js";

/** @typedef {{run: string, frames?: number, ok?: number, ambiguous?: number, cannot?: number, rte_m?: number | null, rre_deg?: number | null, share_below_1m?: number | null, overconfident?: number, fault?: string, faults?: string}} RunRow */
/** @typedef {{key: keyof RunRow, title: string, about?: string, show: (row: RunRow) => string}} Column */

/** @param {number | null | undefined} value @param {number} digits */
const number = (value, digits) => (value === null || value === undefined ? "" : fixed(value, digits));
/** @param {number | null | undefined} share */
const percent = (share) => (share === null || share === undefined ? "" : `${fixed(100 * share, 1)} %`);

/** @type {Column[]} */
const COLUMNS = [
  { key: "run", title: "Run", show: (row) => row.run },
  { key: "frames", title: "Frames", show: (row) => number(row.frames, 0) },
  { key: "ok", title: "Ok", show: (row) => number(row.ok, 0) },
  { key: "ambiguous", title: "Ambiguous", show: (row) => number(row.ambiguous, 0) },
  { key: "cannot", title: "Cannot", show: (row) => number(row.cannot, 0) },
  { key: "rte_m", title: "Error, m", about: "Median error of the position", show: (row) => number(row.rte_m, 2) },
  { key: "rre_deg", title: "Error, °", about: "Median error of the rotation", show: (row) => number(row.rre_deg, 2) },
  { key: "share_below_1m", title: "Below 1 m", about: "Share of frames with an error below 1 m", show: (row) => percent(row.share_below_1m) },
  { key: "overconfident", title: "Overconfident", about: "Frames that are ok, but more than 1 m off", show: (row) => number(row.overconfident, 0) },
  { key: "fault", title: "Most frequent cause", show: (row) => row.fault ?? "" },
];
const TEXTS = ["run", "fault"];

/** Unknown values come last in both directions.
 *
 * @param {RunRow} a
 * @param {RunRow} b
 * @param {keyof RunRow} key
 * @param {number} direction 1 ascending, -1 descending
 */
function compared(a, b, key, direction) {
  const [one, other] = [a[key] ?? null, b[key] ?? null];
  if (one === null || other === null) return Number(one === null) - Number(other === null);
  const order = typeof one === "number" ? one - Number(other) : one.localeCompare(String(other), "en", { numeric: true });
  return direction * order;
}

class RunTable {
  /**
   * @param {RunRow[]} runs
   * @param {RunRow | null} all
   */
  constructor(runs, all) {
    this.runs = runs;
    this.headers = COLUMNS.map(({ key, title, about }) =>
      el("th", { class: TEXTS.includes(key) ? "text" : "", title: about }, el("button", { text: title, onclick: () => this.sortBy(key) })));
    byId("columns").replaceChildren(...this.headers);
    if (all) byId("total").replaceChildren(el("tr", {}, ...cells({ ...all, run: "All frames" })));
    this.sortBy("run");
  }

  /** @param {keyof RunRow} key the same again turns the order */
  sortBy(key) {
    const first = TEXTS.includes(key) ? 1 : -1; // the largest numbers come first
    this.direction = key === this.key ? -(this.direction ?? 1) : first;
    this.key = key;
    const { direction } = this;
    COLUMNS.forEach((column, number_) => {
      if (column.key !== key) this.headers[number_].removeAttribute("aria-sort");
      else this.headers[number_].setAttribute("aria-sort", direction > 0 ? "ascending" : "descending");
    });
    const rows = [...this.runs].sort((a, b) => compared(a, b, key, direction) || compared(a, b, "run", 1));
    byId("rows").replaceChildren(...rows.map(rowOf));
  }
}

/** @param {RunRow} row */
function cells(row) {
  return COLUMNS.map(({ key, show }) => el("td", { class: TEXTS.includes(key) ? "text" : "", title: key === "fault" ? row.faults : null, text: show(row) }));
}

/** @param {RunRow} row */
function rowOf(row) {
  const address = `/?${new URLSearchParams({ run: row.run })}`;
  const [, ...others] = cells(row);
  const name = el("td", { class: "text" }, el("a", { href: address, text: row.run }), row.frames === undefined && el("span", { class: "dim", title: "It was interrupted, or is of an earlier version; semviz repair writes a table", text: " no table at its end" }));
  return el("tr", { onclick: () => { location.href = address; } }, name, ...others);
}

async function load() {
  const about = byId("about");
  try {
    const response = await fetch("/runs.json");
    if (!response.ok) throw new Error(`status ${response.status}`);
    const { runs, all } = await response.json();
    new RunTable(runs, all);
    about.textContent = `${runs.length} runs`;
  } catch (error) {
    about.textContent = `The runs cannot be read (${error instanceof Error ? error.message : error}); reload this page`;
  }
}

startTheme();
byId("theme").addEventListener("click", () => switchTheme());
load();
