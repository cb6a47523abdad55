/* The image panel: which image, what is drawn on it, and what people do with it. */

import { Surface, View, enableZoomAndPan, pointerAt } from "/static/canvas.js";
import { byId } from "/static/dom.js";
import { flag, oneOf, yes } from "./address.js";
import { drawPhoto, drawSight, drawTried } from "./image_drawing.js";
import { Sight, gap, middle, nearestOn, placeOf } from "./image_model.js";
import { Pictures } from "./pictures.js";

const HIT_PX = 12;
const TITLES = { left: "Left image", right: "Right image" };

export class ImagePanel {
  constructor(page, painted) {
    this.page = page;
    this.residuals = true;
    this.state = { mode: "estimate", side: "left" };
    this.view = new View();
    this.fitted = true;
    this.pictures = new Pictures();
    const canvas = byId("image-canvas");
    this.surface = new Surface(canvas, (...size) => this.draw(...size));
    this.surface.onpainted = painted;
    this.surface.onresize = () => this.fitted && this.run && this.fit();
    this.listen(canvas, (at) => this.pick(at));
    for (const button of document.querySelectorAll("[data-mode]")) {
      button.addEventListener("click", () => this.ask({ mode: button.dataset.mode }));
    }
    byId("image-side").addEventListener("click", () => this.switchSide());
    byId("image-neighbours").addEventListener("click", () => this.toggleNeighbours());
  }

  commands() {
    const show = (key, title, run, shift = false) => ({ key, shift, title, run, group: "Image and matrix" });
    return [
      show("1", "Map with the estimate", () => this.ask({ mode: "estimate" })),
      show("2", "Map with the truth", () => this.ask({ mode: "truth" })),
      show("3", "Pairs with outliers", () => this.ask({ mode: "pairs" })),
      show("4", "Error: the map from truth to estimate", () => this.ask({ mode: "error" })),
      show("r", "Residuals", () => this.toggleResiduals()),
      show("k", "Left or right image", () => this.switchSide()),
      show("k", "Images before and after", () => this.toggleNeighbours(), true),
      show("z", "Zoom to the selection", () => this.zoomToSelection()),
      show("0", "Whole image", () => this.fit()),
    ];
  }

  address() {
    return [
      {
        fields: { image: oneOf("estimate", "truth", "pairs", "error"), side: oneOf("left", "right"), around: flag() },
        get: () => ({ image: this.state.mode, side: this.state.side, around: yes(this.state.neighbours) }),
        set: ({ image, side, around }) => this.ask({ mode: image, side, neighbours: around === "yes" }),
      },
      {
        fields: { residuals: flag("yes") },
        get: () => ({ residuals: yes(this.residuals) }),
        set: ({ residuals }) => { if ((residuals === "yes") !== this.residuals) this.toggleResiduals(); },
      },
    ];
  }

  /** Zoom, pan and clicks on a canvas that is drawn through this panel's view; `pick(at)` is called
   * with what was clicked, in CSS pixels. */
  listen(canvas, pick) {
    enableZoomAndPan(canvas, this.view, () => { this.fitted = false; this.surface.redraw(); });
    let down = null;
    canvas.addEventListener("pointerdown", (event) => { down = pointerAt(event); });
    canvas.addEventListener("pointerup", (event) => {
      const at = pointerAt(event);
      if (event.button === 0 && down && Math.hypot(at[0] - down[0], at[1] - down[1]) < 4) pick(at);
    });
    canvas.addEventListener("dblclick", () => this.fit());
  }

  /* What the server says */

  showRun(run) {
    this.run = run;
    this.frame = null;
    this.sight = null;
    this.coming = null;
    this.right = null;
    this.classes = new Map(run.classes.map((one) => [one.id, one]));
    byId("image-side").hidden = !run.imageRight;
    this.pictures.open(run);
    this.takeSize();
  }

  showFrame(frame) {
    this.coming = frame;
    this.show();
  }

  showRight(right) {
    this.right = right;
    this.show();
  }

  showState(state) {
    const turned = state.side !== this.state.side;
    this.state = state;
    if (turned && this.run) this.takeSize();
    byId("image-title").textContent = TITLES[state.side];
    byId("image-neighbours").setAttribute("aria-pressed", state.neighbours);
    for (const button of document.querySelectorAll("[data-mode]")) {
      button.setAttribute("aria-pressed", button.dataset.mode === state.mode);
    }
    if (turned) this.show();
    else if (this.coming === this.frame) this.see();
  }

  showWhatIf({ result }) {
    this.tried = result;
    this.see();
  }

  /** Draws the frame that is coming as soon as its picture is there and, in the right image, where
   * its map is. */
  async show() {
    const { coming, state: { side } } = this;
    if (!coming || (side === "right" && this.right?.position !== coming.position)) return;
    const { picture, why } = await this.pictures.get(coming.position, side);
    if (this.coming !== coming || this.state.side !== side) return; // something later was asked for
    this.frame = coming;
    this.rightShown = side === "right" ? this.right : null;
    this.picture = picture;
    this.whyNoPicture = why;
    this.see();
    this.pictures.prefetch(coming.position, side);
  }

  see() {
    if (!this.frame) return;
    const { mode, element } = this.state;
    this.sight = new Sight(this.frame, mode, this.size, this.rightShown);
    const absent = element === null ? "" : this.sight.whyAbsent(element);
    const tried = this.triedHere.length ? "thick dashes: tried" : "";
    const about = [absent, tried, this.whyNoPicture, this.sight.about].filter(Boolean).join(" · ");
    byId("image-about").textContent = about;
    byId("image-about").title = about;
    this.surface.redraw();
  }

  /** The map under a pose that is being tried, where this image shows it. */
  get triedHere() {
    const isHere = this.tried?.position === this.frame.position && this.state.side === "left";
    return isHere ? (this.tried.mapped ?? []) : [];
  }

  get size() {
    return (this.state.side === "right" && this.run.imageRight) || this.run.image;
  }

  takeSize() {
    const panel = byId("image");
    panel.style.setProperty("--image-width", this.size.width);
    panel.style.setProperty("--image-height", this.size.height);
    this.fit();
  }

  /* What people ask for */

  /** `{mode, side, neighbours}`, or some of them. */
  ask(wish) {
    this.page.socket.send({ verb: "image", ...wish });
  }

  switchSide() {
    this.ask({ side: this.state.side === "left" ? "right" : "left" });
  }

  toggleNeighbours() {
    this.ask({ neighbours: !this.state.neighbours });
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
    if (!this.sight) return null;
    const seen = this.sight.observed[this.state.observed];
    const row = this.frame.mapped.findIndex((one) => one.id === this.state.element);
    if (seen) return placeOf(seen);
    return row < 0 ? null : this.sight.place(row);
  }

  pick(at) {
    if (this.sight) this.page.select(found(this.sight, this.view, at));
  }

  /* Drawing */

  draw(context, width, height) {
    if (!this.sight) return;
    drawPhoto(context, this.picture, this.view, this.size);
    drawSight(context, this.sight, this.view, width, height, this.look());
    drawTried(context, this.triedHere, this.view, this.classes);
  }

  look(legend = true) {
    const { observed, element } = this.state;
    return { classes: this.classes, observed, element, vectors: this.residuals, legend };
  }

  /** What is shown, without the free room around a whole image. */
  figures() {
    if (!this.sight) return [];
    const { mode, side } = this.state;
    const parts = ["image", mode === "estimate" ? "" : mode, side === "left" ? "" : side];
    const view = new View();
    view.copyFrom(this.view);
    if (this.fitted) [view.x, view.y] = [0, 0];
    const width = this.fitted ? view.scale * this.size.width : this.surface.width;
    const height = this.fitted ? view.scale * this.size.height : this.surface.height;
    const draw = (context, { photo, legend }) => {
      if (photo) drawPhoto(context, this.picture, view, this.size);
      drawSight(context, this.sight, view, width, height, this.look(legend));
      drawTried(context, this.triedHere, view, this.classes);
    };
    return [{ name: parts.filter(Boolean).join("-"), title: "Image", width, height, draw, hasPhoto: Boolean(this.picture), hasLegend: true }];
  }
}

/** What is drawn at a point of the canvas: `{observed}`, or `{element}`, or neither. */
export function found(sight, view, at) {
  const far = (place) => gap(at, nearestOn(place.map((point) => point && view.toScreen(point)), at));
  const seen = nearest(sight.observed.map((one) => far(placeOf(one))));
  if (seen !== null) return { observed: seen };
  const { mapped } = sight;
  const place = nearest(mapped.map((row) => far(sight.place(row))));
  return place === null ? {} : { element: sight.frame.mapped[mapped[place]].id };
}

/** The index of the least of `distances` under HIT_PX; null where there is none. */
function nearest(distances) {
  const least = Math.min(...distances);
  return least < HIT_PX ? distances.indexOf(least) : null;
}
