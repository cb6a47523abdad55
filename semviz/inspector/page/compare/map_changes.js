// @ts-check
/* Differences between the maps of A and B, and the frames with them in view. */

import { byId, el } from "/static/dom.js";
import { classGlyph } from "/static/glyphs.js";
import { currentTheme } from "/static/theme.js";

/** @typedef {import("/static/protocol").inspector.ComparisonView} ComparisonView */
/** @typedef {import("/static/protocol").inspector.MapChangeView} MapChangeView */
/** @typedef {import("../main.js").Page} Page */
/** @typedef {import("./same_element.js").SameElement} SameElement */

export class MapChanges {
  /**
   * @param {Page} page
   * @param {SameElement} same
   */
  constructor(page, same) {
    this.page = page;
    this.same = same;
    /** @type {ComparisonView | null} */
    this.comparison = null;
    page.socket.on("comparison", ({ comparison }) => {
      this.comparison = comparison;
      this.fill(comparison);
    });
  }

  showState() {
    this.mark();
  }

  showTheme() {
    if (this.comparison) this.fill(this.comparison);
  }

  /** @param {ComparisonView} comparison */
  fill({ changes, more_changes: more, same_map: sameMap, unchanged }) {
    const count = changes.length + more;
    byId("map-changes-about").textContent = sameMap ? "the same map" : `${count} ${count === 1 ? "change" : "changes"}, ${unchanged} unchanged`;
    byId("map-change-list").replaceChildren(...changes.map((change) => this.row(change)));
    const rest = sameMap ? "A and B used the same map."
      : more ? `${more} more, not in view of a fixed or broken frame. semviz map diff lists all.`
        : count ? "" : "No element was added, removed, moved by more than 1 cm, or changed its class.";
    if (rest) byId("map-change-list").append(el("li", { class: "none dim", text: rest }));
    this.mark();
  }

  /** @param {MapChangeView} change */
  row(change) {
    const name = change.names.join(", ");
    const kind = this.page.store.run.classes.find(({ letter }) => name.startsWith(`${letter}-`));
    const color = kind && (currentTheme() === "light" ? kind.color_light : kind.color);
    const { broken, fixed } = change;
    const seen = [broken.length && `${broken.length} broken`, fixed.length && `${fixed.length} fixed`];
    return el("li", { class: "row map-change", tabindex: 0, title: titleOf(change), onclick: () => this.choose(change), onkeydown: (/** @type {KeyboardEvent} */ event) => { if (event.key === "Enter") this.choose(change); } },
      kind ? classGlyph(kind, color) : el("span"), el("b", { text: name }), el("span", { class: "dim", text: textOf(change) }),
      el("span", { class: "seen", text: seen.filter(Boolean).join(", ") }));
  }

  /** Selects the changed element in a frame with it in view: the first broken one, or the first fixed.
   *
   * @param {MapChangeView} change
   */
  choose(change) {
    this.same.chosen = change;
    this.page.select({ element: change.element });
    const frames = [...change.broken, ...change.fixed];
    const { run, frame } = this.page.store;
    const position = run.frames.findIndex(({ index }) => index === frames[0]);
    if (frames.length && !frames.includes(frame.index)) this.page.go(position);
    this.mark();
  }

  mark() {
    const { chosen } = this.same;
    const { element } = this.page.store.state;
    if (chosen && chosen.element !== element) this.same.chosen = null;
    [...byId("map-change-list").children].forEach((row, at) => {
      const change = this.comparison?.changes[at];
      const isCurrent = change && (change === this.same.chosen || (element !== null && change.element === element));
      row.setAttribute("aria-current", String(Boolean(isCurrent)));
    });
  }
}

/** @param {MapChangeView} change */
function textOf({ kind, was, moved_m: movedM }) {
  if (kind === "moved" && movedM !== null) return `moved ${movedM < 0.1 ? `${(100 * movedM).toFixed(0)} cm` : `${movedM.toFixed(1)} m`}`;
  if (kind === "class changed") return `was ${was[0]}`;
  if (kind === "merged") return `merged from ${was.join(", ")}`;
  return kind === "split" ? `split from ${was[0]}` : kind;
}

/** @param {MapChangeView} change */
function titleOf({ broken, fixed }) {
  /** @type {(frames: number[], what: string) => string[]} */
  const some = (frames, what) => (frames.length ? [`${what} frames with it in view: ${frames.slice(0, 12).join(", ")}${frames.length > 12 ? " …" : ""}`] : []);
  return [...some(broken, "Broken"), ...some(fixed, "Fixed")].join("\n") || "Not in view of a broken or fixed frame";
}
