/* The images before and after, under the image: small, or, where something is selected, cut out
 * around it, all at one scale. A click goes there. */

import { Surface, View, cssColor, pointerAt } from "/static/canvas.js";
import { byId, fixed } from "/static/dom.js";
import { ON_IMAGE, drawMark } from "/static/glyphs.js";
import { drawMapped, drawPhoto, drawSeen } from "./image_drawing.js";
import { middle } from "./image_model.js";

const GAP = 6;
const CAPTION = 20;
const SHARE = 0.55; // of a picture's height that a selected pole fills
const MOST = 4; // times the image's own size

export class Neighbours {
  constructor(page) {
    this.page = page;
    this.shown = [];
    const canvas = byId("neighbours-canvas");
    this.surface = new Surface(canvas, (...size) => this.draw(...size));
    canvas.addEventListener("click", (event) => this.pick(pointerAt(event)));
    canvas.addEventListener("pointermove", (event) => this.hint(pointerAt(event)));
  }

  showRun(run) {
    this.run = run;
    this.shown = [];
    this.classes = new Map(run.classes.map((one) => [one.id, one]));
  }

  showState(state) {
    byId("neighbours").hidden = !state.neighbours;
  }

  showTheme() {
    this.surface.redraw();
  }

  async showNeighbours(neighbours) {
    this.coming = neighbours;
    const { pictures } = this.page.image;
    const loaded = await Promise.all(neighbours.map((one) => pictures.get(one.position, "left")));
    if (this.coming !== neighbours) return;
    this.shown = neighbours.map((one, k) => ({ ...one, row: this.run.frames[one.position], picture: loaded[k].picture }));
    this.surface.redraw();
  }

  figures() {
    return this.shown.length && !byId("neighbours").hidden ? [this.surface.figure("around", "Around")] : [];
  }

  at([x]) {
    const width = this.surface.width / Math.max(1, this.shown.length);
    return this.shown[Math.floor(x / width)];
  }

  pick(point) {
    const there = this.at(point);
    if (there) this.page.go(there.position);
  }

  hint(point) {
    const there = this.at(point);
    if (there) this.surface.canvas.title = `Frame ${there.row.index}: ${there.row.verdict}`;
  }

  /* Drawing */

  draw(context, width, height) {
    const cell = (width - GAP * (this.shown.length - 1)) / this.shown.length;
    const scale = this.scale(cell, height - CAPTION);
    this.shown.forEach((one, k) => {
      const left = k * (cell + GAP);
      this.drawCell(context, one, [left, cell, height - CAPTION], scale);
      this.drawCaption(context, one, left, height - CAPTION / 2);
    });
  }

  /** One for all, so that sizes can be compared: the whole image, or what is selected well in sight. */
  scale(width, height) {
    const [across, down] = [width / this.run.image.width, height / this.run.image.height];
    const places = this.shown.map(placeOf).filter(Boolean);
    if (!places.length) return Math.min(across, down);
    const longest = Math.max(1, ...places.map(([a, b]) => (b ? Math.hypot(a[0] - b[0], a[1] - b[1]) : 12)));
    return Math.max(across, down, Math.min(MOST, (SHARE * height) / longest));
  }

  drawCell(context, one, [left, width, height], scale) {
    const { width: w, height: h } = this.run.image;
    const place = placeOf(one);
    const [u, v] = place ? middle(...place) : [w / 2, h / 2];
    const view = new View();
    view.scale = scale;
    view.x = left + covering(width / 2 - scale * u, width, scale * w);
    view.y = covering(height / 2 - scale * v, height, scale * h);
    context.save();
    context.beginPath();
    context.rect(left, 0, width, height);
    context.clip();
    drawPhoto(context, one.picture, view, this.run.image);
    const at = (point) => view.toScreen(point);
    if (one.mapped) drawMapped(context, this.classes.get(one.mapped.class), one.mapped.place, at, ON_IMAGE.estimate, one.seen);
    if (one.seen) drawSeen(context, this.classes.get(one.seen.class), one.seen.place, at);
    context.restore();
    if (!this.isHere(one)) return;
    context.strokeStyle = cssColor("--text");
    context.lineWidth = 2;
    context.strokeRect(left + 1, 1, width - 2, height - 2);
  }

  isHere({ position }) {
    return position === this.page.frame?.position;
  }

  drawCaption(context, one, left, y) {
    const { row } = one;
    const isHere = this.isHere(one);
    drawMark(context, row.status, left + 8, y, 4, cssColor(`--${row.sureAndWrong ? "cannot" : row.status}`));
    context.font = `${isHere ? 600 : 400} 11px Inter, "Liberation Sans", Arial, sans-serif`;
    context.textAlign = "left";
    context.textBaseline = "middle";
    context.fillStyle = cssColor(isHere ? "--text" : "--dim");
    const error = row.errorM === null ? (row.status === "cannot" ? "no pose" : "") : `${fixed(row.errorM, 2)} m`;
    context.fillText(["frame " + row.index, error].filter(Boolean).join(" · "), left + 18, y);
  }
}

/** Where the selected element is: as it is seen, or else as the map has it. */
const placeOf = ({ seen, mapped }) => (seen ?? mapped)?.place;

/** An offset of a picture of `size` in `room`, changed so that it leaves none of it free; in the
 * middle where it cannot fill it. */
function covering(offset, room, size) {
  return size < room ? (room - size) / 2 : Math.min(0, Math.max(room - size, offset));
}
