// @ts-check
/* The story of a run: how many frames are right, what explains the others, and where they are. */

import { byId, el, fill, fixed, unbroken } from "/static/dom.js";
import { statusMark } from "/static/glyphs.js";
import { StoryMap } from "./story_map.js";

/** @typedef {import("../run_rows.js").OpenRun} OpenRun */
/** @typedef {import("/static/protocol").inspector.StoryCause} StoryCause */
/** @typedef {import("/static/protocol").inspector.StoryEvent} StoryEvent */
/** @typedef {import("/static/protocol").inspector.StoryView} StoryView */
/** @typedef {import("../main.js").Page} Page */
/** @typedef {import("../views.js").View} View */

const LEADS_TO_FRAME = ".list .row, .fault, .decision";

export class Story {
  /** @param {Page} page */
  constructor(page) {
    this.page = page;
    this.isRequested = false;
    this.run = ""; // the name of the open one
    /** @type {StoryView | null} */
    this.found = null;
    this.map = new StoryMap((position) => this.openFrame(position));
    page.socket.on("story", (event) => this.showStory(event));
    byId("frames").addEventListener("click", ({ target }) => {
      if (target instanceof Element && target.closest(LEADS_TO_FRAME)) page.views.open("frame");
      else this.mark(); // the list may show the frames of all causes now
    });
    byId("story-all").addEventListener("click", () => this.choose(null));
    byId("story-copy").addEventListener("click", () => this.copy());
  }

  /** The cause whose frames the list shows. */
  get cause() {
    return this.page.list.cause;
  }

  get isOpen() {
    return this.page.views.shown === "story";
  }

  /** @param {OpenRun} run */
  showRun(run) {
    if (run.name !== this.run) {
      this.found = null;
      this.isRequested = false;
    }
    this.run = run.name;
  }

  /** @param {View} view */
  showView(view) {
    if (view === "story" && !this.isRequested) {
      this.isRequested = true;
      this.page.socket.send("get_story");
    }
    this.mark();
  }

  /** @param {number} position */
  openFrame(position) {
    this.page.go(position);
    this.page.views.open("frame");
  }

  /** @param {StoryEvent} event */
  showStory({ found, progress, diagnosed }) {
    const { length } = this.page.store.run.frames;
    const within = diagnosed < length ? ` in ${diagnosed.toLocaleString("en")} typical frames` : "";
    byId("story-progress").textContent = progress ? `Looking for causes of the whole run${within}: ${progress}` : within && `Causes of the whole run were looked for${within}.`;
    if (found) this.showFound(found);
  }

  /** @param {StoryView} found */
  showFound(found) {
    this.found = found;
    if (this.cause) this.page.list.showCause([...found.causes, ...found.harmless].find((cause) => isSame(cause, this.cause)) ?? null);
    byId("story-headline").textContent = found.headline;
    byId("story-detail").textContent = found.detail;
    fill(byId("story-tiles"), tiles(found));
    byId("story-about").textContent = about(found, this.page.store.run.frames.length);
    this.map.use(found.route, found.causes);
    this.fillCauses(found);
  }

  /** @param {StoryView} found */
  fillCauses({ causes, harmless, overconfident }) {
    const none = el("li", { class: "none dim", text: "Every frame is right." });
    const also = harmless.length ? [el("li", { class: "also", text: "Also found, without a wrong frame of its own:" })] : [];
    fill(byId("story-causes"), [
      ...(causes.length ? causes.map((cause) => this.entry(cause, cause.frames.length.toLocaleString("en"))) : [none]),
      ...also, ...harmless.map((cause) => this.entry(cause, "")),
    ]);
    byId("story-truth").textContent = overconfident === null ? "without ground truth" : "with ground truth";
    this.mark();
  }

  /**
   * @param {StoryCause} cause
   * @param {string} count of wrong frames
   */
  entry(cause, count) {
    const { kind, sentence, where, frames, examples, is_of_run: ofRun } = cause;
    const { frames: rows } = this.page.store.run;
    const example = (/** @type {number} */ position) => el("button", {
      class: "small", text: rows[position].index, title: "Open this frame",
      onclick: (event) => { event.stopPropagation(); this.openFrame(position); } });
    return el("li", { class: "cause", tabindex: 0, data: { kind, sentence }, onclick: () => this.choose(cause),
      onkeydown: (/** @type {KeyboardEvent} */ event) => { if (event.key === "Enter") this.choose(cause); } },
      el("header", {}, frames.length ? statusMark(rows[frames[0]].status) : null, el("b", { class: "kind", text: kind }), el("b", { class: "count", text: count })),
      el("p", {}, ...unbroken(sentence)),
      el("p", { class: "dim", text: `${where}${ofRun ? " · seen over the whole run" : ""}` }),
      el("div", { class: "examples" }, el("span", { class: "faint", text: "open" }), ...examples.map(example)));
  }

  /** Shows only the frames of a cause in the list; null shows all.
   *
   * @param {StoryCause | null} cause
   */
  choose(cause) {
    this.page.list.showCause(isSame(cause, this.cause) ? null : cause);
    this.page.left.show("frames");
    this.mark();
  }

  mark() {
    this.map.select(this.cause);
    byId("story-all").hidden = this.cause === null;
    for (const entry of document.querySelectorAll("#story-causes .cause")) {
      const isCurrent = entry instanceof HTMLElement && entry.dataset.sentence === this.cause?.sentence;
      entry.setAttribute("aria-current", String(isCurrent));
    }
  }

  /** Copies the causes as a table that spreadsheets read. */
  async copy() {
    const rows = (this.found?.causes ?? []).map(({ kind, frames, where, sentence }) => [kind, frames.length, where, sentence].join("\t"));
    await navigator.clipboard.writeText(["cause\tframes\twhere\tsentence", ...rows].join("\n"));
    const button = byId("story-copy");
    button.textContent = "Copied";
    setTimeout(() => { button.textContent = "Copy as table"; }, 1200);
  }

  showTheme() {
    this.map.surface.redraw();
  }

  figures() {
    return this.isOpen ? [this.map.surface.figure("where-it-fails", "Where it fails")] : [];
  }
}

/** Whether two causes are the same: several elements may have moved.
 *
 * @param {StoryCause | null} a
 * @param {StoryCause | null} b
 */
const isSame = (a, b) => a?.kind === b?.kind && a?.sentence === b?.sentence;

/** Numbers of the run, each above what it counts.
 *
 * @param {StoryView} found
 */
function tiles({ ok, ambiguous, cannot, overconfident, median_m: medianM }) {
  const frames = ok + ambiguous + cannot;
  const share = (/** @type {number} */ count) => `${fixed((100 * count) / Math.max(frames, 1), 1)} %`;
  const count = (/** @type {number} */ number) => number.toLocaleString("en");
  /** @type {(value: (Node | string)[], label: string, kind?: string) => HTMLElement} */
  const tile = (value, label, kind = "") => el("div", { class: `tile ${kind}` }, el("b", {}, ...value), el("span", { class: "dim", text: label }));
  return [
    medianM === null ? null : tile([`${fixed(medianM, 2)} m`], "median error"),
    tile([statusMark("ok"), share(ok)], `ok, ${count(ok)}`),
    tile([statusMark("ambiguous"), share(ambiguous)], `ambiguous, ${count(ambiguous)}`),
    tile([statusMark("cannot"), share(cannot)], `cannot, ${count(cannot)}`),
    overconfident === null ? null : tile([count(overconfident)], "ok, yet over 1 m off", overconfident ? "wrong" : ""),
  ];
}

/**
 * @param {StoryView} found
 * @param {number} frames
 */
function about({ length_m: lengthM, seconds }, frames) {
  const length = lengthM < 2000 ? `${Math.round(lengthM)} m` : `${fixed(lengthM / 1000, 1)} km`;
  const time = !seconds ? null : seconds < 120 ? `${Math.round(seconds)} s` : `${Math.round(seconds / 60)} min`;
  return [`${frames.toLocaleString("en")} frames`, time, length].filter(Boolean).join(", ");
}
