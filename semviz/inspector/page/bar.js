// @ts-check
/* The bar at the top: run, frame, status, error. */

import { byId, el, fixed } from "/static/dom.js";
import { statusMark } from "/static/glyphs.js";

/** @typedef {import("/static/protocol").inspector.FrameView} FrameView */
/** @typedef {import("./run_rows.js").OpenRun} OpenRun */
/** @typedef {import("./main.js").Page} Page */

const STATUS = { ok: "Ok", ambiguous: "Ambiguous", cannot: "Cannot" };

export class Bar {
  /** @param {Page} page */
  constructor(page) {
    this.page = page;
    page.socket.on("runs", ({ names }) => this.showRuns(names));
    this.choice = byId("run", HTMLSelectElement);
    this.choice.addEventListener("change", () => {
      page.open(this.choice.value, page.store.hasFrame ? page.store.frame.index : null);
      this.choice.blur();
    });
    byId("previous").addEventListener("click", () => page.step(-1));
    byId("next").addEventListener("click", () => page.step(1));
    byId("play").addEventListener("click", () => page.play());
    byId("theme").addEventListener("click", () => page.switchTheme());
    byId("help").addEventListener("click", () => page.help());
    byId("copy-link").addEventListener("click", () => this.copyLink());
  }

  /** @param {string[]} names */
  showRuns(names) {
    this.choice.replaceChildren(...names.map((name) => el("option", { text: name, value: name })));
    byId("all-runs").hidden = names.length < 2;
  }

  /** @param {OpenRun} run */
  showRun(run) {
    this.choice.value = run.name;
    byId("method").textContent = `${run.method} in ${run.map}`;
  }

  /** Another run was refused: shows the open one. */
  showRefusal() {
    if (this.page.store.isOpen) this.choice.value = this.page.store.run.name;
  }

  /** @param {FrameView} frame */
  showFrame(frame) {
    this.pointAt(frame.position);
    byId("status").replaceChildren(statusMark(frame.status), STATUS[frame.status]);
    byId("status").title = frame.reason;
    const missing = frame.status === "cannot" ? "no pose" : "no ground truth";
    const error = frame.error_m === null
      ? missing
      : `${fixed(frame.error_m, 2)} m · ${fixed(frame.error_deg, 2)}°`;
    byId("numbers").replaceChildren(error, el("span", { class: "more", text: frame.ms ? ` · ${fixed(frame.ms, 1)} ms` : "" }));
  }

  /** @param {number} position */
  pointAt(position) {
    const { frames } = this.page.store.run;
    byId("frame-number").textContent = `Frame ${frames[position].index} of ${frames.at(-1)?.index}`;
  }

  async copyLink() {
    await navigator.clipboard.writeText(location.href);
    byId("copy-link").textContent = "Copied";
    setTimeout(() => { byId("copy-link").textContent = "Copy link"; }, 1200);
  }
}
