// @ts-check
// The view "Poses": what the images say about the poses, what is wrong, and what to do about it.
/** @import {annotator} from "/static/protocol" */
/** @import {Command, Keys} from "/static/keys.js" */
/** @import {Page} from "../main.js" */
/** @import {State} from "../state.js" */
import { byId } from "/static/dom.js";
import { PoseImages } from "./pose_images.js";
import { PosePanels } from "./pose_panels.js";
import { PoseStrips } from "./pose_strips.js";
import { uuid7 } from "../values.js";

/** @typedef {annotator.PoseAnswer["choice"]} Choice */
export class Poses {
  /**
   * @param {State} state
   * @param {Keys} keys
   * @param {Pick<Page, "ask" | "socket" | "go" | "notify" | "pictures" | "views">} page
   */
  constructor(state, keys, page) {
    this.state = state;
    this.keys = keys;
    this.page = page;
    /** @type {annotator.PosesEvent | null} */
    this.known = null;
    this.place = 0; // of the stretch on screen
    /** @type {Choice | null} */
    this.tried = null; // the answer that is previewed
    this.inOnePlace = false; // whether the upper image shows what the lower one does
    /** @type {annotator.PoseFrameEvent | null} */
    this.marks = null;
    this.requested = "";
    this.panels = new PosePanels(state, keys, this);
    this.strips = new PoseStrips(this, (frame) => page.go(frame));
    this.images = new PoseImages(state, this);
    page.socket.on("workspace", () => this.#connected());
    page.socket.on("poses", (event) => this.#received(event));
    page.socket.on("pose_frame", (event) => this.#receivedFrame(event));
    page.socket.on("poses_chosen", ({ text }) => page.notify(text));
  }

  get isShown() {
    return this.state.view === "poses";
  }

  /** All stretches, open ones first. */
  get stretches() {
    return this.known?.poses?.stretches ?? [];
  }

  /** The stretch on screen; null if there is none. */
  get stretch() {
    return this.stretches[this.place] ?? null;
  }

  /** The answer that is previewed. */
  get trying() {
    return this.stretch?.answers.find(({ choice }) => choice === this.tried) ?? null;
  }

  /** The poses are compared, unless they are already. */
  entered() {
    this.page.socket.send("show_poses", {});
    if (this.stretch) this.select(this.place);
  }

  left() {
    this.drop();
  }

  /** Commands for `Keys`.
   *
   * @returns {Command[]}
   */
  commands() {
    const group = "Poses", view = "poses", row = "Next, previous stretch";
    const here = (/** @type {() => void} */ run) => () => {
      this.page.views.open("poses");
      run();
    };
    return [
      { key: "f", shift: true, group, title: "Refine these poses; Ctrl Enter applies", words: "turn shift", run: here(() => this.try("refine")) },
      { key: "o", shift: true, group, title: "Leave frames out; Ctrl Enter applies", words: "these", run: here(() => this.try("leave out")) },
      { key: "k", shift: true, group, title: "Keep these poses; Ctrl Enter applies", words: "as they are", run: here(() => this.try("keep")) },
      { key: "Enter", ctrl: true, view, group, title: "Make the previewed choice", run: () => this.apply() },
      { key: " ", view, group, title: "Before and after in one place", run: () => this.#redraw({ inOnePlace: !this.inOnePlace }) },
      { key: ".", shift: true, view, group, row, title: "Next stretch", run: () => this.step(1) },
      { key: ",", shift: true, view, group, row, title: "Previous stretch", run: () => this.step(-1) },
      { key: "Escape", view, group, title: "Drop the preview; back to the images", run: () => { if (!this.drop()) this.page.views.open("images"); } },
    ];
  }

  /** Previews an answer; nothing is changed.
   *
   * @param {Choice} choice
   */
  try(choice) {
    const answer = this.stretch?.answers.find((one) => one.choice === choice);
    if (!answer) {
      if (this.stretch) this.page.notify("Other poses do not repair this fault: see What to do.", "wrong");
      return;
    }
    if (answer.refusal) {
      this.page.notify(answer.refusal, "wrong");
      return;
    }
    this.#redraw({ tried: choice });
  }

  /** Makes the previewed choice. */
  apply() {
    const { stretch, trying } = this;
    if (!stretch || !trying) return;
    const { first, last, subject } = stretch;
    const isSent = this.page.socket.send("choose_poses", { choice: trying.choice, first, last, subject }, uuid7());
    if (isSent) this.drop();
    else this.page.notify("Offline: the choice was not made. Try again when the server is back.", "wrong");
  }

  /** Connected again: what was requested meanwhile was not sent. */
  #connected() {
    this.requested = "";
    if (this.isShown) this.page.socket.send("show_poses", {});
  }

  /** Asks again about a fault that was answered. */
  askAgain() {
    const { stretch } = this;
    if (!stretch) return;
    const { first, last, subject } = stretch;
    this.page.ask("choose_poses", { choice: "ask", first, last, subject });
  }

  /** Drops the preview. Returns whether there was one. */
  drop() {
    const hadOne = this.tried !== null;
    this.#redraw({ tried: null, inOnePlace: false });
    return hadOne;
  }

  /** Shows the next stretch, and its first frame unless one of its frames is on screen.
   *
   * @param {1 | -1} by
   */
  step(by) {
    const count = this.stretches.length;
    if (count) this.select((this.place + by + count) % count);
  }

  /** @param {number} place */
  select(place) {
    this.#redraw({ place, tried: null, inOnePlace: false });
    const { stretch } = this;
    const { frame } = this.state;
    if (stretch && frame !== null && (frame < stretch.first || frame > stretch.last)) this.page.go(stretch.first);
    else this.#request();
  }

  /** Redraws; called whenever the state of the page changes. */
  show() {
    const open = this.known?.poses?.open ?? 0;
    byId("tab-mark").hidden = !open;
    byId("tab-mark").title = `${open} ${open === 1 ? "stretch of poses wants" : "stretches of poses want"} a look`;
    if (!this.isShown) return;
    this.panels.show();
    this.strips.redraw();
    this.images.show();
    this.#request();
  }

  /** @param {Partial<Pick<Poses, "tried" | "inOnePlace" | "place">>} fields */
  #redraw(fields) {
    Object.assign(this, fields);
    this.state.set({});
  }

  /** @param {annotator.PosesEvent} event */
  #received(event) {
    const before = this.stretch;
    this.known = event;
    const same = this.stretches.findIndex(({ first, last, subject }) => before && first === before.first && last === before.last && subject === before.subject);
    this.place = Math.max(same, 0);
    if (!this.stretch) this.tried = null;
    this.requested = "";
    this.state.set({});
  }

  /** Requests the elements of the frame on screen. */
  #request() {
    const { frame } = this.state;
    const wanted = this.stretch && this.isShown ? `${frame} ${this.place}` : "";
    if (wanted === this.requested || frame === null) return;
    this.requested = wanted;
    if (wanted) this.page.socket.send("show_pose_frame", { frame, stretch: this.place });
  }

  /** @param {annotator.PoseFrameEvent} event */
  #receivedFrame(event) {
    this.marks = event;
    this.state.set({});
  }
}
