// @ts-check
// The view "Your drive": the checks of the import as pictures, and what to do, in order.
/** @import {annotator} from "/static/protocol" */
/** @import {Command, Keys} from "/static/keys.js" */
/** @import {Page} from "../main.js" */
/** @import {State} from "../state.js" */
import { byId, el, fill } from "/static/dom.js";
import { DrivePicture } from "./drive_picture.js";
import { DriveStrip } from "./drive_strip.js";
import { Trajectory } from "../panels/trajectory.js";
import { RenderCache, badge, capital, header, row } from "../panels/widgets.js";

/** @type {{kind: import("./drive_picture.js").Kind, key: string, title: string}[]} */
const KINDS = [
  { kind: "rows", key: "1", title: "Rows" },
  { kind: "lines", key: "2", title: "Distortion" },
  { kind: "depth", key: "3", title: "Depth" },
];
/** The picture that shows most of a check. */
const SHOWS = /** @type {Record<string, import("./drive_picture.js").Kind>} */ ({ sides: "depth", lines: "lines", extrinsics: "depth", scale: "depth" });

export class Drive {
  /**
   * @param {State} state
   * @param {Keys} keys
   * @param {Pick<Page, "socket" | "go" | "notify" | "pictures" | "views">} page
   */
  constructor(state, keys, page) {
    this.state = state;
    this.keys = keys;
    this.page = page;
    this.cache = new RenderCache(state);
    /** @type {annotator.DriveView | null} */
    this.known = null;
    this.chosen = -1; // the check on screen
    this.requested = -1; // the frame whose matches were requested
    this.picture = new DrivePicture(state, page.pictures);
    this.trajectory = new Trajectory(byId("drive-trajectory", HTMLCanvasElement), (frame) => page.go(frame));
    this.strip = new DriveStrip((frame) => page.go(frame));
    byId("drive-poses").addEventListener("click", () => page.views.open("poses"));
    byId("drive-jump").addEventListener("click", () => this.#jump());
    page.socket.on("drive", ({ drive }) => {
      this.known = drive;
      if (this.chosen < 0) this.#look(Math.max(0, drive.checks.findIndex(({ passed }) => passed === false)));
      state.set({});
    });
    page.socket.on("workspace", () => { if (this.isShown) this.entered(); }); // connected again
    page.socket.on("drive_frame", ({ pair }) => this.picture.received(pair));
  }

  get isShown() {
    return this.state.view === "drive";
  }

  entered() {
    this.page.socket.send("show_drive", {});
  }

  /** Commands for `Keys`.
   *
   * @returns {Command[]}
   */
  commands() {
    const group = "Your drive", view = "drive";
    return [
      ...KINDS.map(({ kind, key, title }) => ({ key, view, group, title: `Picture: ${title.toLowerCase()}`, row: "Rows, distortion, depth", run: () => this.#draw(kind) })),
      { key: "j", view, group, title: "Frame of the chosen check", run: () => this.#jump() },
      { key: "Escape", view, group, title: "Back to the images", run: () => this.page.views.open("images") },
    ];
  }

  /** Redraws; called whenever the state of the page changes. */
  show() {
    if (!this.isShown) return;
    const { known } = this;
    if (!known) return;
    this.cache.show("drive-head", [known], () => this.#head(known));
    this.cache.show("drive-checks", [known, this.chosen], () => this.#checks(known));
    this.cache.show("drive-steps", [known], () => this.#steps(known));
    const { frame } = this.state;
    if (frame !== null && frame !== this.requested && this.page.socket.send("show_drive_frame", { frame })) this.requested = frame;
    this.cache.show("drive-kinds", [this.picture.kind], () => this.#kinds());
    const { frame: place } = known.checks[this.chosen] ?? {};
    byId("drive-jump").hidden = typeof place !== "number";
    fill(byId("drive-jump"), [`Frame ${place} `, badge(this.keys, "J")]);
    this.picture.show(frame);
    this.strip.show(known, frame);
    this.trajectory.show(known, frame);
  }

  /** @param {annotator.DriveView} drive */
  #head({ title, sentence, is_sound: isSound, facts }) {
    return [
      el("div", { class: "drive-title" },
        el("h2", {}, el("span", { class: isSound ? "sound" : "warning", text: isSound ? "●" : "◆" }), ` ${title}`),
        el("p", { class: "dim", text: sentence, title: sentence })),
      ...facts.map(({ value, label }) => el("div", { class: "drive-fact" }, el("b", { text: value }), el("span", { class: "dim", text: label }))),
    ];
  }

  /** @param {annotator.DriveView} drive */
  #checks({ checks, file }) {
    const passed = checks.filter(({ passed: isPassed }) => isPassed).length;
    const about = checks.length ? `${passed} of ${checks.length} pass` : "none: made without your own images";
    return [
      header("Checks", about),
      el("div", { class: "list" }, ...checks.map((check, place) => this.#check(check, place))),
      el("p", { class: "drive-file dim", text: file ? `Nothing here is changed. ${file}` : "", title: file }),
    ];
  }

  /**
   * @param {annotator.DriveCheck} check
   * @param {number} place
   */
  #check({ name, measured, value, limit, passed }, place) {
    const [sign, kind] = passed === null ? ["○", "dim"] : passed ? ["●", "sound"] : ["◆", "warning"];
    return row({ chosen: place === this.chosen, title: `${capital(name)}: ${measured}`, onclick: () => this.#look(place) },
      el("span", { class: kind, text: sign }), el("span", { class: "fill", text: capital(name) }),
      el("b", { text: value }), el("span", { class: "drive-limit dim", text: limit }));
  }

  #kinds() {
    return KINDS.map(({ kind, key, title }) => el("button", { class: "small", role: "tab", "aria-pressed": String(kind === this.picture.kind), onclick: () => this.#draw(kind) },
      kind === "rows" && !this.state.hasRight ? "Lines " : `${title} `, el("kbd", { text: key })));
  }

  /** @param {import("./drive_picture.js").Kind} kind */
  #draw(kind) {
    this.picture.kind = kind;
    this.state.set({});
  }

  /** Goes to the frame of the chosen check. */
  #jump() {
    const place = this.known?.checks[this.chosen]?.frame;
    if (typeof place === "number") this.page.go(place);
  }

  /** Shows a check by its frame.
   *
   * @param {number} place
   */
  #look(place) {
    this.chosen = place;
    this.picture.kind = SHOWS[this.known?.checks[place]?.kind ?? ""] ?? "rows";
    const frame = this.known?.checks[place]?.frame;
    if (typeof frame === "number") this.page.go(frame);
    else this.state.set({});
  }

  /** @param {annotator.DriveView} drive */
  #steps({ steps }) {
    return [
      header("Next", "in this order"),
      ...steps.map(({ title, text, command, view }, place) => el("div", { class: "drive-step" },
        el("span", { class: "drive-number", text: `${place + 1}` }),
        el("div", {},
          el("h3", { text: title }),
          el("p", { class: "dim", text }),
          command ? this.#command(command) : null,
          view === "images" ? el("button", { onclick: () => this.page.views.open("images") }, "Start ", badge(this.keys, "F2")) : null,
          view === "poses" ? el("button", { onclick: () => this.page.views.open("poses") }, "Open Poses ", badge(this.keys, "F4")) : null))),
    ];
  }

  /** @param {string} command */
  #command(command) {
    const copy = async () => {
      await navigator.clipboard?.writeText(command);
      this.page.notify("Copied. Run it in a terminal.");
    };
    return el("div", { class: "drive-command" }, el("code", { text: command, title: command }), el("button", { class: "small", title: "Copy the command", onclick: copy }, "Copy"));
  }
}
