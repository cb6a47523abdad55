/* The frame as run A has it, beside the page's own image, which is of run B: the same side, mode,
 * crop and zoom, since both are drawn through one view. */

import { Surface } from "/static/canvas.js";
import { byId } from "/static/dom.js";
import { found } from "../image.js";
import { drawPhoto, drawSight } from "../image_drawing.js";
import { Sight } from "../image_model.js";
import { Pictures } from "../pictures.js";

export class BaseImage {
  /** `same` is a SameElement. */
  constructor(page, same) {
    this.page = page;
    this.same = same;
    this.run = null;
    this.pictures = new Pictures();
    this.surface = new Surface(byId("base-image-canvas"), (...size) => this.draw(...size));
    page.image.listen(this.surface.canvas, (at) => this.pick(at));
    this.forget();
  }

  forget() {
    this.coming = { index: null, frame: null, right: null };
    this.shown = { ...this.coming, picture: null };
    this.sight = null;
  }

  showComparison({ base }) {
    this.forget();
    this.run = base;
    this.classes = new Map(base.classes.map((one) => [one.id, one]));
    this.pictures.open({ ...base, frames: [] });
    this.surface.redraw();
  }

  figures() {
    return this.surface.width && this.sight ? [this.surface.figure("image-of-A", "Image of A")] : [];
  }

  showBaseFrame(message) {
    this.coming = message;
    this.show();
  }

  showState({ side }) {
    if (side !== this.side) this.show();
    this.side = side;
    this.see();
  }

  async show() {
    const { coming, page: { state: { side } } } = this;
    const { picture } = coming.frame ? await this.pictures.get(coming.frame.position, side) : { picture: null };
    if (this.coming !== coming || this.page.state.side !== side) return; // something later was asked for
    this.shown = { ...coming, picture };
    this.see();
  }

  see() {
    const { frame, right } = this.shown;
    const { mode, side } = this.page.state;
    const isWhole = frame && !(side === "right" && !right);
    this.sight = isWhole ? new Sight(frame, mode, this.page.image.size, side === "right" ? right : null) : null;
    byId("base-image-none").textContent = this.shown.index === null || frame ? "" : `A has no frame ${this.shown.index}.`;
    this.surface.redraw();
  }

  /** The page's own image was painted: this one follows its view. */
  imagePainted() {
    this.surface.redraw();
  }

  pick(at) {
    if (!this.sight) return;
    const { observed, element } = found(this.sight, this.page.image.view, at);
    const pair = this.shown.frame.pairs.find((one) => one.observed === observed);
    const base = pair ? this.shown.frame.mapped[pair.mapped].id : element;
    this.page.select(base === undefined ? {} : { element: this.same.inOther(base) });
  }

  draw(context, width, height) {
    const { sight, page: { image } } = this;
    if (!sight) return;
    drawPhoto(context, this.shown.picture, image.view, image.size);
    const selection = this.same.selection(this.page.state, this.page.frame, this.shown.frame);
    drawSight(context, sight, image.view, width, height, { ...image.look(), ...selection, classes: this.classes });
  }
}
