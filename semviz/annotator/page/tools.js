// The pen: what presses, moves and releases on the images mean.
import { pointerAt } from "/static/canvas.js";
import { SIDES, uuid7 } from "./state.js";

const BESIDE = 8; // CSS pixels; a press so near to the image is meant for its border
const DRAG_FROM = 4; // CSS pixels; a shorter way is a click

export class Tools {
  /** `submit(edit)` keeps and sends an edit; `look()` asks for guides and numbers; `mayEdit()` says
   * whether labels can be changed now, and tells the person why not. */
  constructor(state, images, { submit, look, mayEdit }) {
    this.state = state;
    this.images = images;
    this.submit = submit;
    this.look = look;
    this.mayEdit = mayEdit;
    this.press = null; // the button that is down: {side, from, moved, mode, ...}
    for (const side of SIDES) {
      const canvas = images.canvas(side);
      const on = (name, handler) =>
        canvas.addEventListener(name, (event) => handler.call(this, side, event), { passive: false });
      on("pointerdown", this.#down);
      on("pointermove", this.#move);
      on("pointerup", this.#up);
      on("pointercancel", this.#cancelPress);
      on("pointerleave", this.#leave);
      on("wheel", this.#wheel);
      canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    }
  }

  /** Esc: leaves nothing behind. Returns whether there was something to leave. */
  cancel() {
    const had = this.state.drawing || this.press?.moved;
    this.press = null;
    this.state.set({ drawing: null, dragged: null });
    if (had) this.look();
    return Boolean(had);
  }

  #down(side, event) {
    event.preventDefault();
    this.images.canvas(side).focus({ preventScroll: true });
    this.images.canvas(side).setPointerCapture(event.pointerId);
    const point = pointerAt(event);
    this.press = { side, button: event.button, start: point, last: point, moved: false };
    if (event.button !== 0 || event.altKey) {
      this.press.mode = "pan";
    } else if (this.state.drawing) {
      this.press.mode = "finish";
    } else {
      const hit = event.shiftKey ? null : this.images.hit(side, point);
      if (hit) this.#take(side, hit, event);
      else if (this.#begin(side, this.images.view.toImage(point))) this.press.mode = "draw";
    }
  }

  // -- without a mouse

  /** A point at `pixel`, as by a click there: begins a drawing, or finishes it. */
  setPoint(side, pixel) {
    const { drawing } = this.state;
    if (drawing && drawing.side !== side) this.cancel();
    else if (drawing) this.#finish(pixel);
    else if (this.#begin(side, pixel) && !this.state.drawing.end) this.#save(pixel, null);
  }

  /** The rubber band goes to `pixel`, if there is one on this side. */
  stretchTo(side, pixel) {
    const { drawing } = this.state;
    if (drawing?.side !== side || !drawing.end) return;
    this.state.set({ drawing: { ...drawing, end: this.#inside(side, pixel) } });
    this.look();
  }

  /** Takes hold of an observation: a click selects it, a drag moves its vertex or all of it. */
  #take(side, hit, event) {
    const element = this.state.elements.find((one) => one.id === hit.element);
    const { anchor, end } = element.observations[side];
    const grab = this.images.view.toImage(pointerAt(event));
    Object.assign(this.press, { mode: "drag", hit, grab, original: { anchor, end } });
    const linked = event.ctrlKey || event.metaKey;
    const also = linked && this.state.selected ? this.state.selected.element : null;
    this.state.set({
      selected: { element: hit.element, side, also: also === hit.element ? null : also },
      vertex: hit.part === "end" ? "end" : "anchor",
    });
    this.look();
  }

  /** Returns whether something is being drawn now. */
  #begin(side, anchor) {
    const near = BESIDE / this.images.view.scale;
    if (!this.images.bitmap(side) || !this.#isInside(side, anchor, near) || !this.mayEdit()) return false;
    anchor = this.#inside(side, anchor);
    const id = this.state.classId;
    const kind = this.state.classOf(id).kind;
    this.state.set({ drawing: {
      side, class: id, anchor, end: kind === "line" ? anchor : null,
      anchor_known: true, end_known: kind === "line", asks_bottom: kind === "line",
    } });
    this.look();
    return true;
  }

  #move(side, event) {
    const point = pointerAt(event);
    this.images.pointer = { side, point };
    const { press } = this;
    if (press && Math.hypot(point[0] - press.start[0], point[1] - press.start[1]) > DRAG_FROM) {
      press.moved = true;
    }
    if (press?.mode === "pan") {
      this.images.panBy(point[0] - press.last[0], point[1] - press.last[1]);
      press.last = point;
    } else if (press?.mode === "drag" && press.moved && this.mayEdit()) {
      this.#drag(side, event);
    } else if (this.state.drawing?.side === side) {
      this.#stretch(side, event);
    } else {
      this.#hover(side, point);
    }
    this.images.repaint();
  }

  /** The rubber band, or the sign's box. */
  #stretch(side, event) {
    const at = this.images.view.toImage(pointerAt(event));
    const { drawing } = this.state;
    if (drawing.end) {
      this.stretchTo(side, at);
    } else if (this.press?.moved) {
      const from = this.images.view.toImage(this.press.start);
      this.state.set({ drawing: { ...drawing, box: [from, at], anchor: middle(from, at) } });
      this.look();
    }
  }

  #drag(side, event) {
    const { hit, grab, original } = this.press;
    const at = this.images.view.toImage(pointerAt(event));
    const by = [at[0] - grab[0], at[1] - grab[1]];
    const moved = {
      anchor: hit.part === "end" ? original.anchor : this.#inside(side, shifted(original.anchor, by)),
      end: hit.part === "anchor" || !original.end ? original.end : this.#inside(side, shifted(original.end, by)),
    };
    this.state.set({ dragged: { observation: hit.observation, ...moved } });
    this.look();
  }

  #hover(side, point) {
    const hit = this.images.hit(side, point);
    this.images.hovered = hit;
    this.images.canvas(side).style.cursor = hit ? "grab" : "crosshair";
    this.#point(this.images.hitOffer(side, point));
  }

  /** The proposal under the pointer is the one that the keys are for. */
  #point(offer) {
    const id = offer?.id ?? null;
    if (id !== this.state.pointed) this.state.set({ pointed: id });
  }

  #up(side, event) {
    const { press } = this;
    this.press = null;
    if (!press) return;
    if (press.mode === "drag" && this.state.dragged) this.#drop();
    else if (press.mode === "draw") this.#released(press);
    else if (press.mode === "finish" && this.state.drawing?.side === side) {
      this.#finish(this.images.view.toImage(pointerAt(event)));
    } else if (press.mode === "finish") {
      this.cancel();
    }
  }

  #drop() {
    const { observation, anchor, end } = this.state.dragged;
    this.state.set({ dragged: null });
    this.submit({ kind: "move", observation_id: observation, anchor_px: anchor, end_px: end });
  }

  /** A sign is done; a pole waits for its second click, unless it was drawn in one stroke. */
  #released(press) {
    const { drawing } = this.state;
    if (!drawing) return;
    if (!drawing.end) this.#save(drawing.anchor, null);
    else if (press.moved) this.#save(drawing.anchor, drawing.end);
  }

  #finish(end) {
    const { side, anchor } = this.state.drawing;
    this.#save(anchor, this.#inside(side, end));
  }

  #save(anchor, end) {
    const { side, class: id, anchor_known, end_known, asks_bottom, box } = this.state.drawing;
    const [element, observation] = [uuid7(), uuid7()];
    this.state.set({ drawing: null });
    this.submit({
      kind: "draw",
      observation_id: observation,
      element_id: element,
      frame_index: this.state.frame,
      side,
      class_id: id,
      anchor_px: anchor,
      end_px: end,
      anchor_known: anchor_known && !(end && this.#isCut(side, anchor)),
      end_known: end_known && !(end && this.#isCut(side, end)),
      selected_id: this.state.selected?.element ?? null,
      snap: this.state.aids.snap && !box,
      asks_bottom: this.state.aids.snap && asks_bottom,
    });
  }

  #cancelPress() {
    this.press = null;
    this.state.set({ dragged: null });
  }

  #leave() {
    if (this.press) return;
    this.images.pointer = null;
    this.images.hovered = null;
    this.#point(null);
    this.images.repaint();
  }

  #wheel(side, event) {
    event.preventDefault();
    const point = pointerAt(event);
    if (event.shiftKey) this.images.panBy(-(event.deltaX || event.deltaY), 0);
    else this.images.zoomAt(point, Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.002)));
  }

  /** Whether a pole's end lies on the image's border: there it is cut off, not at an end. */
  #isCut(side, pixel) {
    return !this.#isInside(side, pixel, -1);
  }

  #isInside(side, [u, v], margin) {
    const { width, height } = this.state.hello.images[side];
    const low = -0.5 - margin;
    return u >= low && v >= low && u <= width - 0.5 + margin && v <= height - 0.5 + margin;
  }

  /** The nearest pixel of the image: what is cut off ends at its border. */
  #inside(side, [u, v]) {
    const { width, height } = this.state.hello.images[side];
    return [Math.min(Math.max(u, -0.5), width - 0.5), Math.min(Math.max(v, -0.5), height - 0.5)];
  }
}

const shifted = ([u, v], [du, dv]) => [u + du, v + dv];
const middle = ([a, b], [c, d]) => [(a + c) / 2, (b + d) / 2];
