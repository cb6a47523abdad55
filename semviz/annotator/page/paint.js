// Elements, ghosts, guides and the loupe on an image. Sizes are CSS pixels and don't grow with zoom.
import { CASING, drawArrow, drawGlyph, drawHandle, drawLine, drawText } from "/static/glyphs.js";
import { shownScore } from "./state.js";

const ACCENT = "#4DABF7"; // the dark set is used on images in both themes
const HANDLE_HIT = 8; // a handle is taken hold of within this radius
const GLYPH = 7;
const SELECTED_GLYPH = 8;
const LABEL_SIZE = 11;

/** Paints one frame's overlay of one image; `labels` last, so that they lie above all lines. */
export class Painter {
  /** `shownKey(name)`: what a command's key is called now. */
  constructor(context, view, classOf, shownKey) {
    this.context = context;
    this.view = view;
    this.classOf = classOf;
    this.shownKey = shownKey;
    this.texts = [];
  }

  /** A labelled element. `reviewed`: a question of the last map is about it. `vertex`: the end that the
   * arrow keys move, null where it isn't in hand. */
  element(element, observation, { selected, hovered, reviewed, vertex }) {
    const { color, shape, kind } = this.classOf(element.class);
    const anchor = this.view.toScreen(observation.anchor);
    const width = hovered ? 3 : 2;
    const dash = element.kept ? [2, 2] : [];
    if (kind === "line") {
      const end = this.view.toScreen(observation.end);
      if (selected || reviewed) this.#halo(anchor, end);
      drawLine(this.context, anchor, end, color, width, dash);
      this.#poleEnd("peak", anchor, end, color, observation.anchor_known, vertex === "anchor");
      this.#poleEnd("bottom", end, anchor, color, observation.end_known, vertex === "end");
    } else {
      if (selected || reviewed) this.#ring(anchor, GLYPH + 6);
      drawGlyph(this.context, shape, ...anchor, selected ? SELECTED_GLYPH : GLYPH, color, width, dash);
      this.#dot(anchor, color);
    }
    const text = selected ? [element.name, ...missing(kind, observation)].join(" · ") : element.name;
    this.#label(text, anchor, selected ? 3 : reviewed ? 2.5 : 2, observation.end);
  }

  /** A proposal: dashed, never filled; what isn't sure is dotted. The current one says so. */
  offer(offer, mark, { selected, current, reviewed }) {
    const { score, runner_up } = mark;
    this.#proposed(offer, mark, { selected: selected || reviewed, dash: offer.sure ? [5, 4] : [1.5, 4] });
    const said = [offer.name, score === null ? "" : shownScore(score), current ? this.shownKey("Space") : ""];
    const text = current ? said.filter(Boolean).join(" · ") : offer.name;
    this.#label(text, this.view.toScreen(mark.anchor), selected || current ? 3 : reviewed ? 2.5 : offer.sure ? 1 : 0, mark.end);
    if (!runner_up || !current) return;
    this.#proposed(offer, runner_up, { dash: [1, 5] });
    this.#label(`runner-up ${shownScore(runner_up.score)} · ${this.shownKey("K")}`, this.view.toScreen(runner_up.anchor), 0, runner_up.end);
  }

  #proposed({ class: id }, { anchor, end, anchor_known, end_known }, { selected = false, dash }) {
    const { color, shape, kind } = this.classOf(id);
    const from = this.view.toScreen(anchor);
    if (kind === "line") {
      const to = this.view.toScreen(end);
      if (selected) this.#halo(from, to);
      drawLine(this.context, from, to, color, 1.5, dash);
      if (!anchor_known) this.#onward(from, to, color);
      if (!end_known) this.#onward(to, from, color);
    } else {
      if (selected) this.#ring(from, GLYPH + 6);
      drawGlyph(this.context, shape, ...from, GLYPH, color, 1.5, dash);
    }
  }

  /** Epipolar lines: thin over the whole image, brighter where the depth is plausible. */
  guides(guides) {
    for (const { line, plausible } of guides) {
      this.#path(line, "rgba(255,255,255,.55)", 1);
      this.#path(plausible, "rgba(255,255,255,.9)", 2);
    }
  }

  /** Where the element under the pen will be, once it has snapped to the edges. */
  snapped({ class: id, end_known: drawn }, { anchor, end, end_known, by_px }) {
    this.#proposed({ class: id }, { anchor, end, anchor_known: true, end_known: end_known || !drawn }, { dash: [3, 2] });
    const hidden = end && drawn && !end_known ? `, bottom hidden (${this.shownKey("O")}: it is not)` : "";
    this.#label(`snapped, ${by_px.toFixed(1)} px${hidden}`, this.view.toScreen(end ?? anchor), 3, null);
  }

  /** The element under the pen. */
  drawing({ class: id, anchor, end, box, anchor_known, end_known }) {
    const { color, shape, kind } = this.classOf(id);
    const from = this.view.toScreen(anchor);
    if (kind === "line") {
      const to = this.view.toScreen(end);
      drawLine(this.context, from, to, color);
      this.#poleEnd("peak", from, to, color, anchor_known, false);
      if (!end_known) this.#poleEnd("bottom", to, from, color, false, false);
    } else {
      if (box) this.#box(box.map((corner) => this.view.toScreen(corner)), color);
      drawGlyph(this.context, shape, ...from, GLYPH, color);
      this.#dot(from, color);
    }
  }

  /** Names, right or left of what they name. Where both places are taken, the one with less to say
   * goes: a ghost before an element, a far pole before a near one; the selected one stays. */
  labels(width) {
    const taken = this.texts.map(({ at: [x, y] }) => [x - 6, y - 6, 12, 12]); // never on a glyph
    this.texts.sort((a, b) => b.weight - a.weight || b.length - a.length);
    for (const { text, at, weight } of this.texts) {
      const font = weight > 1 ? 600 : 400;
      this.context.font = `${font} ${LABEL_SIZE}px Inter, "Liberation Sans", Arial, sans-serif`;
      const size = this.context.measureText(text).width;
      const y = Math.max(at[1] - 8, 9);
      const boxes = [at[0] + 11, at[0] - 11 - size].map((x) => [x, y - 7, size, 14]);
      const free = boxes.find((box) =>
        box[0] > 0 && box[0] + size < width && !taken.some((one) => overlap(one, box)));
      const box = free ?? (weight === 3 ? boxes[0] : null);
      if (!box) continue;
      taken.push(box);
      drawText(this.context, text, box[0], y, { weight: font, size: LABEL_SIZE });
    }
  }

  /** `end`: the other end of what is named, in pixels; null for signs. */
  #label(text, at, weight, end) {
    this.texts.push({ text, at, weight, length: end ? gap(at, this.view.toScreen(end)) : 0 });
  }

  /** A handle; where the end is not seen, hollow and with an arrow that points on along the pole. */
  #poleEnd(kind, at, from, color, known, active) {
    const { context } = this;
    if (!known) this.#onward(at, from, color);
    drawHandle(context, kind, ...at, color, known);
    if (!active) return;
    context.strokeStyle = ACCENT;
    context.lineWidth = 2.2;
    context.strokeRect(at[0] - 6, at[1] - 6, 12, 12);
  }

  /** An arrow that points on along the pole. */
  #onward(at, from, color) {
    const length = Math.hypot(at[0] - from[0], at[1] - from[1]) || 1;
    const ahead = (distance) => at.map((one, axis) => one + ((one - from[axis]) / length) * distance);
    drawArrow(this.context, ahead(6), ahead(14), color, 1.6);
  }

  #halo(from, to) {
    this.#path([from, to], ACCENT, 6.5, true);
  }

  #ring([x, y], radius) {
    this.context.beginPath();
    this.context.arc(x, y, radius, 0, 2 * Math.PI);
    this.context.strokeStyle = ACCENT;
    this.context.lineWidth = 2.2;
    this.context.stroke();
  }

  #path(points, color, width, onScreen = false) {
    const { context } = this;
    context.beginPath();
    for (const point of points) context.lineTo(...(onScreen ? point : this.view.toScreen(point)));
    context.strokeStyle = color;
    context.lineWidth = width;
    context.stroke();
  }

  #dot([x, y], color) {
    this.context.fillStyle = CASING;
    this.context.fillRect(x - 1.5, y - 1.5, 3, 3);
    this.context.fillStyle = color;
    this.context.fillRect(x - 0.75, y - 0.75, 1.5, 1.5);
  }

  #box([[x0, y0], [x1, y1]], color) {
    this.context.strokeStyle = color;
    this.context.lineWidth = 1;
    this.context.strokeRect(x0, y0, x1 - x0, y1 - y0);
  }
}

/** Draws `bitmap` as `view` says; single pixels show as squares from 3 CSS pixels on. */
export function picture(context, bitmap, view) {
  context.imageSmoothingEnabled = view.scale < 3;
  context.imageSmoothingQuality = "medium";
  context.drawImage(bitmap, view.x, view.y, bitmap.width * view.scale, bitmap.height * view.scale);
}

/** The magnifier around pixel (u, v): nearest neighbour, never smoothed, with the coordinates. */
export function loupe(context, bitmap, [u, v], { corner: [x, y], size, zoom, drawing, color, filter }) {
  const caption = 20;
  const place = ([pu, pv]) => [x + size / 2 + (pu - u) * zoom, y + size / 2 + (pv - v) * zoom];
  const first = [u, v].map((one) => Math.floor(one - size / zoom / 2));
  const count = Math.ceil(size / zoom) + 2;
  const [left, top] = place(first).map((one) => one - zoom / 2);
  context.save();
  context.beginPath();
  context.roundRect(x, y, size, size + caption, 4);
  context.clip();
  context.fillStyle = "#0A0B0D";
  context.fillRect(x, y, size, size + caption);
  context.filter = filter;
  context.imageSmoothingEnabled = false;
  context.drawImage(bitmap, ...first, count, count, left, top, count * zoom, count * zoom);
  context.filter = "none";
  if (drawing?.end) drawLine(context, place(drawing.anchor), place([u, v]), color, 1.5);
  crosshair(context, x + size / 2, y + size / 2, size / 2);
  context.fillStyle = "#0A0B0D";
  context.fillRect(x, y + size, size, caption);
  const text = `${zoom}× ${u.toFixed(1)}, ${v.toFixed(1)}`;
  drawText(context, text, x + size / 2, y + size + caption / 2, { weight: 400, align: "center" });
  context.textAlign = "left";
  context.restore();
  context.strokeStyle = "#A3A8AF";
  context.lineWidth = 1;
  context.strokeRect(x + 0.5, y + 0.5, size - 1, size + caption - 1);
}

/** Where the keys would set a point. */
export function cursor(context, [x, y]) {
  for (const [color, width] of [[CASING, 3.2], [ACCENT, 1.6]]) {
    context.strokeStyle = color;
    context.lineWidth = width;
    context.beginPath();
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      context.moveTo(x + dx * 5, y + dy * 5);
      context.lineTo(x + dx * 22, y + dy * 22);
    }
    context.stroke();
  }
}

function crosshair(context, x, y, reach) {
  context.strokeStyle = "rgba(255,255,255,.75)";
  context.lineWidth = 1;
  context.beginPath();
  for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
    context.moveTo(x + dx * 5, y + dy * 5);
    context.lineTo(x + dx * reach, y + dy * reach);
  }
  context.stroke();
}

/** Which part of an observation lies under `point` (CSS pixels): handles before lines. */
export function hitTest(view, { anchor, end }, point) {
  const ends = [["anchor", anchor], ["end", end]].filter(([, pixel]) => pixel);
  for (const [part, pixel] of ends) {
    const distance = gap(point, view.toScreen(pixel));
    if (distance <= (end ? HANDLE_HIT : GLYPH + 3)) return { part, distance, rank: 0 };
  }
  if (!end) return null;
  const distance = gapToSegment(point, view.toScreen(anchor), view.toScreen(end));
  return distance <= 5 ? { part: "line", distance, rank: 1 } : null;
}

/** What of a pole is not seen, in words. */
function missing(kind, { anchor_known, end_known }) {
  return [anchor_known ? "" : "peak cut", kind === "line" && !end_known ? "bottom hidden" : ""].filter(Boolean);
}

const overlap = ([x, y, w, h], [a, b, c, d]) => x < a + c && a < x + w && y < b + d && b < y + h;

const gap = ([x, y], [a, b]) => Math.hypot(x - a, y - b);

function gapToSegment([x, y], [ax, ay], [bx, by]) {
  const length = (bx - ax) ** 2 + (by - ay) ** 2 || 1;
  const along = Math.min(1, Math.max(0, ((x - ax) * (bx - ax) + (y - ay) * (by - ay)) / length));
  return gap([x, y], [ax + along * (bx - ax), ay + along * (by - ay)]);
}
