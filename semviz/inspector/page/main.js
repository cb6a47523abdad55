/* The inspector's page: the server holds the state, each panel draws its part of it. */

import { byId, el } from "/static/dom.js";
import { showHelp } from "/static/help.js";
import { Keys } from "/static/keys.js";
import { showPalette } from "/static/palette.js";
import { showScene } from "/static/scene.js";
import { Socket } from "/static/socket.js";
import { currentTheme, startTheme, switchTheme } from "/static/theme.js";
import { Address, numberOf, oneOf, textOf, whole } from "./address.js";
import { Bar } from "./bar.js";
import { Compare } from "./compare/compare.js";
import { DecisionList } from "./decisions.js";
import { ElementList } from "./elements.js";
import { Exporter } from "./exporting/export.js";
import { Forecast } from "./forecast.js";
import { FrameList } from "./frames.js";
import { ImagePanel } from "./image.js";
import { MatrixPanel } from "./matrix.js";
import { Mending } from "./mending.js";
import { Neighbours } from "./neighbours.js";
import { SelectedCard } from "./selected.js";
import { SolverCard } from "./solver.js";
import { SpacePanel } from "./space.js";
import { Tabs } from "./tabs.js";
import { Timeline } from "./timeline.js";
import { Viewpoints } from "./viewpoints.js";
import { WhatIf } from "./what_if.js";
import { WhyCard } from "./why.js";

const POINTED_MS = 50; // a frame that comes sooner is painted once, not twice

class Page {
  constructor() {
    startTheme();
    this.run = null;
    this.frame = null;
    this.state = { observed: null, element: null, view: "behind", alternatives: true };
    this.wanted = 0;
    this.waiting = false;
    this.playing = false;
    this.image = new ImagePanel(this, () => this.painted());
    this.list = new FrameList(this);
    this.compare = new Compare(this);
    this.left = new Tabs(byId("frames"), () => this.turned());
    this.right = new Tabs(byId("why"), () => this.turned());
    this.panels = [
      new Bar(this),
      this.list,
      new ElementList(this),
      new DecisionList(this),
      new SpacePanel(this),
      new Viewpoints(this),
      new Forecast(this),
      this.image,
      new Neighbours(this),
      new WhyCard(),
      new WhatIf(this),
      new SelectedCard(this),
      new SolverCard(this),
      new Mending(this),
      new MatrixPanel(this),
      new Timeline(this),
      this.compare,
      ...this.compare.panels,
      new Exporter(this),
    ];
    this.address = new Address(this, [...this.ownAddress(), ...this.panels.flatMap((panel) => panel.address?.() ?? [])]);
    this.keys = new Keys("inspect", this.commands());
    this.keys.listen(window);
    this.socket = new Socket({
      onmessage: (message) => this.receive(message),
      onsession: (id, isNew) => this.begin(id, isNew),
      onstate: (connected) => this.line(connected),
    });
  }

  /* From the server */

  begin(session, isNew) {
    this.session = session;
    this.isNew = isNew;
    if (isNew) this.sceneShown = false;
  }

  receive(message) {
    const { type } = message;
    if (type === "error") this.refused(message.text);
    else if (type === "runs") this.showRuns(message.runs);
    else if (type === "run") this.showRun(message.run);
    else if (type === "frame") this.showFrame(message.frame, message.state);
    else if (type === "state") this.showOther(message.state);
    else if (type === "scene") this.showScene();
    else this.each(`show${type[0].toUpperCase()}${type.slice(1)}`, message[type]);
    if (type === "selected" && this.stepping === undefined) this.release();
  }

  showRuns(runs) {
    this.each("showRuns", runs);
    if (this.isNew) this.address.begin(runs);
  }

  refused(text) {
    this.notice(text);
    this.address.refused();
    this.waiting = false;
    this.wanted = this.frame?.position ?? 0;
    this.each("showRefusal");
  }

  showScene() {
    if (!this.sceneShown) this.pictures3d = showScene(byId("scene"), this.session, this.keys);
    this.sceneShown = true;
  }

  line(connected) {
    if (connected) this.notice("");
    else this.notice("Offline: the server does not answer. This page connects again by itself.", true);
    this.waiting = false;
  }

  showRun(run) {
    this.run = run;
    this.notice(run.note, true);
    this.each("showRun", run);
  }

  showFrame(frame, state) {
    this.waiting = false;
    this.frame = frame;
    clearTimeout(this.pointing);
    this.pointing = undefined;
    if (this.wanted !== frame.position && this.stepping) {
      this.go(this.wanted); // keys were faster than the server
    } else {
      this.wanted = frame.position;
    }
    this.each("showFrame", frame);
    this.showState(state);
    this.address.arrive();
  }

  /** Where another is selected, its card comes before its ring in 3D. */
  showOther(state) {
    const { observed, element } = this.state;
    if (state.observed !== observed || state.element !== element) this.pictures3d?.hold(false);
    this.showState(state);
  }

  showState(state) {
    this.state = state;
    this.each("showState", state);
    this.address.changed();
  }

  painted() {
    this.each("imagePainted");
    if (this.stepping === undefined || this.frame?.position !== this.wanted) return;
    if (this.image.frame !== this.frame) return; // its picture is still to come
    performance.measure("frame switch", { start: this.stepping, end: performance.now() });
    this.stepping = undefined;
    if (this.drawn !== this.wanted) this.draw();
    requestAnimationFrame(() => this.pictures3d?.release()); // the image comes first
    if (this.playing) setTimeout(() => this.playing && this.step(1), 60);
  }

  /* To the server */

  open(run, frame) {
    this.socket.send({ verb: "open", run, frame, theme: currentTheme() });
  }

  go(position) {
    if (!this.run) return;
    this.wanted = Math.min(Math.max(position, 0), this.run.frames.length - 1);
    if (this.wanted !== position) this.playing = false;
    const isRush = this.stepping !== undefined;
    this.stepping ??= performance.now();
    if (!this.waiting && this.wanted !== this.frame?.position) {
      this.waiting = this.socket.send({ verb: "go", position: this.wanted });
      if (isRush) this.drawn = undefined; // what is rushed through is not drawn in 3D
      else this.draw(); // made while the image is painted
    }
    this.pointing ??= setTimeout(() => this.point(), POINTED_MS);
  }

  /** The panels show where it goes, unless that has come. */
  point() {
    this.pointing = undefined;
    this.each("pointAt", this.wanted);
  }

  /** The 3D pane draws again, one picture after what the page is about to paint. */
  release() {
    requestAnimationFrame(() => requestAnimationFrame(() => this.pictures3d?.release()));
  }

  /** Asks for the frame in 3D. */
  draw() {
    this.drawn = this.wanted;
    this.pictures3d?.hold(true);
    this.socket.send({ verb: "draw" });
  }

  step(by) {
    this.go(this.wanted + by);
  }

  /** `{observed}`, `{element}`, both for a pair, or neither to clear. */
  select({ observed = null, element = null } = {}) {
    this.socket.send({ verb: "select", observed, element });
  }

  look(view) {
    this.socket.send({ verb: "look", view });
  }

  /* Alone */

  /** What of the address is no panel's. */
  ownAddress() {
    const selected = () => ({ element: textOf(this.state.element), seen: textOf(this.state.observed) });
    const tabs = (one) => oneOf(...one.names);
    return [
      { fields: { element: whole(), seen: whole() }, get: selected, set: ({ element, seen }) => this.select({ element: numberOf(element), observed: numberOf(seen) }) },
      { fields: { list: tabs(this.left), card: tabs(this.right) }, get: () => ({ list: this.left.shown, card: this.right.shown }), set: ({ list, card }) => { this.left.show(list); this.right.show(card); } },
    ];
  }

  turned() {
    this.each("showTabs");
    this.address.changed();
  }

  commands() {
    const step = (key, title, run, shift = false) => ({ key, shift, title, run, group: "Frames" });
    const from = (key, title, run) => ({ key, title, run, group: "3D" });
    return [
      step(",", "Frame before", () => this.step(-1)),
      step(".", "Frame after", () => this.step(1)),
      step(",", "Up in the worst-first list", () => this.shownList().step(-1), true),
      step(".", "Down in the worst-first list", () => this.shownList().step(1), true),
      step("j", "Go to a frame by number", () => this.askForFrame()),
      step(" ", "Play, stop", () => this.play()),
      from("b", "From behind the vehicle", () => this.look("behind")),
      from("l", "Through the camera", () => this.look("camera")),
      from("u", "From above", () => this.look("above")),
      from("g", "Other poses that fit", () => this.socket.send({ verb: "alternatives", shown: !this.state.alternatives })),
      { key: "Tab", group: "Selection", title: "Next element", run: () => this.selectNext(1) },
      { key: "Tab", shift: true, group: "Selection", title: "Previous element", run: () => this.selectNext(-1) },
      { key: "Escape", group: "Selection", title: "Clear the selection; close the comparison", run: () => this.leave() },
      ...this.panels.flatMap((panel) => panel.commands?.() ?? []),
      { key: "h", group: "Page", title: "Frames, elements, map", run: () => this.left.next() },
      { key: "i", group: "Page", title: "Why, selected, solver, what if", run: () => this.right.next() },
      { key: "t", group: "Page", title: "Dark or light", run: () => this.switchTheme() },
      { key: "k", ctrl: true, group: "Page", title: "All commands", run: () => showPalette(this.keys) },
      { key: "?", group: "Page", title: "This help", run: () => this.help() },
    ];
  }

  each(method, ...values) {
    for (const panel of this.panels) panel[method]?.(...values);
  }

  notice(text, mild = false) {
    const box = byId("notice");
    box.textContent = text;
    box.classList.toggle("mild", mild);
    box.hidden = !text;
  }

  play() {
    this.playing = !this.playing;
    if (this.playing) this.step(1);
  }

  selectNext(by) {
    const count = this.frame?.observed.length ?? 0;
    if (!count) return;
    const now = this.state.observed;
    const next = now === null ? (by > 0 ? 0 : count - 1) : (now + by + count) % count;
    this.select({ observed: next });
  }

  shownList() {
    return this.compare.isOpen ? this.compare.frames : this.list;
  }

  leave() {
    if (this.compare.isOpen) this.compare.close();
    else this.select();
  }

  switchTheme() {
    const theme = switchTheme();
    this.socket.send({ verb: "theme", theme });
    this.each("showTheme");
  }

  help() {
    showHelp(this.keys, "Keys of the inspector");
  }

  askForFrame() {
    const input = el("input", { type: "number", value: this.frame?.index ?? 0, "aria-label": "Frame number" });
    const dialog = el("dialog", { class: "help ask" }, el("h2", { text: "Go to frame" }),
      el("form", { method: "dialog" }, input));
    dialog.addEventListener("close", () => {
      const position = this.run.frames.findIndex((row) => row.index === Number(input.value));
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
