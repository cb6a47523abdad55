// @ts-check
// What the server said last of frames, for the time while it does not answer.
/** @import {annotator} from "/static/protocol" */
/** @import {State} from "../state.js" */

const MOST = 200; // frames

export class Remembered {
  /** @param {State} state */
  constructor(state) {
    this.state = state;
    /** @type {Map<number, annotator.LabelledFrameView>} */
    this.frames = new Map(); // by number, least recently shown first
    state.onChange(() => this.#keep());
  }

  #keep() {
    const frame = this.state.received?.frame;
    if (!frame || this.frames.get(frame.index) === frame) return;
    this.frames.delete(frame.index);
    this.frames.set(frame.index, frame);
    for (const oldest of [...this.frames.keys()].slice(0, -MOST)) this.frames.delete(oldest);
  }

  /** Offline, shows the labels of the frame on screen as they were known last. */
  recall() {
    const { state } = this;
    const frame = this.frames.get(state.frame ?? -1);
    if (!state.connected && state.received && frame) state.set({ received: { ...state.received, frame } });
  }
}
