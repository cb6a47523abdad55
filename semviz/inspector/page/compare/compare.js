// @ts-check
/* The open run (B) compared with another one (A): the choice of A, and the side-by-side view, in
 * which image, 3D pane and timeline stay those of B. */

import { byId, el, fixed } from "/static/dom.js";
import { statusMark } from "/static/glyphs.js";
import { flag, memberOf, yes } from "../address.js";
import { BaseImage } from "./base_image.js";
import { ErrorLines } from "./error_lines.js";
import { ChangedFrames } from "./frames.js";
import { Gates } from "./gates.js";
import { MapChanges } from "./map_changes.js";
import { Numbers } from "./numbers.js";
import { SameElement } from "./same_element.js";
import { ScatterPanel } from "./scatter.js";

/** @typedef {import("/static/protocol").inspector.BaseFrameEvent} BaseFrameEvent */
/** @typedef {import("/static/protocol").inspector.ComparisonView} ComparisonView */
/** @typedef {import("/static/protocol").inspector.FrameView} FrameView */
/** @typedef {import("../run_rows.js").OpenRun} OpenRun */
/** @typedef {import("/static/protocol").inspector.StateView} StateView */
/** @typedef {import("/static/keys.js").Command} Command */
/** @typedef {import("../panel.js").AddressPart} AddressPart */
/** @typedef {import("../main.js").Page} Page */
/** @typedef {import("../panel.js").Panel} Panel */

const ONE_RUN = "Only this run is open. To compare two runs: ";

export class Compare {
  /** @param {Page} page */
  constructor(page) {
    this.page = page;
    this.base = "";
    this.other = "";
    this.isOpen = false;
    /** @type {ReturnType<typeof setInterval> | undefined} */
    this.waiting = undefined;
    this.same = new SameElement();
    this.choice = byId("base", HTMLSelectElement);
    page.socket.on("runs", ({ names }) => this.showRuns(names));
    page.socket.on("comparison", ({ comparison }) => this.showComparison(comparison));
    page.socket.on("base_frame", (event) => this.showBaseFrame(event));
    this.frames = new ChangedFrames(page);
    const gates = new Gates(page);
    /** The panels of the side-by-side view.
     *
     * @type {Panel[]} */
    this.panels = [
      this.frames,
      new BaseImage(page, this.same),
      new ScatterPanel(page),
      new MapChanges(page, this.same),
      new ErrorLines(page),
    ];
    new Numbers(page, (name) => gates.write(name));
    byId("compare").addEventListener("click", () => this.toggle());
    byId("compare-close").addEventListener("click", () => this.close());
    byId("swap").addEventListener("click", () => this.swap());
    this.choice.addEventListener("change", () => {
      this.compareWith(this.choice.value, Boolean(this.choice.value));
      this.choice.blur();
    });
  }

  /** @returns {Command[]} */
  commands() {
    return [{ key: "c", group: "Page", title: "Compare with another run", run: () => this.toggle() }];
  }

  /** @returns {AddressPart[]} */
  address() {
    return [{
      fields: { base: memberOf(() => this.others()), beside: flag() },
      get: () => ({ base: this.base || null, beside: yes(this.isOpen) }),
      set: ({ base, beside }) => this.compareWith(base ?? "", beside === "yes"),
    }];
  }

  /* From the server */

  /** @param {string[]} names */
  showRuns(names) {
    this.fillChoice(names);
  }

  /** @param {OpenRun} run */
  showRun({ name }) {
    if (this.base && name !== this.other) this.wait(this.base);
    this.other = name;
    this.fillChoice(this.page.store.names);
  }

  /** @param {StateView} state */
  showState({ base, comparing }) {
    if (base !== this.base) this.wait(base);
    if (comparing !== this.isOpen) this.setOpen(comparing);
    this.choice.value = base;
  }

  /** Waits for a comparison, and shows how long.
   *
   * @param {string} base
   */
  wait(base) {
    this.base = base;
    document.body.classList.toggle("awaiting", Boolean(base));
    byId("compare-label").textContent = base ? `Against ${base}` : "Compare with…";
    clearInterval(this.waiting);
    const start = Date.now();
    const showTime = () => { byId("compare-about").textContent = `reading ${base}, ${Math.round((Date.now() - start) / 1000)} s`; };
    byId("compare-about").textContent = "";
    if (base) this.waiting = setInterval(showTime, 1000);
  }

  /** @param {ComparisonView} comparison */
  showComparison({ base_ids: baseIds }) {
    clearInterval(this.waiting);
    byId("compare-about").textContent = "";
    document.body.classList.remove("awaiting");
    this.same.use(baseIds);
  }

  /** @param {FrameView} frame */
  showFrame(frame) {
    byId("side-b").replaceChildren(...head("B", this.page.store.run.name, frame));
  }

  /** @param {BaseFrameEvent} event */
  showBaseFrame({ base }) {
    byId("side-a").replaceChildren(...head("A", this.base, base && base.frame));
  }

  /* From the user */

  /**
   * @param {string} base
   * @param {boolean} sideBySide
   */
  compareWith(base, sideBySide) {
    this.page.socket.send("compare_runs", { base, side_by_side: sideBySide });
  }

  toggle() {
    if (this.isOpen) this.close();
    else if (this.base) this.compareWith(this.base, true);
    else this.choose();
  }

  close() {
    this.compareWith(this.base, false);
  }

  /** A becomes B, and B becomes A. */
  swap() {
    const { run, frame } = this.page.store;
    const [base, other] = [this.base, run.name];
    this.page.open(base, frame.index);
    this.compareWith(other, true);
  }

  /** Lets the user choose a run to compare with. */
  choose() {
    const others = this.others();
    const dialog = el("dialog", { class: "help ask choose-run" }, el("h2", { text: `Compare ${this.page.store.run.name} with` }));
    /** @param {string} name */
    const choice = (name) => el("li", {}, el("button", { text: name, onclick: () => { dialog.close(); this.compareWith(name, true); } }));
    if (others.length) dialog.append(el("ul", {}, ...others.map(choice)));
    else dialog.append(el("p", {}, ONE_RUN, el("code", { text: "semviz serve a.rrd b.rrd" })));
    dialog.addEventListener("close", () => dialog.remove());
    dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });
    document.body.append(dialog);
    dialog.showModal();
  }

  /* Display */

  /** Names of the runs to compare with. */
  others(names = this.page.store.names) {
    const { store } = this.page;
    return names.filter((name) => !store.isOpen || name !== store.run.name);
  }

  /** @param {string[]} names */
  fillChoice(names) {
    const options = this.others(names).map((name) => el("option", { text: name, value: name }));
    this.choice.replaceChildren(...options, el("option", { text: "no other run", value: "" }));
    this.choice.value = this.base;
  }

  /** @param {boolean} isOpen */
  setOpen(isOpen) {
    this.isOpen = isOpen;
    document.body.classList.toggle("comparing", isOpen);
  }
}

/** The title of one side: the run, and its result for the frame.
 *
 * @param {string} letter
 * @param {string} name
 * @param {FrameView | null} frame
 */
function head(letter, name, frame) {
  const title = [el("b", { class: "letter", text: letter }), el("b", { class: "run-name", title: name, text: name })];
  if (!frame) return title;
  const error = frame.error_m === null ? (frame.status === "cannot" ? "no pose" : "no ground truth") : `${fixed(frame.error_m, 2)} m`;
  return [...title, statusMark(frame.status), el("span", { text: frame.status }), el("span", { class: "push" }),
    el("b", { class: frame.overconfident ? "wrong" : "", text: error }), el("span", { class: "dim", text: frame.error_deg === null ? "" : `${fixed(frame.error_deg, 2)}°` })];
}
