// @ts-check
/* The decisions as a diff, and the changed map that they make. */

import { byId, el, fill } from "/static/dom.js";
import { diffLines } from "./model.js";

/** @typedef {import("/static/protocol").inspector.ChangedMapEvent} ChangedMapEvent */
/** @typedef {import("./over_time.js").OverTime} OverTime */

/** @type {Record<string, string>} */
const KIND_OF = { "-": "gone", "+": "new", "~": "moved", "?": "asked", "=": "kept" };

export class MapDiff {
  /** @param {OverTime} view */
  constructor(view) {
    this.view = view;
    this.name = byId("next-map", HTMLInputElement);
    this.proposed = ""; // the free name that the server proposed
    byId("next-map-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.write();
    });
    byId("diff-copy").addEventListener("click", () => this.copy());
  }

  get lines() {
    const { found, answers } = this.view;
    return found ? diffLines(found.changes, answers) : [];
  }

  show() {
    const { lines } = this;
    const { found, canDecide, note, nextMap } = this.view;
    if (this.name.value === this.proposed || !this.name.value) this.name.value = nextMap;
    this.proposed = nextMap;
    const changed = lines.filter(({ mark }) => "-+~".includes(mark)).length;
    const stay = (found?.elements ?? 0) - lines.filter(({ mark }) => "-~".includes(mark)).length;
    fill(byId("diff-lines"), lines.map(({ mark, text }) => el("div", { class: KIND_OF[mark] }, `${mark} ${text}`)));
    if (lines.length) byId("diff-lines").append(el("div", { class: "kept" }, `  ${stay.toLocaleString("en")} elements as they are`));
    byId("diff-about").textContent = lines.length ? `${lines.length} decided` : "none decided";
    byId("diff-note").textContent = note;
    byId("write-map", HTMLButtonElement).disabled = !changed || !canDecide;
    byId("next-map-form").hidden = !canDecide;
  }

  write() {
    this.view.page.socket.send("write_changed_map", { name: this.name.value.trim() });
  }

  /** @param {ChangedMapEvent} event */
  showWritten({ text }) {
    byId("diff-written").textContent = text;
  }

  async copy() {
    const { found } = this.view;
    const head = `map ${found?.map}, ${found?.passes.length} passes`;
    await navigator.clipboard.writeText([head, ...this.lines.map(({ mark, text }) => `${mark} ${text}`)].join("\n"));
    const button = byId("diff-copy");
    button.textContent = "Copied";
    setTimeout(() => { button.textContent = "Copy"; }, 1200);
  }
}
