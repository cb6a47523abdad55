// @ts-check
/* The view "Map over time": changes of the map that several passes tell, and decisions on them. */

import { byId, el, fill } from "/static/dom.js";
import { classGlyph } from "/static/glyphs.js";
import { currentTheme } from "/static/theme.js";
import { ChangeCard } from "./change_card.js";
import { ChangeList } from "./change_list.js";
import { ChangeMap } from "./change_map.js";
import { MapDiff } from "./map_diff.js";
import { about, nextOpen, openSure } from "./model.js";
import { PassTable } from "./pass_table.js";

/** @typedef {import("/static/protocol").inspector.ChangeAnswersEvent} ChangeAnswersEvent */
/** @typedef {import("/static/protocol").inspector.OverTimeEvent} OverTimeEvent */
/** @typedef {import("/static/protocol").inspector.OverTimeView} OverTimeView */
/** @typedef {import("/static/keys.js").Command} Command */
/** @typedef {import("../panel.js").AddressPart} AddressPart */
/** @typedef {import("../panel.js").ClassStyle} ClassStyle */
/** @typedef {import("../main.js").Page} Page */
/** @typedef {import("../views.js").View} View */
/** @typedef {import("./model.js").Answer} Answer */
/** @typedef {import("./model.js").Answers} Answers */

const SHOW = "over-time";

export class OverTime {
  /** @type {OverTimeView | null} */
  found = null;
  /** @type {Answers} */
  answers = new Map();
  seen = 0; // decisions that the page knows of
  canDecide = false;
  canUndo = false;
  note = "";
  nextMap = "";
  /** The name of the selected change.
   *
   * @type {string | null} */
  selected = null;
  isRequested = false;
  since = 0; // when it was requested, ms
  /** @type {ReturnType<typeof setInterval> | undefined} */
  waiting = undefined;

  /** @param {Page} page */
  constructor(page) {
    this.page = page;
    this.list = new ChangeList(this);
    this.table = new PassTable(this);
    this.map = new ChangeMap(this);
    this.card = new ChangeCard(this);
    this.diff = new MapDiff(this);
    page.socket.on("over_time", (event) => this.showFound(event));
    page.socket.on("change_answers", (event) => this.showAnswers(event));
    page.socket.on("changed_map", (event) => this.diff.showWritten(event));
    byId("change-sure").addEventListener("click", () => this.makeSure());
    byId("change-zoom").addEventListener("click", () => this.map.zoom(false));
    byId("change-whole").addEventListener("click", () => this.map.zoom(true));
  }

  /** @returns {Command[]} */
  commands() {
    const group = "Map over time";
    /** @type {(key: string, title: string, run: () => void, more?: object) => Command} */
    const command = (key, title, run, more = {}) => ({ key, group, title, run, view: SHOW, ...more });
    return [
      command("Delete", "Make the change: remove, add or move the element", () => this.decide("make")),
      command("Enter", "Keep the map as it is", () => this.decide("keep")),
      command("o", "Ask for a label; then open it in annotate", () => this.label()),
      command("Enter", "Make all changes that are sure", () => this.makeSure(), { shift: true }),
      command("z", "Undo the last decision", () => this.undo(), { ctrl: true }),
      command(".", "Next change that is not decided", () => this.selectNextOpen(), { shift: true }),
      command(".", "Next change", () => this.step(1)),
      command(",", "Previous change", () => this.step(-1)),
      command("v", "Show the frame after the change", () => this.goTo(true)),
      command("v", "Show the frame before the change", () => this.goTo(false), { shift: true }),
      command("z", "Zoom to the change", () => this.map.zoom(false)),
      command("0", "The whole map", () => this.map.zoom(true)),
    ];
  }

  /** @returns {AddressPart[]} */
  address() {
    return [{
      fields: { change: { initial: null, accepts: (text) => /^[\w-]{1,40}$/.test(text) } },
      get: () => ({ change: this.selected }),
      set: ({ change }) => { this.selected = change; this.fill(); },
    }];
  }

  get isOpen() {
    return this.page.views.shown === SHOW;
  }

  /** The selected change; null if there is none. */
  get change() {
    return this.found?.changes.find(({ name }) => name === this.selected) ?? null;
  }

  showRun() {
    this.isRequested = false;
    if (this.isOpen) this.request();
  }

  /** @param {View} view */
  showView(view) {
    if (view === SHOW) this.request();
  }

  request() {
    if (this.isRequested || !this.page.store.isOpen) return;
    this.isRequested = true;
    this.since = Date.now();
    this.page.socket.send("get_over_time");
  }

  showRefusal() {
    if (!this.found) this.isRequested = false;
  }

  /** @param {OverTimeEvent} event */
  showFound({ found, progress, is_over: isOver, left_out: leftOut }) {
    this.found = found;
    clearInterval(this.waiting);
    byId("over-time-state").hidden = found !== null;
    byId("over-time-main").classList.toggle("waiting", found === null);
    const reasons = leftOut.map(({ run, reason }) => el("li", {}, el("b", { text: run }), ` ${reason}`));
    fill(byId("runs-left-out"), reasons);
    byId("passes-left-out").textContent = leftOut.length ? `${leftOut.length} ${leftOut.length === 1 ? "run" : "runs"} left out` : "";
    byId("passes-left-out").title = leftOut.map(({ run, reason }) => `${run}: ${reason}`).join("\n");
    byId("changes-json", HTMLAnchorElement).href = `map-changes.json?${new URLSearchParams({ run: this.page.store.run.name })}`;
    byId("over-time-hint").hidden = !isOver || found !== null;
    byId("over-time-about").textContent = found ? about(found.passes, found.elements) : "";
    const say = () => { byId("over-time-progress").textContent = sentence(isOver ? progress : `${progress}${seconds(this.since)}`); };
    say();
    if (!isOver) this.waiting = setInterval(say, 1000);
    this.fill();
  }

  /** @param {ChangeAnswersEvent} event */
  showAnswers({ answers, seen, can_decide: canDecide, can_undo: canUndo, note, next_map: nextMap }) {
    this.answers = new Map(answers.map((answer) => [answer.name, answer]));
    Object.assign(this, { seen, canDecide, canUndo, note, nextMap });
    this.fill();
  }

  fill() {
    const { found } = this;
    if (!found) return;
    this.list.show(found, this.answers);
    this.table.show(this.list.changes, found.passes);
    this.map.show(found);
    this.card.show(this.change);
    this.diff.show();
  }

  showTheme() {
    this.fill();
    this.map.surface.redraw();
  }

  figures() {
    return this.isOpen && this.found ? [this.map.surface.figure("map-over-time", "Map over time")] : [];
  }

  /* What people do */

  /** Selects a change here, and its element in the frame.
   *
   * @param {string | null} name
   */
  select(name) {
    this.selected = name;
    const element = this.change?.element ?? null;
    if (element !== null) this.page.select({ element });
    this.fill();
    this.page.address.changed();
  }

  /** @param {number} by */
  step(by) {
    const { changes } = this.list;
    const at = changes.findIndex(({ name }) => name === this.selected);
    const next = changes[Math.min(Math.max(at + by, 0), changes.length - 1)];
    if (next) this.select(next.name);
  }

  selectNextOpen() {
    const name = nextOpen(this.list.changes, this.answers, this.selected);
    if (name) this.select(name);
  }

  /** @param {Answer} answer */
  decide(answer) {
    if (this.change && this.canDecide) this.send([this.change.name], answer);
  }

  makeSure() {
    const names = openSure(this.found?.changes ?? [], this.answers);
    if (names.length && this.canDecide) this.send(names, "make");
  }

  label() {
    if (!this.change) return;
    const { name } = this.change;
    if (this.answers.get(name)?.answer === "label") this.page.socket.send("open_asked_label", { name });
    else this.decide("label");
  }

  undo() {
    if (this.canUndo) this.page.socket.send("undo_change_answer", { seen: this.seen });
  }

  /**
   * @param {string[]} names
   * @param {Answer} answer
   */
  send(names, answer) {
    this.page.socket.send("decide_changes", { names, answer, seen: this.seen });
  }

  /** Shows the frame that shows the selected change best, in its run.
   *
   * @param {boolean} isAfter
   */
  goTo(isAfter) {
    const { change } = this;
    if (!change || !(isAfter ? change.after : change.before)) return;
    this.page.views.lead();
    this.page.socket.send("go_to_change", { name: change.name, is_after: isAfter });
  }

  /* How classes look */

  /** The shape of a class, and its colour in the present theme.
   *
   * @param {number} id
   * @returns {ClassStyle | null}
   */
  look(id) {
    const kind = this.page.store.run.classes.find((other) => other.id === id);
    return kind ? { shape: kind.shape, color: currentTheme() === "light" ? kind.color_light : kind.color } : null;
  }

  /** @param {number} id of a class */
  glyph(id) {
    const look = this.look(id);
    return look ? classGlyph(look) : null;
  }
}

/** @param {number} start */
function seconds(start) {
  const passed = Math.round((Date.now() - start) / 1000);
  return passed ? `, ${passed} s so far` : "";
}

/** @param {string} text */
function sentence(text) {
  return text ? `${text[0].toUpperCase()}${text.slice(1)}.` : "";
}
