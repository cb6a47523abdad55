// @ts-check
/* The image panel: the image, what is drawn on it, and how the user controls it. */

import { Surface, View, enableZoomAndPan, pointerAt } from "/static/canvas.js";
import { byId } from "/static/dom.js";
import { flag, oneOf, yes } from "../address.js";
import { drawPhoto, drawModel, drawWhatIf } from "./image_drawing.js";
import { ImageModel, gap, middle, nearestOn, placeOf } from "./image_model.js";
import { ImageCache } from "./image_cache.js";

/** @typedef {import("/static/protocol").inspector.FrameView} FrameView */
/** @typedef {import("/static/protocol").inspector.RightImageEvent} RightImageEvent */
/** @typedef {import("../run_rows.js").OpenRun} OpenRun */
/** @typedef {import("/static/protocol").inspector.StateView} StateView */
/** @typedef {import("/static/protocol").inspector.WhatIfEvent} WhatIfEvent */
/** @typedef {import("/static/protocol").inspector.WhatIfResult} WhatIfResult */
/** @typedef {import("/static/keys.js").Command} Command */
/** @typedef {import("/static/canvas.js").Point} Point */
/** @typedef {import("../panel.js").AddressPart} AddressPart */
/** @typedef {import("../panel.js").ClassMap} ClassMap */
/** @typedef {import("../panel.js").Context} Context */
/** @typedef {import("../panel.js").Ends} Ends */
/** @typedef {import("../panel.js").Figure} Figure */
/** @typedef {import("./image_drawing.js").ImageLook} ImageLook */
/** @typedef {import("../main.js").Page} Page */

const HIT_PX = 12;
const TITLES = { left: "Left image", right: "Right image" };

export class ImagePanel {
  /**
   * @param {Page} page
   * @param {() => void} painted
   */
  constructor(page, painted) {
    this.page = page;
    this.residuals = true;
    this.state = page.store.state;
    this.view = new View();
    this.fitted = true;
    this.images = new ImageCache();
    /** @type {FrameView | null} */
    this.coming = null;
    /** @type {FrameView | null} */
    this.frame = null; // once its image has arrived
    /** @type {RightImageEvent | null} */
    this.right = null;
    /** @type {RightImageEvent | null} */
    this.rightShown = null;
    /** @type {ImageModel | null} */
    this.model = null;
    /** @type {ImageBitmap | null} */
    this.bitmap = null;
    this.missingReason = "";
    /** @type {ClassMap} */
    this.classes = new Map();
    /** @type {WhatIfResult | null} */
    this.whatIf = null;
    page.socket.on("right_image", (event) => this.showRight(event));
    page.socket.on("what_if", (event) => this.showWhatIf(event));
    const canvas = byId("image-canvas", HTMLCanvasElement);
    this.surface = new Surface(canvas, (...size) => this.draw(...size));
    this.surface.onpainted = painted;
    this.surface.onresize = () => { if (this.fitted && page.store.isOpen) this.fit(); };
    this.listen(canvas, (at) => this.pick(at));
    /** @type {NodeListOf<HTMLElement>} */
    this.modes = document.querySelectorAll("[data-mode]");
    for (const button of this.modes) {
      button.addEventListener("click", () => this.setImage({ mode: /** @type {StateView["mode"]} */ (button.dataset.mode) }));
    }
    byId("image-side").addEventListener("click", () => this.switchSide());
    byId("image-neighbours").addEventListener("click", () => this.toggleNeighbours());
  }

  /** @returns {Command[]} */
  commands() {
    /** @type {(key: string, title: string, run: () => void, shift?: boolean) => Command} */
    const show = (key, title, run, shift = false) => ({ key, shift, title, run, group: "Image and matrix" });
    return [
      show("1", "Map projected with the estimate", () => this.setImage({ mode: "estimate" })),
      show("2", "Map projected with the true pose", () => this.setImage({ mode: "truth" })),
      show("3", "Pairs with outliers", () => this.setImage({ mode: "pairs" })),
      show("4", "Error: map from true pose to estimate", () => this.setImage({ mode: "error" })),
      show("r", "Residuals", () => this.toggleResiduals()),
      show("k", "Left or right image", () => this.switchSide()),
      show("k", "Neighbouring images", () => this.toggleNeighbours(), true),
      show("z", "Zoom to the selection", () => this.zoomToSelection()),
      show("0", "Whole image", () => this.fit()),
    ];
  }

  /** @returns {AddressPart[]} */
  address() {
    return [
      {
        fields: { image: oneOf("estimate", "truth", "pairs", "error"), side: oneOf("left", "right"), around: flag() },
        get: () => ({ image: this.state.mode, side: this.state.side, around: yes(this.state.neighbours) }),
        set: ({ image, side, around }) => this.setImage({ mode: image, side, neighbours: around === "yes" }),
      },
      {
        fields: { residuals: flag("yes") },
        get: () => ({ residuals: yes(this.residuals) }),
        set: ({ residuals }) => { if ((residuals === "yes") !== this.residuals) this.toggleResiduals(); },
      },
    ];
  }

  /** Zoom, pan and clicks on a canvas that is drawn in this panel's view; `pick` gets the point of a
   * click, in CSS pixels.
   *
   * @param {HTMLCanvasElement} canvas
   * @param {(at: Point) => void} pick
   */
  listen(canvas, pick) {
    enableZoomAndPan(canvas, this.view, () => { this.fitted = false; this.surface.redraw(); });
    /** @type {Point | null} */
    let down = null;
    canvas.addEventListener("pointerdown", (event) => { down = pointerAt(event); });
    canvas.addEventListener("pointerup", (event) => {
      const at = pointerAt(event);
      if (event.button === 0 && down && Math.hypot(at[0] - down[0], at[1] - down[1]) < 4) pick(at);
    });
    canvas.addEventListener("dblclick", () => this.fit());
  }

  /* From the server */

  /** @param {OpenRun} run */
  showRun(run) {
    this.frame = null;
    this.model = null;
    this.coming = null;
    this.right = null;
    this.classes = new Map(run.classes.map((kind) => [kind.id, kind]));
    byId("image-side").hidden = !run.image_right;
    this.#showTitle();
    this.images.open(run);
    this.applySize();
  }

  #showTitle() {
    if (!this.page.store.isOpen) return;
    const { camera, image_right: right } = this.page.store.run;
    const title = right ? TITLES[this.state.side] : "Image";
    byId("image-title").textContent = camera ? `Camera ${camera}` : title;
  }

  /** @param {FrameView} frame */
  showFrame(frame) {
    this.coming = frame;
    this.show();
  }

  /** @param {RightImageEvent} right */
  showRight(right) {
    this.right = right;
    this.show();
  }

  /** @param {StateView} state */
  showState(state) {
    const isSwitched = state.side !== this.state.side;
    this.state = state;
    if (isSwitched && this.page.store.isOpen) this.applySize();
    this.#showTitle();
    byId("image-neighbours").setAttribute("aria-pressed", String(state.neighbours));
    for (const button of this.modes) {
      button.setAttribute("aria-pressed", String(button.dataset.mode === state.mode));
    }
    if (isSwitched) this.show();
    else if (this.coming === this.frame) this.update();
  }

  /** @param {WhatIfEvent} event */
  showWhatIf({ result }) {
    this.whatIf = result;
    this.update();
  }

  /** Draws the coming frame as soon as its image and, for the right side, its map have arrived. */
  async show() {
    const { coming, state: { side } } = this;
    if (!coming || (side === "right" && this.right?.position !== coming.position)) return;
    const { bitmap, reason } = await this.images.get(coming.position, side);
    if (this.coming !== coming || this.state.side !== side) return; // a later request
    this.frame = coming;
    this.rightShown = side === "right" ? this.right : null;
    this.bitmap = bitmap;
    this.missingReason = reason;
    this.update();
    this.images.prefetch(coming.position, side);
  }

  update() {
    if (!this.frame) return;
    const { mode, element } = this.state;
    this.model = new ImageModel(this.frame, mode, this.size, this.rightShown);
    const absent = element === null ? "" : this.model.whyAbsent(element);
    const whatIf = this.whatIfElements.length ? "thick dashes: what if" : "";
    const said = (/** @type {string} */ about) => [absent, whatIf, this.missingReason, about].filter(Boolean).join(" · ");
    byId("image-about").textContent = said(this.model.about);
    byId("image-about").title = said(this.model.details);
    this.surface.redraw();
  }

  /** The map projected with the what-if pose, if this image shows its frame. */
  get whatIfElements() {
    const { whatIf, frame, state } = this;
    return whatIf && whatIf.position === frame?.position && state.side === "left" ? whatIf.mapped : [];
  }

  get size() {
    const { run } = this.page.store;
    return (this.state.side === "right" && run.image_right) || run.image;
  }

  applySize() {
    const panel = byId("image");
    panel.style.setProperty("--image-width", String(this.size.width));
    panel.style.setProperty("--image-height", String(this.size.height));
    this.fit();
  }

  /* From the user */

  /** @param {{mode?: StateView["mode"], side?: StateView["side"], neighbours?: boolean}} wish */
  setImage(wish) {
    this.page.socket.send("set_image", wish);
  }

  switchSide() {
    this.setImage({ side: this.state.side === "left" ? "right" : "left" });
  }

  toggleNeighbours() {
    this.setImage({ neighbours: !this.state.neighbours });
  }

  toggleResiduals() {
    this.residuals = !this.residuals;
    this.page.address.changed();
    this.surface.redraw();
  }

  fit() {
    this.view.fit(this.size.width, this.size.height, this.surface.width, this.surface.height);
    this.fitted = true;
    this.surface.redraw();
  }

  zoomToSelection() {
    const place = this.placeOfSelection();
    if (!place) return;
    const [u, v] = middle(...place);
    const { width, height } = this.surface;
    this.view.fit(this.size.width, this.size.height, width, height);
    this.view.scale *= 4;
    this.view.x = width / 2 - this.view.scale * (u + 0.5);
    this.view.y = height / 2 - this.view.scale * (v + 0.5);
    this.fitted = false;
    this.surface.redraw();
  }

  placeOfSelection() {
    const { model, state: { observed, element } } = this;
    if (!model) return null;
    const seen = observed === null ? undefined : model.observed[observed];
    const row = model.frame.mapped.findIndex((mapped) => mapped.id === element);
    if (seen) return placeOf(seen);
    return row < 0 ? null : model.place(row);
  }

  /** @param {Point} at */
  pick(at) {
    if (this.model) this.page.select(pickAt(this.model, this.view, at));
  }

  /* Drawing */

  /**
   * @param {Context} context
   * @param {number} width
   * @param {number} height
   */
  draw(context, width, height) {
    if (!this.model) return;
    drawPhoto(context, this.bitmap, this.view, this.size);
    drawModel(context, this.model, this.view, width, height, this.look());
    drawWhatIf(context, this.whatIfElements, this.view, this.classes);
  }

  /**
   * @param {boolean} [legend]
   * @returns {ImageLook}
   */
  look(legend = true) {
    const { observed, element } = this.state;
    return { classes: this.classes, observed, element, vectors: this.residuals, legend };
  }

  /** The view as shown, without the margins around a whole image.
   *
   * @returns {Figure[]}
   */
  figures() {
    const { model } = this;
    if (!model) return [];
    const { mode, side } = this.state;
    const parts = ["image", mode === "estimate" ? "" : mode, side === "left" ? "" : side];
    const view = new View();
    view.copyFrom(this.view);
    if (this.fitted) [view.x, view.y] = [0, 0];
    const width = this.fitted ? view.scale * this.size.width : this.surface.width;
    const height = this.fitted ? view.scale * this.size.height : this.surface.height;
    /** @type {NonNullable<Figure["draw"]>} */
    const draw = (context, { photo, legend }) => {
      if (photo) drawPhoto(context, this.bitmap, view, this.size);
      drawModel(context, model, view, width, height, this.look(legend));
      drawWhatIf(context, this.whatIfElements, view, this.classes);
    };
    return [{ name: parts.filter(Boolean).join("-"), title: "Image", width, height, draw, hasPhoto: Boolean(this.bitmap), hasLegend: true }];
  }
}

/** The detection or the element at a point of the canvas; neither if none is near.
 *
 * @param {ImageModel} model
 * @param {View} view
 * @param {Point} at
 * @returns {{observed?: number, element?: number}}
 */
export function pickAt(model, view, at) {
  /** @param {Ends | null} place */
  const far = (place) => (place ? gap(at, nearestOn([view.toScreen(place[0]), place[1] && view.toScreen(place[1])], at)) : Infinity);
  const seen = nearest(model.observed.map((detection) => far(placeOf(detection))));
  if (seen !== null) return { observed: seen };
  const { mapped } = model;
  const place = nearest(mapped.map((row) => far(model.place(row))));
  return place === null ? {} : { element: model.frame.mapped[mapped[place]].id };
}

/** The index of the smallest of `distances`; null if none is below HIT_PX.
 *
 * @param {number[]} distances
 */
function nearest(distances) {
  const least = Math.min(...distances);
  return least < HIT_PX ? distances.indexOf(least) : null;
}
