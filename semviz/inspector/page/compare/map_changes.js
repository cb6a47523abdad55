/* What differs between the maps of A and B, and which frames saw it. */

import { byId, el } from "/static/dom.js";
import { classGlyph } from "/static/glyphs.js";
import { currentTheme } from "/static/theme.js";

export class MapChanges {
  constructor(page, same) {
    this.page = page;
    this.same = same;
    this.comparison = null;
  }

  showComparison(comparison) {
    this.comparison = comparison;
    this.fill();
  }

  showState() {
    this.mark();
  }

  showTheme() {
    if (this.comparison) this.fill();
  }

  fill() {
    const { changes, changesLeft, sameMap, unchanged } = this.comparison;
    const count = changes.length + changesLeft;
    byId("map-changes-about").textContent = sameMap ? "the same map" : `${count} ${count === 1 ? "change" : "changes"}, ${unchanged} unchanged`;
    byId("map-change-list").replaceChildren(...changes.map((one) => this.row(one)));
    const rest = sameMap ? "A and B used the same map."
      : changesLeft ? `${changesLeft} more that no fixed or broken frame saw: semviz map diff lists all.`
        : count ? "" : "Nothing was added, removed, moved by over 1 cm or given another class.";
    if (rest) byId("map-change-list").append(el("li", { class: "none dim", text: rest }));
    this.mark();
  }

  row(change) {
    const name = change.names.join(", ");
    const kind = this.page.run.classes.find(({ letter }) => name.startsWith(`${letter}-`));
    const color = kind && (currentTheme() === "light" ? kind.colorLight : kind.color);
    const seen = ["broken", "fixed"].map((what) => change[what].length && `${change[what].length} ${what}`);
    const row = el("li", { class: "row map-change", tabindex: 0, title: titleOf(change), onclick: () => this.choose(change), onkeydown: (event) => { if (event.key === "Enter") this.choose(change); } },
      kind ? classGlyph(kind, color) : el("span"), el("b", { text: name }), el("span", { class: "dim", text: told(change) }),
      el("span", { class: "seen", text: seen.filter(Boolean).join(", ") }));
    row.change = change;
    return row;
  }

  /** Selects what changed, in a frame that saw it: the first broken one, or the first fixed one. */
  choose(change) {
    this.same.chosen = change;
    this.page.select({ element: change.element });
    const there = [...change.broken, ...change.fixed];
    const position = this.page.run.frames.findIndex(({ index }) => index === there[0]);
    if (there.length && !there.includes(this.page.frame.index)) this.page.go(position);
    this.mark();
  }

  mark() {
    const { chosen } = this.same;
    const { element } = this.page.state;
    if (chosen && chosen.element !== element) this.same.chosen = null;
    for (const row of byId("map-change-list").children) {
      const isCurrent = row.change && (row.change === this.same.chosen || (element !== null && row.change.element === element));
      row.setAttribute("aria-current", Boolean(isCurrent));
    }
  }
}

function told({ kind, was, movedM }) {
  if (kind === "moved") return `moved ${movedM < 0.1 ? `${(100 * movedM).toFixed(0)} cm` : `${movedM.toFixed(1)} m`}`;
  if (kind === "class changed") return `was ${was[0]}`;
  if (kind === "merged") return `merged of ${was.join(", ")}`;
  return kind === "split" ? `split from ${was[0]}` : kind;
}

function titleOf({ broken, fixed }) {
  const some = (frames, what) => (frames.length ? [`${what} frames that saw it: ${frames.slice(0, 12).join(", ")}${frames.length > 12 ? " ..." : ""}`] : []);
  return [...some(broken, "Broken"), ...some(fixed, "Fixed")].join("\n") || "No broken or fixed frame saw it";
}
