// A pole that is half drawn when the page goes, by a reload or a docked frame that is rebuilt,
// is under the pen again when the page is back.

export class Sketch {
  constructor(state, workspace) {
    this.state = state;
    this.key = `semviz.sketch.${workspace}`;
    this.kept = null;
    state.onChange(() => this.#keep());
  }

  /** Takes up the drawing that was left in the frame on screen. */
  restore() {
    const left = JSON.parse(sessionStorage.getItem(this.key) ?? "null");
    if (left?.frame === this.state.frame) this.state.set({ drawing: left.drawing });
  }

  /** Only what waits for its second click; what is drawn in one stroke ends with the press. */
  #keep() {
    const { drawing, frame } = this.state;
    if (drawing === this.kept) return;
    this.kept = drawing;
    if (drawing?.end) sessionStorage.setItem(this.key, JSON.stringify({ frame, drawing }));
    else sessionStorage.removeItem(this.key);
  }
}
