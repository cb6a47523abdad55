// @ts-check
// The view "Team": who has what, the frames that wait for a reviewer, and one of them with its comments.
/** @import {annotator} from "/static/protocol" */
/** @import {Command, Keys} from "/static/keys.js" */
/** @import {Child} from "/static/dom.js" */
/** @import {Page} from "../main.js" */
/** @import {State} from "../state.js" */
import { byId, el } from "/static/dom.js";
import { VirtualList } from "/static/virtual_list.js";
import { Compared } from "./compared.js";
import { Feed } from "../history/feed.js";
import { Shares } from "./shares.js";
import { peopleRows } from "./team_people.js";
import { TeamPicture } from "./team_picture.js";
import { counted, rangeOf, uuid7 } from "../values.js";
import { RenderCache, badge, capital, row } from "../panels/widgets.js";

/** @typedef {annotator.QueueEntry["state"] | "unsure" | "twice"} Listed */
/** @type {Listed[]} */
const LISTS = ["waiting", "sent back", "accepted", "unsure", "twice"];
const ROW_PX = 28;
const REFRESH_MS = 1000;

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
    /** @type {Listed} */
    this.listed = "waiting"; // the part of the queue on screen
    this.versions = false; // whether the version of the frame before is shown, too
    this.asked = -1; // the operation after which the team was requested
    /** @type {unknown[]} */
    this.shownQueue = []; // what the list was made of
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.timer = undefined;
    this.picture = new TeamPicture(state, page.pictures);
    this.shares = new Shares(state, page);
    this.compared = new Compared(state, page);
    this.feed = new Feed(page);
    /** @type {annotator.QueueEntry[]} */
    this.rows = [];
    this.list = new VirtualList(byId("team-queue"), ROW_PX, (at) => this.#row(this.rows[at]));
    page.socket.on("team", ({ team, shares }) => {
      this.known = team;
      this.shares.known = shares;
      state.set({});
    });
    page.socket.on("people", () => { this.asked = -1; });
    byId("team-assign", HTMLFormElement).addEventListener("submit", (event) => this.#assign(event));
    byId("team-comment", HTMLFormElement).addEventListener("submit", (event) => this.#comment(event));
    for (const id of ["team-frames", "team-comment-text", "twice-frames", "twice-percent"]) {
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
    return this.#entriesOf(this.listed);
  }

  /** The frame on screen, if it is in the queue. */
  get entry() {
    return this.known?.queue.find(({ frame }) => frame === this.state.frame) ?? null;
  }

  /** Frames of the chosen list. */
  get listedFrames() {
    return this.listed === "twice" ? this.shares.ready : this.queue.map(({ frame }) => frame);
  }

  /** @param {Listed} list */
  #entriesOf(list) {
    const has = (/** @type {annotator.QueueEntry} */ { state, notes }) => (list === "unsure" ? notes.some(({ unsure }) => unsure) : state === list);
    return this.known?.queue.filter(has) ?? [];
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
      { key: "Enter", view, group, title: "Accept the frame; merge one that two people labelled", words: "merge", run: () => this.accept() },
      { key: "n", shift: true, view, group, title: "Send the frame back", words: "reject refuse", run: () => this.sendBack() },
      { key: "i", shift: true, view, group, title: "Pin a comment on an element", words: "note", run: () => byId("team-comment-text").focus() },
      { key: "g", shift: true, view, group, title: "Assign a range of frames", run: () => byId("team-frames").focus() },
      { key: "t", shift: true, view, group, title: "Let two people label a share of frames, blind", words: "double twice agreement", run: () => byId("twice-frames").focus() },
      { key: "j", shift: true, view, group, title: "The frame labelled twice with the worst disagreement; again: the next", words: "merge compare", run: () => this.nextTwice() },
      { key: "z", view, group, title: "Zoom to the comment or what stands out, or the whole image", words: "pin magnify", run: () => this.picture.toggleZoom() },
      { key: "v", view, group, title: "The version before beside the present one", words: "compare two versions conflict", run: () => this.toggleVersions() },
      { key: "ArrowDown", view, group, row: "Next, previous element of two versions", title: "Next element of two versions", run: () => this.compared.step(1) },
      { key: "ArrowUp", view, group, row: "Next, previous element of two versions", title: "Previous element of two versions", run: () => this.compared.step(-1) },
      { key: "y", view, group, title: "Take the first person's label", run: () => this.page.answer(0) || this.compared.take("first") },
      { key: "y", shift: true, view, group, title: "Take the second person's label", run: () => this.page.answer(1) || this.compared.take("second") },
      { key: "m", view, group, title: "Take the mean of both labels", run: () => this.compared.take("mean") },
      { key: "x", view, group, title: "Take neither label", run: () => this.compared.take("none") },
      { key: "Escape", view, group, title: "Back to the images", run: () => this.page.views.open("images") },
    ];
  }

  /** Goes to another frame of the queue.
   *
   * @param {1 | -1} by
   */
  step(by) {
    const { listedFrames: frames } = this;
    if (!frames.length) return;
    const now = this.state.frame ?? -1;
    this.page.go(by > 0 ? frames.find((frame) => frame > now) ?? frames[0] : frames.findLast((frame) => frame < now) ?? frames[frames.length - 1]);
  }

  /** Goes to the frame labelled twice whose labels are farthest apart, again: to the next. */
  nextTwice() {
    this.listed = "twice";
    this.state.set({});
    const { worstFirst } = this.shares;
    if (!worstFirst.length) this.page.notify("No frame is ready to be merged: two people review it first.", "wrong");
    this.page.go(worstFirst[worstFirst.indexOf(this.state.frame ?? -1) + 1] ?? worstFirst[0] ?? null);
  }

  toggleVersions() {
    this.versions = !this.versions;
    this.state.set({});
  }

  accept() {
    if (!this.compared.shown?.is_blind) this.#decide("accept frame");
    else if (this.compared.merge()) this.step(1);
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
    const frames = rangeOf(field.value);
    if (!frames && field.value.trim().toLowerCase() !== "none") {
      this.page.notify(`Frames as ${this.state.wholeDrive}, or “none” to take all away.`, "wrong");
      return;
    }
    const person = byId("team-person", HTMLSelectElement).value;
    if (this.page.ask("assign_frames", { person, frames })) field.value = "";
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
    byId("team-twice").hidden = !this.mayReview || (known?.people.length ?? 0) < 2;
    byId("team-frames", HTMLInputElement).placeholder = `${state.wholeDrive} or none`;
    byId("twice-frames", HTMLInputElement).placeholder = state.wholeDrive;
    byId("team-comment").hidden = state.workspace.role === "look";
    const isReady = frame !== null && this.shares.ready.includes(frame);
    this.compared.ask(this.mayReview && (isReady || this.versions) ? frame : null, state.labels.operation);
    cache.show("team-people", [known?.people, known?.reviewed, known?.done_on, this.shares.known, this.page.people.known, state.selected?.element, state.connected], () => (known ? peopleRows(this, known) : [el("p", { class: "dim team-text", text: reading(state.connected) })]));
    for (const id of ["team-person", "twice-first", "twice-second"]) {
      const before = byId(id, HTMLSelectElement).value;
      cache.show(id, known?.people.map(({ name }) => name), () => known?.people.map(({ name }, at) => el("option", { value: name, text: name, selected: name === before || (!before && id === "twice-second" && at === 1) ? "" : null })) ?? []);
    }
    cache.show("team-chips", [known?.queue.length, this.listed, this.#counts()], () => this.#chips());
    this.#showQueue();
    cache.show("team-head", [this.entry, frame, this.versions, this.compared.shown], () => this.#head());
    cache.show("team-notes", [this.entry], () => this.#notes());
    const wanted = (/** @type {{id: string, name: string}} */ { id, name }) => Number(this.entry?.notes.some(({ element }) => element === id)) || Number(this.entry?.stands_out.startsWith(name) ?? 0);
    const names = state.elements.map(({ id, name }) => ({ id, name })).sort((a, b) => wanted(b) - wanted(a));
    cache.show("team-element", names, () => names.map(({ id, name }) => el("option", { value: id, text: name })));
    cache.show("team-hints", [this.compared.shown?.is_blind ? this.compared.shown.people : 0, this.entry?.person, this.page.people.followed], () => this.#hints());
    byId("team").classList.toggle("twice", this.listed === "twice");
    this.compared.show();
    this.feed.show();
    this.picture.show(frame, this.entry, byId("team-element", HTMLSelectElement).value);
  }

  /** Shows the chosen list: thousands of frames, of which those in sight are in the page. */
  #showQueue() {
    const { listed, known, state } = this;
    const shown = [known, listed, state.theme, state.connected, listed === "twice" ? state.frame : 0];
    if (shown.some((value, at) => value !== this.shownQueue[at])) {
      this.shownQueue = shown;
      this.rows = listed === "twice" ? [] : this.queue;
      this.list.show(this.rows.length);
      if (!this.rows.length) byId("team-queue").replaceChildren(...this.#instead());
    }
    this.list.mark(this.rows.findIndex(({ frame }) => frame === state.frame));
  }

  /** What the list shows without rows.
   *
   * @returns {Node[]}
   */
  #instead() {
    if (this.listed === "twice") return /** @type {Node[]} */ (this.shares.rows());
    const [, , accepted] = this.#counts();
    const text = this.known === null ? reading(this.state.connected) : this.listed === "waiting" ? `Nothing waits. ${accepted} accepted.` : `No frame is ${this.listed}.`;
    return [el("p", { class: "dim team-text", text })];
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
    return LISTS.map((list) => (list === "twice" ? this.shares.ready.length : this.#entriesOf(list).length));
  }

  #chips() {
    const counts = this.#counts();
    return LISTS.map((list, at) => el("button", { class: "chip", "aria-pressed": String(list === this.listed), onclick: () => {
      this.listed = list;
      byId("team-queue").scrollTop = 0;
      this.state.set({});
    } }, `${capital(list)} `, el("b", { text: counts[at] })));
  }

  /** @param {annotator.QueueEntry} entry */
  #row({ frame, person, elements, stands_out: what, notes, time }) {
    return row({ onclick: () => this.page.go(frame) },
      el("b", { class: "team-frame", text: frame }), el("span", { class: "team-who", text: person }), el("span", { class: "dim team-count", text: elements }),
      el("span", { class: "fill" }, what ? el("span", { class: "warning", text: "◆ " }) : null, what || "–"),
      notes.length ? el("span", { text: counted(notes.length, "comment") }) : null,
      el("span", { class: "dim", title: time, text: new Date(time).toLocaleTimeString([], { hour: "2-digit", minute: "2-digit" }) }));
  }

  /** @returns {Child[]} */
  #head() {
    const { entry, keys } = this;
    const { frame } = this.state;
    const { shown } = this.compared;
    if (shown?.is_blind) {
      return [el("h2", { text: `Frame ${frame}` }), el("span", { class: "about", text: `labelled twice: ${shown.people.join(" and ")}` }),
        el("button", { class: "small push", onclick: () => this.accept() }, "Merge ", badge(keys, "Enter"))];
    }
    const versions = this.mayReview ? el("button", { class: "small push", "aria-pressed": String(this.versions), onclick: () => this.toggleVersions() }, "Two versions ", badge(keys, "V")) : null;
    if (!entry) return [el("h2", { text: `Frame ${frame}` }), el("span", { class: "about", text: "not in the queue: not reviewed yet" }), versions];
    const buttons = entry.state === "waiting" && this.mayReview ? [
      el("button", { class: "small", onclick: () => this.accept() }, "Accept ", badge(keys, "Enter")),
      el("button", { class: "small", onclick: () => this.sendBack() }, "Send back ", badge(keys, "Shift N")),
    ] : [el("span", { class: "dim", text: entry.state })];
    return [el("h2", { text: `Frame ${frame}` }), el("span", { class: "about", text: `${entry.person}, ${counted(entry.elements, "element")}` }), versions, ...buttons];
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
    const { shown } = this.compared;
    if (shown?.is_blind) {
      const [first, second] = shown.people;
      return [hint(["↓"], "next element"), hint(["Y"], first), hint(["Shift Y"], second), hint(["M"], "mean"), hint(["X"], "neither"), hint(["Enter"], "merge"), hint(["Shift J"], "next labelled twice")];
    }
    const { followed } = this.page.people;
    return [hint(["Shift ."], "next in the queue"), hint(["Enter"], "accept"), hint(["Shift N"], "send back"), hint(["Shift I"], "pin a comment"), hint(["Z"], "zoom to the pin"), hint(["V"], "two versions"), hint(["F2"], "open in Images"), hint(["Shift L"], followed ? `stop following ${followed}` : "follow"), hint(["Shift G"], "assign frames"), hint(["Shift T"], "label twice")];
  }
}

/** What stands where the work of all is still to come. */
const reading = (/** @type {boolean} */ connected) => (connected ? "Reading …" : "No connection. This loads when the server is back.");
