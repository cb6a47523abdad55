// @ts-check
// The view "Team": who has what, the frames that wait for a reviewer, and one of them with its comments.
/** @import {annotator} from "/static/protocol" */
/** @import {Command, Keys} from "/static/keys.js" */
/** @import {Child} from "/static/dom.js" */
/** @import {Page} from "./main.js" */
/** @import {State} from "./state.js" */
import { byId, el, svg } from "/static/dom.js";
import { TeamPicture } from "./team_picture.js";
import { counted, spaced, uuid7 } from "./values.js";
import { RenderCache, badge, capital, header, row } from "./widgets.js";

/** @type {annotator.QueueEntry["state"][]} */
const STATES = ["waiting", "sent back", "accepted"];
const REFRESH_MS = 1000;
/** A time in a narrow column. @type {Intl.DateTimeFormatOptions} */
const WHEN = { month: "numeric", day: "numeric", hour: "numeric", minute: "2-digit" };

export class Team {
  /**
   * @param {State} state
   * @param {Keys} keys
   * @param {Page} page
   */
  constructor(state, keys, page) {
    this.state = state;
    this.keys = keys;
    this.page = page;
    this.cache = new RenderCache(state);
    /** @type {annotator.TeamView | null} */
    this.known = null;
    /** @type {annotator.QueueEntry["state"]} */
    this.listed = "waiting"; // the part of the queue on screen
    this.asked = -1; // the operation after which the team was requested
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.timer = undefined;
    this.picture = new TeamPicture(state, page.pictures);
    page.socket.on("team", ({ team }) => {
      this.known = team;
      state.set({});
    });
    page.socket.on("people", () => { this.asked = -1; });
    byId("team-assign", HTMLFormElement).addEventListener("submit", (event) => this.#assign(event));
    byId("team-comment", HTMLFormElement).addEventListener("submit", (event) => this.#comment(event));
    for (const id of ["team-frames", "team-comment-text"]) {
      byId(id).addEventListener("keydown", (event) => { if (event.key === "Escape") byId(id).blur(); });
    }
  }

  get isShown() {
    return this.state.view === "team";
  }

  get mayReview() {
    return this.state.workspace.role === "review";
  }

  /** The frames of the chosen part of the queue. */
  get queue() {
    return this.known?.queue.filter(({ state }) => state === this.listed) ?? [];
  }

  /** The frame on screen, if it is in the queue. */
  get entry() {
    return this.known?.queue.find(({ frame }) => frame === this.state.frame) ?? null;
  }

  entered() {
    this.asked = -1;
    this.state.set({});
  }

  /** Commands for `Keys`.
   *
   * @returns {Command[]}
   */
  commands() {
    const group = "Team", view = "team", row = "Next, previous in the queue";
    return [
      { key: ".", shift: true, view, group, row, title: "Next in the queue", run: () => this.step(1) },
      { key: ",", shift: true, view, group, row, title: "Previous in the queue", run: () => this.step(-1) },
      { key: "Enter", view, group, title: "Accept the frame", run: () => this.accept() },
      { key: "n", shift: true, view, group, title: "Send the frame back", words: "reject refuse", run: () => this.sendBack() },
      { key: "i", shift: true, view, group, title: "Pin a comment on an element", words: "note", run: () => byId("team-comment-text").focus() },
      { key: "g", shift: true, view, group, title: "Assign a range of frames", run: () => byId("team-frames").focus() },
      { key: "Escape", view, group, title: "Back to the images", run: () => this.page.views.open("images") },
    ];
  }

  /** Goes to another frame of the queue.
   *
   * @param {1 | -1} by
   */
  step(by) {
    const { queue } = this;
    if (!queue.length) return;
    const now = this.state.frame ?? -1;
    const next = by > 0 ? queue.find(({ frame }) => frame > now) ?? queue[0] : queue.findLast(({ frame }) => frame < now) ?? queue[queue.length - 1];
    this.page.go(next.frame);
  }

  accept() {
    this.#decide("accept frame");
  }

  sendBack() {
    const { entry } = this;
    if (entry && !entry.notes.length) this.page.notify("Say what is wrong: pin a comment first.", "wrong");
    else this.#decide("send back");
  }

  /** @param {"accept frame" | "send back"} kind */
  #decide(kind) {
    const { entry, page } = this;
    if (!this.mayReview) page.notify("Only who reviews accepts frames and sends them back.", "wrong");
    else if (entry?.state !== "waiting") page.notify("This frame does not wait for a reviewer.", "wrong");
    else {
      page.submit({ kind, frame_index: entry.frame });
      this.step(1);
    }
  }

  /** @param {SubmitEvent} event */
  #assign(event) {
    event.preventDefault();
    const field = byId("team-frames", HTMLInputElement);
    const range = field.value.trim().match(/^(\d+)\s*[-–:]\s*(\d+)$/);
    const frames = range ? /** @type {[number, number]} */ ([Number(range[1]), Number(range[2])]) : null;
    if (!frames && field.value.trim().toLowerCase() !== "none") {
      this.page.notify("Frames as 0-309, or “none” to take all away.", "wrong");
      return;
    }
    const person = byId("team-person", HTMLSelectElement).value;
    if (this.page.socket.send("assign_frames", { person, frames })) field.value = "";
    field.blur();
  }

  /** @param {SubmitEvent} event */
  #comment(event) {
    event.preventDefault();
    const field = byId("team-comment-text", HTMLInputElement);
    const element = byId("team-element", HTMLSelectElement).value;
    const text = field.value.trim();
    if (!element || !text) {
      this.page.notify(element ? "Write the comment first." : "There is no element in this frame to pin it on.", "wrong");
      return;
    }
    this.page.submit({ kind: "note", note_id: uuid7(), element_id: element, frame_index: this.state.frame, unsure: false, text });
    field.value = "";
    field.blur();
  }

  /** Redraws; called whenever the state of the page changes. */
  show() {
    if (!this.isShown) return;
    this.#refresh();
    const { known, cache, state } = this;
    const { frame } = state;
    byId("team-assign").hidden = !this.mayReview;
    cache.show("team-people", [known?.people, this.page.people.known], () => this.#people());
    cache.show("team-person", known?.people.map(({ name }) => name), () => known?.people.map(({ name }) => el("option", { value: name, text: name })) ?? []);
    cache.show("team-chips", [known?.queue.length, this.listed, this.#counts()], () => this.#chips());
    cache.show("team-queue", [this.queue, frame], () => this.#queue());
    cache.show("team-head", [this.entry, frame], () => this.#head());
    cache.show("team-notes", [this.entry], () => this.#notes());
    const names = state.elements.map(({ id, name }) => ({ id, name }));
    cache.show("team-element", names, () => names.map(({ id, name }) => el("option", { value: id, text: name })));
    cache.show("team-hints", 0, () => this.#hints());
    this.picture.show(frame, this.entry);
  }

  /** Asks for the work of all, at most once a second, after the labels changed. */
  #refresh() {
    const { operation } = this.state.labels;
    if (operation === this.asked || this.timer) return;
    this.asked = operation;
    this.page.socket.send("show_team", {});
    this.timer = setTimeout(() => {
      this.timer = undefined;
      this.show();
    }, REFRESH_MS);
  }

  #counts() {
    return STATES.map((state) => this.known?.queue.filter((entry) => entry.state === state).length ?? 0);
  }

  /** @returns {Child[]} */
  #people() {
    const { known } = this;
    if (!known) return [el("p", { class: "dim team-text", text: "Reading …" })];
    const count = this.state.order.length;
    const about = known.people.length > 1 ? `${spaced(count)} frames, ${known.people.length} people` : "";
    const alone = `You label alone. In a terminal: semviz annotate ${this.state.workspace.name} --invite NAME makes an address to send.`;
    return [
      header("Who has what", about),
      ...known.people.map((person) => this.#person(person)),
      known.people.length > 1 ? null : el("p", { class: "dim team-text", text: alone }),
    ];
  }

  /** @param {annotator.TeamPerson} person */
  #person({ name, ranges, assigned, reviewed, pace, edits, last }) {
    const here = this.page.people.known.find((one) => one.name === name)?.frames ?? [];
    const isMe = name === this.state.workspace.author;
    const where = here.length ? `frame ${here.join(", ")}` : last ? `last edit ${new Date(last).toLocaleString([], WHEN)}` : "away";
    return el("div", { class: isMe ? "team-person chosen" : "team-person" },
      el("div", { class: "team-name" }, el("b", { text: isMe ? `${name}, you` : name }), el("span", { class: "dim", text: where })),
      el("div", { class: "team-done" }, el("b", { text: assigned ? `${reviewed} / ${assigned}` : `${reviewed}` }), el("span", { class: "dim", text: `${spaced(edits)} ${edits === 1 ? "edit" : "edits"}, ${pace} in 8 h` })),
      this.#bar(ranges, here));
  }

  /** Assigned frames, how many of them are reviewed, and where somebody is.
   *
   * @param {[number, number][]} ranges
   * @param {number[]} here
   */
  #bar(ranges, here) {
    const { order, labels } = this.state;
    const places = new Map(order.map((index, place) => [index, place]));
    const inside = (/** @type {number} */ index) => ranges.some(([first, last]) => index >= first && index <= last);
    const cells = labels.frames.filter(({ index }) => inside(index));
    const rect = (/** @type {number} */ index, /** @type {string} */ kind) =>
      svg("rect", { class: kind, x: places.get(index) ?? 0, y: 2, width: 1.02, height: 8 });
    return svg("svg", { class: "team-bar", viewBox: `0 0 ${Math.max(order.length, 1)} 12`, preserveAspectRatio: "none" },
      svg("rect", { class: "track", x: 0, y: 5.5, width: order.length, height: 1 }),
      ...cells.map(({ index, state }) => rect(index, state.startsWith("reviewed") ? "done" : state === "in work" ? "work" : "open")),
      ...here.map((index) => svg("rect", { class: "here", x: places.get(index) ?? 0, y: 0, width: Math.max(1, order.length / 200), height: 12 })));
  }

  #chips() {
    const counts = this.#counts();
    return STATES.map((state, at) => el("button", { class: "chip", "aria-pressed": String(state === this.listed), onclick: () => {
      this.listed = state;
      this.state.set({});
    } }, `${capital(state)} `, el("b", { text: counts[at] })));
  }

  /** @returns {Child[]} */
  #queue() {
    const [, , accepted] = this.#counts();
    if (!this.queue.length) {
      const text = this.listed === "waiting" ? `Nothing waits. ${accepted} accepted.` : `No frame is ${this.listed}.`;
      return [el("p", { class: "dim team-text", text })];
    }
    return this.queue.map(({ frame, person, elements, stands_out: what, notes, time }) =>
      row({ chosen: frame === this.state.frame, onclick: () => this.page.go(frame) },
        el("b", { class: "team-frame", text: frame }), el("span", { class: "team-who", text: person }), el("span", { class: "dim team-count", text: elements }),
        el("span", { class: "fill" }, what ? el("span", { class: "warning", text: "◆ " }) : null, what || "–"),
        notes.length ? el("span", { text: counted(notes.length, "comment") }) : null,
        el("span", { class: "dim", title: time, text: new Date(time).toLocaleTimeString([], { hour: "2-digit", minute: "2-digit" }) })));
  }

  /** @returns {Child[]} */
  #head() {
    const { entry, keys } = this;
    const { frame } = this.state;
    if (!entry) return [el("h2", { text: `Frame ${frame}` }), el("span", { class: "about", text: "not in the queue: not reviewed yet" })];
    const buttons = entry.state === "waiting" && this.mayReview ? [
      el("button", { class: "small push", onclick: () => this.accept() }, "Accept ", badge(keys, "Enter")),
      el("button", { class: "small", onclick: () => this.sendBack() }, "Send back ", badge(keys, "Shift N")),
    ] : [el("span", { class: "push dim", text: entry.state })];
    return [el("h2", { text: `Frame ${frame}` }), el("span", { class: "about", text: `${entry.person}, ${entry.elements} elements` }), ...buttons];
  }

  /** @returns {Child[]} */
  #notes() {
    const { entry } = this;
    if (!entry) return [];
    const notes = entry.notes.map(({ id, name, author, text, unsure, time }) => el("div", { class: "track-note" },
      el("p", { class: "dim" }, el("b", { text: `on ${name}` }), ` ${author}`, el("span", { class: "push", text: new Date(time).toLocaleString() }),
        el("button", { class: "small", "aria-label": "Delete this comment", title: "Answered: delete this comment", onclick: () => this.page.submit({ kind: "delete note", note_id: id }) }, "✕")),
      el("p", { text: text || (unsure ? "unsure" : "") })));
    const sent = "Sent back, the frame is in work again. The comments stay on their elements until they are answered.";
    return [...notes, el("p", { class: "dim team-text", text: entry.state === "sent back" ? sent : "" })];
  }

  #hints() {
    const hint = (/** @type {string[]} */ names, /** @type {string} */ text) => el("span", { class: "hint" }, ...names.map((name) => badge(this.keys, name)), ` ${text}`);
    return [hint(["Shift ."], "next in the queue"), hint(["Enter"], "accept"), hint(["Shift N"], "send back"), hint(["Shift I"], "pin a comment"), hint(["Shift G"], "assign frames"), hint(["F2"], "open in Images")];
  }
}
