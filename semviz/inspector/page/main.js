// @ts-check
/* The inspector's page: the server holds the state, and each panel draws its part. */

import { byId, el } from "/static/dom.js";
import { showHelp } from "/static/help.js";
import { Keys } from "/static/keys.js";
import { showPalette } from "/static/palette.js";
import { showScene } from "/static/scene.js";
import { PageSocket } from "/static/socket.js";
import { currentTheme, startTheme, switchTheme } from "/static/theme.js";
import { Address, numberOf, oneOf, textOf, wholeNumber } from "./address.js";
import { Backdrop } from "./space/backdrop.js";
import { Bar } from "./bar.js";
import { Compare } from "./compare/compare.js";
import { DecisionList } from "./decisions.js";
import { ElementList } from "./elements.js";
import { Exporter } from "./exporting/export.js";
import { Forecast } from "./forecast.js";
import { FrameList } from "./frames.js";
import { ImagePanel } from "./image/image.js";
import { LabelEdits } from "./label_edits.js";
import { MatrixPanel } from "./matrix/matrix.js";
import { Neighbours } from "./neighbours.js";
import { OverTime } from "./over_time/over_time.js";
import { openRun } from "./run_rows.js";
import { SelectedCard } from "./selected.js";
import { SolverCard } from "./solver/solver.js";
import { SpacePanel } from "./space/space.js";
import { Store } from "./store.js";
import { Story } from "./story/story.js";
import { Tabs } from "./tabs.js";
import { Timeline } from "./timeline/timeline.js";
import { Viewpoints } from "./space/viewpoints.js";
import { Views } from "./views.js";
import { WhatIf } from "./what_if.js";
import { WhyCard } from "./why.js";

/** @typedef {import("/static/protocol").inspector.FrameView} FrameView */
/** @typedef {import("/static/protocol").inspector.ReadingEvent} ReadingEvent */
/** @typedef {import("/static/protocol").inspector.StateView} StateView */
/** @typedef {import("/static/protocol").inspector.Requests} Requests */
/** @typedef {import("/static/protocol").inspector.Events} Events */
/** @typedef {import("/static/keys.js").Command} Command */
/** @typedef {import("./panel.js").AddressPart} AddressPart */
/** @typedef {import("./panel.js").Panel} Panel */
/** @typedef {import("./run_rows.js").OpenRun} OpenRun */

const POINT_DELAY_MS = 50; // a frame that arrives sooner is painted once, not twice
const OPENING_MS = 400; // a run that opens sooner needs no notice
const PLAY_INTERVAL_MS = 60; // between frames

export class Page {
  constructor() {
    startTheme(() => this.#showTheme());
    this.store = new Store();
    this.session = ""; // of the 3D scene
    /** @type {import("/static/scene.js").RenderGate | null} */
    this.scene = null;
    /** @type {ReturnType<typeof setTimeout> | null} */
    this.pointing = null;
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.opening = undefined;
    /** @type {PageSocket<Requests, Events>} */
    this.socket = new PageSocket();
    this.image = new ImagePanel(this, () => this.imagePainted());
    this.list = new FrameList(this);
    this.compare = new Compare(this);
    this.views = new Views(this);
    this.left = new Tabs(byId("frames"), () => this.tabChanged());
    this.right = new Tabs(byId("why"), () => this.tabChanged());
    /** @type {Panel[]} */
    this.panels = [
      new Bar(this),
      this.list,
      new ElementList(this),
      new DecisionList(this),
      new SpacePanel(this),
      new Viewpoints(this),
      new Backdrop(this),
      new Forecast(this),
      this.image,
      new Neighbours(this),
      new WhyCard(),
      new WhatIf(this),
      new SelectedCard(this),
      new SolverCard(this),
      new LabelEdits(this),
      new MatrixPanel(this),
      new Timeline(this),
      this.compare,
      ...this.compare.panels,
      new Story(this),
      new OverTime(this),
      this.views,
      new Exporter(this),
    ];
    this.address = new Address(this, [...this.ownAddress(), ...this.panels.flatMap((panel) => panel.address?.() ?? [])]);
    this.keys = new Keys("inspect", this.views.ofFrame(this.commands()));
    this.keys.enter = (view) => this.views.open(view === "over-time" ? view : "frame");
    this.keys.listen(window);
    this.subscribe();
  }

  /* From the server */

  /** Called after the panels have subscribed, so that their handlers run first. */
  subscribe() {
    const { socket } = this;
    socket.onConnection((connected) => this.showConnection(connected));
    socket.on("hello", ({ session }) => this.startSession(session));
    socket.on("runs", ({ names }) => this.showRuns(names));
    socket.on("scene", () => this.showScene());
    socket.on("reading", (event) => this.showReading(event));
    socket.on("run", ({ run }) => this.showRun(openRun(run)));
    socket.on("frame", ({ frame, state }) => this.showFrame(frame, state));
    socket.on("state", ({ state }) => this.changeState(state));
    socket.on("selection", () => { if (!this.store.isStepping) this.release(); });
    socket.on("error", ({ text }) => this.showError(text));
  }

  /** @param {string} session a new one has no state of this page */
  startSession(session) {
    this.isNew = session !== this.session;
    this.session = session;
    if (this.isNew) this.scene = null;
  }

  /** @param {string[]} names */
  showRuns(names) {
    this.store.names = names;
    if (this.isNew) this.address.open();
    this.isNew = false;
  }

  /** @param {string} text */
  showError(text) {
    clearTimeout(this.opening);
    this.notice(text);
    this.address.cancel();
    this.store.cancel();
    this.forEachPanel((panel) => panel.showRefusal?.());
  }

  showScene() {
    this.scene ??= showScene(byId("scene", HTMLIFrameElement), this.session, this.keys);
  }

  /** @param {boolean} connected */
  showConnection(connected) {
    if (connected) this.notice("");
    else this.notice("Offline: the server does not answer. This page reconnects by itself.", true);
    this.store.waiting = false;
  }

  /** A run without a table is read through: says how far, until it arrives or is refused.
   *
   * @param {ReadingEvent} event
   */
  showReading({ name, step, share }) {
    clearTimeout(this.opening);
    this.notice(`Opening ${name}: ${step}, ${Math.round(100 * share)} %`, true);
  }

  /** @param {OpenRun} run */
  showRun(run) {
    clearTimeout(this.opening);
    this.store.run = run;
    this.notice(run.note, true);
    this.forEachPanel((panel) => panel.showRun?.(run));
  }

  /**
   * @param {FrameView} frame
   * @param {StateView} state
   */
  showFrame(frame, state) {
    this.stopPointing();
    if (this.store.receive(frame)) this.go(this.store.target);
    this.forEachPanel((panel) => panel.showFrame?.(frame));
    this.showState(state);
    this.address.apply();
  }

  /** A new selection shows its card before its ring in 3D.
   *
   * @param {StateView} state
   */
  changeState(state) {
    const { observed, element } = this.store.state;
    if (state.observed !== observed || state.element !== element) this.scene?.hold(false);
    this.showState(state);
  }

  /** @param {StateView} state */
  showState(state) {
    this.store.state = state;
    this.forEachPanel((panel) => panel.showState?.(state));
    this.address.changed();
  }

  imagePainted() {
    const { store } = this;
    this.forEachPanel((panel) => panel.imagePainted?.());
    if (!store.hasArrived) return;
    if (this.image.frame !== store.frame) return; // its image has not arrived
    const now = performance.now();
    performance.measure("frame switch", { start: now - store.finishStep(now), end: now });
    if (store.drawn !== store.target) this.draw();
    requestAnimationFrame(() => this.scene?.release()); // after the image
    if (store.playing) setTimeout(() => store.playing && this.step(1), PLAY_INTERVAL_MS);
  }

  /* To the server */

  /**
   * @param {string | null} run null for the first one
   * @param {number | null} frame its number; null for the worst one
   */
  open(run, frame) {
    this.socket.send("open_run", { run, frame, theme: currentTheme() });
    clearTimeout(this.opening);
    this.opening = setTimeout(() => this.notice(`Opening ${run ?? this.store.names[0] ?? ""}…`, true), OPENING_MS);
  }

  /** @param {number} position */
  go(position) {
    const { store } = this;
    if (!store.isOpen) return;
    const isFast = store.isStepping;
    store.setTarget(position, performance.now());
    if (!store.waiting && store.target !== store.position) {
      store.waiting = this.socket.send("go_to_position", { position: store.target });
      if (isFast) store.drawn = null; // skipped frames are not drawn in 3D
      else this.draw(); // while the image is painted
    }
    this.pointing ??= setTimeout(() => this.pointPanels(), POINT_DELAY_MS);
  }

  /** The panels show the target frame before it arrives. */
  pointPanels() {
    this.pointing = null;
    this.forEachPanel((panel) => panel.pointAt?.(this.store.target));
  }

  stopPointing() {
    if (this.pointing !== null) clearTimeout(this.pointing);
    this.pointing = null;
  }

  /** Lets the 3D pane draw again, one frame after the next paint of the page. */
  release() {
    requestAnimationFrame(() => requestAnimationFrame(() => this.scene?.release()));
  }

  /** Requests the frame in 3D. */
  draw() {
    this.store.drawn = this.store.target;
    this.scene?.hold(true);
    this.socket.send("draw_frame");
  }

  /** @param {number} by */
  step(by) {
    this.go(this.store.target + by);
  }

  /** Selects a detection, an element, both as a pair, or nothing.
   *
   * @param {{observed?: number | null, element?: number | null}} [selection]
   */
  select({ observed = null, element = null } = {}) {
    this.socket.send("select", { observed, element });
  }

  /** @param {StateView["view"]} view */
  setView(view) {
    this.socket.send("set_view", { view });
  }

  /* On the page alone */

  /** Parts of the address that belong to no panel.
   *
   * @returns {AddressPart[]}
   */
  ownAddress() {
    const { store, left, right } = this;
    /** @param {Tabs} tabs */
    const names = (tabs) => oneOf(...tabs.names);
    return [
      {
        fields: { element: wholeNumber(), seen: wholeNumber() },
        get: () => ({ element: textOf(store.state.element), seen: textOf(store.state.observed) }),
        set: ({ element, seen }) => this.select({ element: numberOf(element), observed: numberOf(seen) }),
      },
      {
        fields: { list: names(left), card: names(right) },
        get: () => ({ list: left.shown, card: right.shown }),
        set: ({ list, card }) => { left.show(list); right.show(card); },
      },
    ];
  }

  tabChanged() {
    this.forEachPanel((panel) => panel.showTabs?.());
    this.address.changed();
  }

  /** @returns {Command[]} */
  commands() {
    const { store, socket } = this;
    /** @type {(key: string, title: string, run: () => void, shift?: boolean) => Command} */
    const step = (key, title, run, shift = false) => ({ key, shift, title, run, group: "Frames" });
    /** @type {(key: string, title: string, run: () => void) => Command} */
    const from = (key, title, run) => ({ key, title, run, group: "3D" });
    return [
      step(",", "Previous frame", () => this.step(-1)),
      step(".", "Next frame", () => this.step(1)),
      step(",", "Previous row of the worst-first list", () => this.shownList().step(-1), true),
      step(".", "Next row of the worst-first list", () => this.shownList().step(1), true),
      step("j", "Go to a frame by number", () => this.openFrameDialog()),
      step(" ", "Play or stop", () => this.play()),
      from("b", "View from behind the vehicle", () => this.setView("behind")),
      from("l", "View through the camera", () => this.setView("camera")),
      from("u", "View from above", () => this.setView("above")),
      from("g", "Alternative poses", () => socket.send("show_alternatives", { shown: !store.state.alternatives })),
      { key: "Tab", group: "Selection", title: "Next detection", run: () => this.selectNext(1) },
      { key: "Tab", shift: true, group: "Selection", title: "Previous detection", run: () => this.selectNext(-1) },
      { key: "Escape", group: "Selection", title: "Clear the selection; close the comparison", run: () => this.escape() },
      ...this.panels.flatMap((panel) => panel.commands?.() ?? []),
      { key: "h", group: "Page", title: "Next tab: frames, elements, map", run: () => this.left.next() },
      { key: "i", group: "Page", title: "Next tab: why, selected, solver, what if", run: () => this.right.next() },
      { key: "t", group: "Page", title: "Dark or light theme", run: () => this.switchTheme() },
      { key: "k", ctrl: true, group: "Page", title: "All commands", run: () => showPalette(this.keys) },
      { key: "?", group: "Page", title: "This help", run: () => this.help() },
    ];
  }

  /** @param {(panel: Panel) => void} call */
  forEachPanel(call) {
    this.panels.forEach(call);
  }

  /**
   * @param {string} text
   * @param {boolean} mild
   */
  notice(text, mild = false) {
    const box = byId("notice");
    box.textContent = text;
    box.classList.toggle("mild", mild);
    box.hidden = !text;
  }

  play() {
    this.store.playing = !this.store.playing;
    if (this.store.playing) this.step(1);
  }

  /** @param {number} by */
  selectNext(by) {
    const { store } = this;
    const count = store.hasFrame ? store.frame.observed.length : 0;
    if (!count) return;
    const now = store.state.observed;
    const next = now === null ? (by > 0 ? 0 : count - 1) : (now + by + count) % count;
    this.select({ observed: next });
  }

  shownList() {
    return this.compare.isOpen ? this.compare.frames : this.list;
  }

  escape() {
    if (this.compare.isOpen) this.compare.close();
    else this.select();
  }

  switchTheme() {
    switchTheme();
    this.#showTheme();
  }

  #showTheme() {
    this.socket.send("set_theme", { theme: currentTheme() });
    this.forEachPanel((panel) => panel.showTheme?.());
  }

  help() {
    showHelp(this.keys, "Keys of the inspector");
  }

  openFrameDialog() {
    const { store } = this;
    const input = el("input", { type: "number", value: store.hasFrame ? store.frame.index : 0, "aria-label": "Frame number" });
    const dialog = el("dialog", { class: "help ask" }, el("h2", { text: "Go to frame" }),
      el("form", { method: "dialog" }, input));
    dialog.addEventListener("close", () => {
      const position = store.run.frames.findIndex((row) => row.index === Number(input.value));
      if (dialog.returnValue !== "cancel" && position >= 0) this.go(position);
      dialog.remove();
    });
    dialog.addEventListener("cancel", () => { dialog.returnValue = "cancel"; });
    document.body.append(dialog);
    dialog.showModal();
    input.select();
  }
}

new Page();
