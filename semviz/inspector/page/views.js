// @ts-check
/* The views of the page, as tabs in the top bar: a frame, the story of the run, the map over time. */

import { byId } from "/static/dom.js";

/** @typedef {import("./run_rows.js").OpenRun} OpenRun */
/** @typedef {import("/static/keys.js").Command} Command */
/** @typedef {import("./panel.js").AddressPart} AddressPart */
/** @typedef {import("./main.js").Page} Page */
/** @typedef {"frame" | "story" | "over-time"} View */

/** @type {View[]} */
const VIEWS = ["frame", "story", "over-time"];
const LONG_RUN = 200; // frames; longer runs open with their story
const IN_ALL = "Page"; // the group of commands that work in every view

export class Views {
  /** @param {Page} page */
  constructor(page) {
    this.page = page;
    /** @type {View} */
    this.shown = "frame";
    this.run = ""; // the name of the open one
    this.leadsToFrame = false; // of a run that is being opened
    for (const view of VIEWS) byId(`view-${view}`).addEventListener("click", () => this.open(view));
  }

  /** The view of commands that have none, and of the keys of a frame.
   *
   * @param {Command[]} commands
   */
  ofFrame(commands) {
    return commands.map((command) => (command.group === IN_ALL || command.view !== undefined ? command : { ...command, view: "" }));
  }

  /** @returns {Command[]} */
  commands() {
    return [
      { key: "F2", group: IN_ALL, title: "The frame: image, map, diagnosis", run: () => this.open("frame") },
      { key: "F3", group: IN_ALL, title: "The story of the run: causes, and where it fails", run: () => this.open("story") },
      { key: "F4", group: IN_ALL, title: "The map over time: what vanished, appeared or moved", run: () => this.open("over-time") },
    ];
  }

  /** @returns {AddressPart[]} */
  address() {
    return [{
      fields: { show: { initial: null, accepts: (text) => VIEWS.some((view) => view === text) } },
      get: () => ({ show: this.shown === this.first ? null : this.shown }),
      set: ({ show }) => this.open(VIEWS.find((view) => view === show) ?? this.first),
    }];
  }

  /** The view with which the run opens.
   *
   * @returns {View}
   */
  get first() {
    return this.page.store.run.frames.length > LONG_RUN ? "story" : "frame";
  }

  /** @param {OpenRun} run */
  showRun(run) {
    if (run.name !== this.run) this.open(this.leadsToFrame ? "frame" : this.shown === "over-time" ? this.shown : this.first);
    this.leadsToFrame = false;
    this.run = run.name;
  }

  /** Shows the frame, also if it is of another run that is still to come. */
  lead() {
    this.leadsToFrame = true;
    this.open("frame");
  }

  /** @param {View} view */
  open(view) {
    const { page } = this;
    if (view !== "frame" && page.compare.isOpen) page.compare.close();
    this.shown = view;
    page.keys.view = view === "over-time" ? view : "";
    document.body.classList.toggle("telling", view === "story");
    document.body.classList.toggle("over-time", view === "over-time");
    for (const one of VIEWS) {
      byId(`view-${one}`).setAttribute("aria-selected", String(one === view));
      if (one !== "frame") byId(one).hidden = one !== view;
    }
    page.forEachPanel((panel) => panel.showView?.(view));
    page.address.changed();
  }
}
