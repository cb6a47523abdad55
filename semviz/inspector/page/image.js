/* The image with what was seen in it, the map projected into it, and the residuals. */

import { Surface, View, enableZoomAndPan, pointerAt } from "/static/canvas.js";
import { byId } from "/static/dom.js";
import {
  ON_IMAGE, drawArrow, drawGlyph, drawHandle, drawLine, residualColor,
} from "/static/glyphs.js";
import { drawLegend } from "./legend.js";
import { Labels } from "./labels.js";
import { Pictures } from "./pictures.js";

export const MAGNIFICATION = 8;
const HIT_PX = 12;
const ABOUT = {
  estimate: "map projected with the estimate",
  truth: "map projected with the truth",
  pairs: "pairs and outliers",
};
const NO_MAP = {
  estimate: "no pose: no map here; 2 shows it with the truth",
  truth: "no truth: no map here; 1 shows it with the estimate",
  pairs: "no pose: no pairs",
};

export class ImagePanel {
  constructor(page, painted) {
    this.page = page;
    this.mode = "estimate";
    this.residuals = true;
    this.state = {};
    this.view = new View();
    this.fitted = true;
    this.pictures = new Pictures();
    const canvas = byId("image-canvas");
    this.surface = new Surface(canvas, (...size) => this.draw(...size));
    this.surface.onpainted = painted;
    this.surface.onresize = () => this.fitted && this.run && this.fit();
    enableZoomAndPan(canvas, this.view, () => { this.fitted = false; this.surface.redraw(); });
    this.listenForClicks(canvas);
    for (const button of document.querySelectorAll("[data-mode]")) {
      button.addEventListener("click", () => this.setMode(button.dataset.mode));
    }
    this.setMode("estimate");
  }

  listenForClicks(canvas) {
    let down = null;
    canvas.addEventListener("pointerdown", (event) => { down = pointerAt(event); });
    canvas.addEventListener("pointerup", (event) => {
      const at = pointerAt(event);
      if (event.button === 0 && down && Math.hypot(at[0] - down[0], at[1] - down[1]) < 4) this.pick(at);
    });
    canvas.addEventListener("dblclick", () => this.fit());
  }

  showRun(run) {
    this.run = run;
    this.frame = null;
    this.coming = null;
    this.classes = new Map(run.classes.map((one) => [one.id, one]));
    const panel = byId("image");
    panel.style.setProperty("--image-width", run.image.width);
    panel.style.setProperty("--image-height", run.image.height);
    this.pictures.open(run);
    this.fit();
  }

  async showFrame(frame) {
    this.coming = frame;
    const picture = frame.hasImage ? await this.pictures.get(frame.position) : null;
    if (this.coming !== frame) return; // a later frame was asked for meanwhile
    this.frame = frame;
    this.picture = picture;
    this.pairOf = new Map(frame.pairs.map((pair) => [pair.observed, pair]));
    this.tellAbout();
    this.surface.redraw();
    this.pictures.prefetch(frame.position);
  }

  showState(state) {
    this.state = state;
    if (this.coming === this.frame) this.surface.redraw();
  }

  setMode(mode) {
    this.mode = mode;
    for (const button of document.querySelectorAll("[data-mode]")) {
      button.setAttribute("aria-pressed", button.dataset.mode === mode);
    }
    this.tellAbout();
    this.surface.redraw();
  }

  /** What is drawn, and why some of it is not there. */
  tellAbout() {
    const projected = this.mode === "truth" ? this.frame?.hasTruth : this.frame?.status !== "cannot";
    const map = this.frame && !projected ? NO_MAP[this.mode] : ABOUT[this.mode];
    const recorded = this.frame && !this.frame.hasImage ? "; this run has no images" : "";
    byId("image-about").textContent = map + recorded;
    byId("image-about").title = map + recorded;
  }

  toggleResiduals() {
    this.residuals = !this.residuals;
    this.surface.redraw();
  }

  fit() {
    const { width, height } = this.run.image;
    this.view.fit(width, height, this.surface.width, this.surface.height);
    this.fitted = true;
    this.surface.redraw();
  }

  zoomToSelection() {
    const seen = this.frame?.observed[this.state.observed];
    if (!seen) return;
    const [u, v] = middle(seen);
    this.view.scale = 4 * Math.min(this.surface.width / this.run.image.width, this.surface.height / this.run.image.height);
    this.view.x = this.surface.width / 2 - this.view.scale * (u + 0.5);
    this.view.y = this.surface.height / 2 - this.view.scale * (v + 0.5);
    this.fitted = false;
    this.surface.redraw();
  }

  /* Selection */

  pick(at) {
    if (!this.frame) return;
    const near = (anchor, end) => distance(at, this.view.toScreen(anchor), end && this.view.toScreen(end));
    const observed = nearest(this.frame.observed, (one) => near(one.anchor, one.end));
    if (observed !== null) {
      this.page.select({ observed });
      return;
    }
    const mapped = nearest(this.frame.mapped, (one) => {
      const place = this.placeOf(one);
      return place ? near(...place) : Infinity;
    });
    this.page.select(mapped === null ? {} : { element: this.frame.mapped[mapped].id });
  }

  placeOf(mapped) {
    return this.mode === "truth" ? mapped.truth : mapped.estimate;
  }

  pairs() {
    return this.mode === "truth" ? this.frame.truePairs : this.frame.pairs;
  }

  /* Drawing */

  draw(context, width, height) {
    if (!this.run || !this.frame) return;
    this.drawPicture(context);
    const labels = new Labels(context, width, height);
    this.drawMap(context, labels);
    this.drawObserved(context, labels);
    if (this.residuals) this.drawResiduals(context);
    this.drawSelection(context, labels);
    labels.draw();
    drawLegend(context, height, this.view.scale * MAGNIFICATION, MAGNIFICATION, this.mode);
  }

  drawPicture(context) {
    const { width, height } = this.run.image;
    const { scale, x, y } = this.view;
    context.imageSmoothingEnabled = scale < 3;
    context.imageSmoothingQuality = "high";
    if (this.picture) {
      context.drawImage(this.picture, x, y, scale * width, scale * height);
    } else {
      context.fillStyle = "#3A3D42";
      context.fillRect(x, y, scale * width, scale * height);
    }
  }

  drawMap(context, labels) {
    const color = this.mode === "truth" ? ON_IMAGE.truth : ON_IMAGE.estimate;
    const matched = new Set(this.pairs().map((pair) => pair.mapped));
    this.frame.mapped.forEach((one, row) => {
      const place = this.placeOf(one);
      if (!place || (this.mode === "pairs" && !matched.has(row))) return;
      const width = matched.has(row) ? 1.6 : 1;
      const dash = matched.has(row) ? [] : [5, 4];
      const [anchor, end] = place.map((point) => point && this.view.toScreen(point));
      if (end) drawLine(context, anchor, end, color, width, dash);
      else drawGlyph(context, this.classes.get(one.class).shape, ...anchor, 7, color, width, dash);
      const chosen = one.id === this.state.element;
      if (!matched.has(row) && (chosen || this.mode === "truth")) labels.add(one.name, anchor, { color, weight: 400, first: chosen });
    });
  }

  drawObserved(context, labels) {
    this.frame.observed.forEach((one, row) => {
      const { shape, color } = this.classes.get(one.class);
      const [anchor, end] = [one.anchor, one.end].map((point) => point && this.view.toScreen(point));
      if (end) {
        drawLine(context, anchor, end, color, 2);
        drawHandle(context, "peak", ...anchor, color, one.anchorKnown);
        drawHandle(context, "bottom", ...end, color, one.endKnown);
      } else {
        drawGlyph(context, shape, ...anchor, 7, color, 2);
      }
      const pair = this.pairOf.get(row);
      const name = pair ? this.frame.mapped[pair.mapped].name : `#${row}`;
      if (row !== this.state.observed) labels.add(name, anchor, { color: "#FFFFFF", weight: pair ? 600 : 400 });
    });
  }

  drawResiduals(context) {
    for (const pair of this.pairs()) {
      if (pair.vector.includes(null) || pair.start.includes(null)) continue;
      const start = this.view.toScreen(pair.start);
      const length = this.view.scale * (this.mode === "pairs" ? 1 : MAGNIFICATION);
      const end = [start[0] + length * pair.vector[0], start[1] + length * pair.vector[1]];
      const color = pair.inlier ? residualColor(pair.residualPx) : ON_IMAGE.cannot;
      if (!pair.inlier) drawLine(context, start, end, color, 1.6, [3, 3]);
      else if (Math.hypot(end[0] - start[0], end[1] - start[1]) > 1) drawArrow(context, start, end, color, 2.6);
    }
  }

  drawSelection(context, labels) {
    const { observed, element } = this.state;
    const seen = this.frame.observed[observed];
    const mapped = this.frame.mapped.find((one) => one.id === element);
    const place = mapped && this.placeOf(mapped);
    if (!seen) {
      if (place) this.ring(context, ...place);
      return;
    }
    this.ring(context, seen.anchor, seen.end);
    const pair = this.pairOf.get(observed);
    const probability = this.probability(observed, pair);
    const name = mapped ? `#${observed} × ${mapped.name}` : `#${observed}, no pair`;
    const value = pair ? `${pair.residualPx.toFixed(1)} px${pair.inlier ? "" : ", outlier"}` : "";
    labels.add(name, this.view.toScreen(seen.anchor), { first: true, second: [value, probability].filter(Boolean).join(", ") });
  }

  probability(observed, pair) {
    const matrix = this.frame.matrix?.probability;
    return pair && matrix ? `p ${matrix[observed][pair.mapped].toFixed(2)}` : "";
  }

  ring(context, anchor, end) {
    context.strokeStyle = ON_IMAGE.accent;
    const from = this.view.toScreen(anchor);
    const to = end ? this.view.toScreen(end) : from;
    const angle = Math.atan2(to[1] - from[1], to[0] - from[0]);
    context.beginPath();
    context.arc(...from, 12, angle + Math.PI / 2, angle - Math.PI / 2);
    context.arc(...to, 12, angle - Math.PI / 2, angle + Math.PI / 2);
    context.closePath();
    context.lineWidth = 2.2;
    context.stroke();
  }
}

function middle({ anchor, end }) {
  return end ? [(anchor[0] + end[0]) / 2, (anchor[1] + end[1]) / 2] : anchor;
}

/** Distance of a point from a segment, or from a point where there is no second end. */
function distance([x, y], [ax, ay], end) {
  if (!end) return Math.hypot(x - ax, y - ay);
  const [dx, dy] = [end[0] - ax, end[1] - ay];
  const share = Math.min(1, Math.max(0, ((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy || 1)));
  return Math.hypot(x - ax - share * dx, y - ay - share * dy);
}

/** The index with the least distance under HIT_PX; null where there is none. */
function nearest(items, distanceOf) {
  let best = null;
  let least = HIT_PX;
  items.forEach((item, index) => {
    const far = distanceOf(item);
    if (far < least) [best, least] = [index, far];
  });
  return best;
}
