// @ts-check
/* The frame in run A, beside the page's own image, which is of run B. Both share side, mode, crop and
 * zoom. */

import { Surface } from "/static/canvas.js";
import { byId } from "/static/dom.js";
import { pickAt } from "../image/image.js";
import { drawPhoto, drawModel } from "../image/image_drawing.js";
import { ImageModel } from "../image/image_model.js";
import { ImageCache } from "../image/image_cache.js";

/** @typedef {import("/static/protocol").inspector.BaseFrameEvent} BaseFrameEvent */
/** @typedef {import("/static/protocol").inspector.BaseFrameView} BaseFrameView */
/** @typedef {import("/static/protocol").inspector.ComparisonView} ComparisonView */
/** @typedef {import("/static/protocol").inspector.StateView} StateView */
/** @typedef {import("/static/canvas.js").Point} Point */
/** @typedef {import("../panel.js").ClassMap} ClassMap */
/** @typedef {import("../panel.js").Context} Context */
/** @typedef {import("../panel.js").Figure} Figure */
/** @typedef {import("../main.js").Page} Page */
/** @typedef {import("./same_element.js").SameElement} SameElement */

export class BaseImage {
  /**
   * @param {Page} page
   * @param {SameElement} same
   */
  constructor(page, same) {
    this.page = page;
    this.same = same;
    this.images = new ImageCache();
    /** @type {BaseFrameEvent | null} */
    this.coming = null;
    /** @type {BaseFrameEvent | null} */
    this.shown = null; // once its image has arrived
    /** @type {ImageBitmap | null} */
    this.bitmap = null;
    /** @type {ImageModel | null} */
    this.model = null;
    /** @type {StateView["side"]} */
    this.side = "left";
    /** @type {ClassMap} */
    this.classes = new Map();
    this.surface = new Surface(byId("base-image-canvas", HTMLCanvasElement), (...size) => this.draw(...size));
    page.image.listen(this.surface.canvas, (at) => this.pick(at));
    page.socket.on("comparison", ({ comparison }) => this.showComparison(comparison));
    page.socket.on("base_frame", (event) => this.showBaseFrame(event));
  }

  /** @param {ComparisonView} comparison */
  showComparison({ base }) {
    this.coming = this.shown = this.bitmap = this.model = null;
    this.classes = new Map(base.classes.map((kind) => [kind.id, kind]));
    this.images.open({ ...base, frames: [] });
    this.surface.redraw();
  }

  /** @returns {Figure[]} */
  figures() {
    return this.surface.width && this.model ? [this.surface.figure("image-of-A", "Image of A")] : [];
  }

  /** @param {BaseFrameEvent} event */
  showBaseFrame(event) {
    this.coming = event;
    this.show();
  }

  /** @param {StateView} state */
  showState({ side }) {
    if (side !== this.side) this.show();
    this.side = side;
    this.update();
  }

  async show() {
    const { coming, page: { store } } = this;
    const { side } = store.state;
    const { bitmap } = coming?.base ? await this.images.get(coming.base.frame.position, side) : { bitmap: null };
    if (this.coming !== coming || store.state.side !== side) return; // a later request
    this.shown = coming;
    this.bitmap = bitmap;
    this.update();
  }

  update() {
    const { shown } = this;
    this.model = shown?.base ? this.modelOf(shown.base) : null;
    byId("base-image-none").textContent = shown && !shown.base ? `A has no frame ${shown.index}.` : "";
    this.surface.redraw();
  }

  /** Null if A has no right image.
   *
   * @param {BaseFrameView} base
   */
  modelOf({ frame, right }) {
    const { store: { state: { mode, side } }, image } = this.page;
    if (side === "left") return new ImageModel(frame, mode, image.size);
    return right && new ImageModel(frame, mode, image.size, { mapped: right });
  }

  /** The page's own image was painted: follows its view. */
  imagePainted() {
    this.surface.redraw();
  }

  /** @param {Point} at */
  pick(at) {
    if (!this.model) return;
    const { observed, element } = pickAt(this.model, this.page.image.view, at);
    const { frame } = this.model;
    const pair = frame.pairs.find((candidate) => candidate.observed === observed);
    const base = pair ? frame.mapped[pair.mapped].id : element;
    this.page.select(base === undefined ? {} : { element: this.same.inOther(base) });
  }

  /**
   * @param {Context} context
   * @param {number} width
   * @param {number} height
   */
  draw(context, width, height) {
    const { model, page: { image } } = this;
    if (!model) return;
    drawPhoto(context, this.bitmap, image.view, image.size);
    const { state, frame } = this.page.store;
    const selection = this.same.selection(state, frame, model.frame);
    drawModel(context, model, image.view, width, height, { ...image.look(), ...selection, classes: this.classes });
  }
}
