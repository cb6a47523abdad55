// @ts-check
/* The page's state: run, frame shown, target frame. Panels read it, the page changes it. */

/** @typedef {import("./run_rows.js").OpenRun} OpenRun */
/** @typedef {import("/static/protocol").inspector.FrameView} FrameView */
/** @typedef {import("/static/protocol").inspector.StateView} StateView */

/** @type {StateView} */
const INITIAL = {
  observed: null, element: null, view: "behind", alternatives: true, forecast: false, colors: "class",
  ellipsoids: false, backdrop: true, base: "", comparing: false, mode: "estimate", side: "left", neighbours: false,
};

export class Store {
  /** @type {OpenRun | null} */
  #run = null;
  /** @type {FrameView | null} */
  #frame = null;
  /** The selection and the display settings. */
  state = INITIAL;
  /** Names of the runs that can be opened.
   *
   * @type {string[]} */
  names = [];
  /** Position of the frame that the page goes to, or shows. */
  target = 0;
  /** Whether a requested frame has not arrived. */
  waiting = false;
  playing = false;
  /** When the page left the frame painted last, ms; null while it stays.
   *
   * @type {number | null} */
  leftAt = null;
  /** Position of the frame requested in 3D; null if it is skipped.
   *
   * @type {number | null} */
  drawn = null;

  get isOpen() {
    return this.#run !== null;
  }

  get hasFrame() {
    return this.#frame !== null;
  }

  /** The open run. */
  get run() {
    if (!this.#run) throw new Error("no run is open");
    return this.#run;
  }

  /** The steps towards a frame of another run end. */
  set run(run) {
    if (run?.name !== this.#run?.name) this.leftAt = null;
    this.#run = run;
  }

  /** The frame that arrived last. */
  get frame() {
    if (!this.#frame) throw new Error("no frame is shown");
    return this.#frame;
  }

  get position() {
    return this.#frame?.position ?? null;
  }

  get isStepping() {
    return this.leftAt !== null;
  }

  /** Whether the frame that arrived last ends the steps: a key may have turned back to it while the
   * answer to an earlier key is still on its way. */
  get hasArrived() {
    return this.isStepping && !this.waiting && this.target === this.position;
  }

  /** Goes to a position, clipped to the run. Playing stops at its ends.
   *
   * @param {number} position
   * @param {number} now ms
   */
  setTarget(position, now) {
    this.target = Math.min(Math.max(position, 0), this.run.frames.length - 1);
    if (this.target !== position) this.playing = false;
    if (this.waiting || this.target !== this.position) this.leftAt ??= now;
  }

  /** A frame has arrived. Returns whether the page goes on: keys may be faster than the server.
   *
   * @param {FrameView} frame
   */
  receive(frame) {
    this.waiting = false;
    this.#frame = frame;
    const goesOn = this.isStepping && this.target !== frame.position;
    if (!goesOn) this.target = frame.position;
    return goesOn;
  }

  /** The target frame was painted. Returns how long that took, ms.
   *
   * @param {number} now ms
   */
  finishStep(now) {
    const took = now - (this.leftAt ?? now);
    this.leftAt = null;
    return took;
  }

  /** A request was refused: the page stays at its frame, or at the one that still arrives. */
  cancel() {
    this.waiting = false;
    this.leftAt = null;
    this.target = this.position ?? 0;
  }
}
