// @ts-check
// Ways through the drive: go to a frame by its number, play the frames.
/** @import {Command} from "/static/keys.js" */
/** @import {Images} from "./images/images.js" */
/** @import {Page} from "./main.js" */
/** @import {State} from "./state.js" */
import { el } from "/static/dom.js";

const PLAY_MS = 300; // a frame, at least

/** Commands for `Keys`.
 *
 * @param {State} state
 * @param {Images} images
 * @param {Pick<Page, "go" | "notify">} page
 * @returns {Command[]}
 */
export function travelCommands(state, images, page) {
  const playback = new Playback(state, images, page);
  return [
    { key: "g", ctrl: true, group: "Frames", title: "Go to frame: type its number", row: "Go to frame; play", run: () => askForFrame(state, page) },
    { key: ".", ctrl: true, group: "Frames", title: "Play the frames; again: stop", row: "Go to frame; play", words: "playback pause", run: () => playback.toggle() },
  ];
}

/** Shows the next frame as soon as the images of the last one are there. */
class Playback {
  /**
   * @param {State} state
   * @param {Images} images
   * @param {Pick<Page, "go" | "notify">} page
   */
  constructor(state, images, page) {
    this.state = state;
    this.images = images;
    this.page = page;
    /** @type {ReturnType<typeof setInterval> | null} */
    this.timer = null;
    this.frame = -1; // the one that this has shown last
  }

  toggle() {
    if (this.timer !== null) {
      this.#stop();
      return;
    }
    this.frame = this.state.frame ?? -1;
    this.timer = setInterval(() => this.#step(), PLAY_MS);
  }

  #stop() {
    if (this.timer !== null) clearInterval(this.timer);
    this.timer = null;
  }

  /** Stops at the end, and when the user draws or goes to another frame. */
  #step() {
    const { state } = this;
    const rank = state.order.indexOf(this.frame) + 1;
    const isBusy = state.frame !== this.frame || state.drawing !== null || state.dragged !== null;
    if (isBusy || rank === state.order.length) {
      this.#stop();
    } else if (this.images.bitmap("left")) {
      this.frame = state.order[rank];
      this.page.go(this.frame);
      if (rank === state.order.length - 1) this.#stop();
    }
  }
}

/** Asks for the number of a frame and goes there; says which numbers there are if it is none.
 *
 * @param {State} state
 * @param {Pick<Page, "go" | "notify">} page
 */
function askForFrame(state, page) {
  const { order } = state;
  const range = `${order[0]} to ${order[order.length - 1]}`;
  const input = el("input", { type: "text", inputmode: "numeric", placeholder: `Frame, ${range}`, "aria-label": `Number of the frame, ${range}`, autocomplete: "off" });
  const form = el("form", { method: "dialog" }, input);
  const dialog = el("dialog", { class: "palette", "aria-label": "Go to frame" }, form);
  form.addEventListener("submit", () => {
    const frame = Number(input.value);
    if (input.value.trim() && order.includes(frame)) page.go(frame);
    else page.notify(`No frame ${input.value.trim()}: there are ${range}.`, "wrong");
  });
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
}
