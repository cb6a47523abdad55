// @ts-check
/* The route of a run from above, coloured by the share of frames that are wrong, and its causes. */

import { Surface, View, cssColor, enablePicking, enableZoomAndPan } from "/static/canvas.js";
import { byId } from "/static/dom.js";

/** @typedef {import("/static/protocol").inspector.StoryCause} StoryCause */
/** @typedef {import("/static/protocol").inspector.StoryPart} StoryPart */
/** @typedef {import("/static/canvas.js").Point} Point */
/** @typedef {import("../panel.js").Context} Context */

const ROAD_PX = 12;
const PART_PX = 7;
const MARGIN_PX = 70; // for names beside the route
const NEAR_PX = 12; // a click hits a part up to this distance
const NAMED = 5; // causes with a name in the map
const NAME_PX = { width: 150, height: 32 };

export class StoryMap {
  /** @type {StoryPart[]} */
  route = [];
  /** @type {StoryCause[]} */
  causes = [];
  /** @type {StoryCause | null} */
  selected = null;
  view = new View();
  isFitted = false;

  /** `open` is called with the position of a frame.
   *
   * @param {(position: number) => void} open
   */
  constructor(open) {
    const canvas = byId("story-map", HTMLCanvasElement);
    this.surface = new Surface(canvas, (...size) => this.draw(...size));
    this.surface.onresize = () => { this.isFitted = false; };
    enableZoomAndPan(canvas, this.view, () => this.surface.redraw());
    const text = (/** @type {StoryPart} */ { wrong, frames }) => `${wrong} of ${frames} frames are wrong here`;
    enablePicking(canvas, (at) => this.partAt(at), text, ({ position }) => open(position));
  }

  /**
   * @param {StoryPart[]} route
   * @param {StoryCause[]} causes
   */
  use(route, causes) {
    if (route.length !== this.route.length) this.isFitted = false;
    this.route = route;
    this.causes = causes;
    this.surface.redraw();
  }

  /** @param {StoryCause | null} cause */
  select(cause) {
    this.selected = cause;
    this.surface.redraw();
  }

  /** The part under a point of the canvas.
   *
   * @param {Point} at
   */
  partAt(at) {
    /** @type {{part: StoryPart | null, distance: number}} */
    let best = { part: null, distance: NEAR_PX };
    for (const part of this.route) {
      for (const [x, y] of this.line(part)) {
        const distance = Math.hypot(at[0] - x, at[1] - y);
        if (distance < best.distance) best = { part, distance };
      }
    }
    return best.part;
  }

  /** A part's points on the canvas. North is up.
   *
   * @param {StoryPart} part
   * @returns {Point[]}
   */
  line({ points }) {
    return points.map(([x, y]) => this.view.toScreen([x, -y]));
  }

  /** Shows the whole route.
   *
   * @param {number} width
   * @param {number} height
   */
  fit(width, height) {
    const points = this.route.flatMap(({ points }) => points.map(([x, y]) => /** @type {Point} */ ([x, -y])));
    this.view.fitPoints(points, 0, MARGIN_PX, width, height);
    this.isFitted = true;
  }

  /**
   * @param {Context} context
   * @param {number} width
   * @param {number} height
   */
  draw(context, width, height) {
    if (!this.route.length) return;
    if (!this.isFitted) this.fit(width, height);
    for (const part of this.route) drawPart(context, this.line(part), ROAD_PX, cssColor("--hairline"));
    const worst = [...this.route].filter(({ wrong }) => wrong).sort((a, b) => a.wrong / a.frames - b.wrong / b.frames);
    for (const part of worst) drawPart(context, this.line(part), PART_PX, shareColor(part.wrong / part.frames));
    for (const row of this.selected?.parts ?? []) drawPart(context, this.line(this.route[row]), 2, cssColor("--accent"));
    this.drawNames(context, width, height);
    drawScale(context, this.view.scale, width, height);
  }

  /** Names of the causes above or below the parts where they are most frequent.
   *
   * @param {Context} context
   * @param {number} width
   * @param {number} height
   */
  drawNames(context, width, height) {
    /** @type {Box[]} */
    const taken = [{ left: 0, top: height - 44, width: 330, height: 44 }]; // the legend
    const road = this.route.flatMap((part) => this.line(part));
    for (const cause of this.causes.slice(0, NAMED)) {
      if (!cause.parts.length) continue;
      const line = this.line(this.route[cause.parts[0]]);
      const from = line[Math.floor(line.length / 2)];
      const free = places(from, width, height).find((box) => taken.every((other) => areApart(box, other)) && !road.some((point) => isInside(point, box)));
      if (!free) continue;
      taken.push(free);
      drawName(context, cause, from, free);
    }
  }
}

/** @typedef {{left: number, top: number, width: number, height: number}} Box */

/** Where a name may stand within the canvas, nearest first: above and below a point, or aside.
 *
 * @param {Point} point
 * @param {number} width
 * @param {number} height
 * @returns {Box[]}
 */
function places([x, y], width, height) {
  const size = NAME_PX;
  const boxes = [44, 84, 124, 164].flatMap((away) => [0, -110, 110, -200, 200].flatMap((aside) => [
    { left: x + aside - size.width / 2, top: y - away - size.height / 2, ...size },
    { left: x + aside - size.width / 2, top: y + away - size.height / 2, ...size }]));
  return boxes.filter(({ left, top }) => left > 4 && top > 4 && left + size.width < width - 4 && top + size.height < height - 4);
}

/**
 * @param {Box} a
 * @param {Box} b
 */
function areApart(a, b) {
  return a.left > b.left + b.width || b.left > a.left + a.width || a.top > b.top + b.height || b.top > a.top + a.height;
}

/**
 * @param {Point} point
 * @param {Box} box
 */
function isInside([x, y], { left, top, width, height }) {
  return x > left - ROAD_PX && x < left + width + ROAD_PX && y > top - ROAD_PX && y < top + height + ROAD_PX;
}

/**
 * @param {Context} context
 * @param {StoryCause} cause
 * @param {Point} from
 * @param {Box} box
 */
function drawName(context, { kind, frames }, [x, y], { left, top, width, height }) {
  const [middle, isAbove] = [left + width / 2, top < y];
  context.strokeStyle = cssColor("--dim");
  context.lineWidth = 1;
  context.beginPath();
  context.moveTo(x, y + (isAbove ? -9 : 9));
  context.lineTo(middle, isAbove ? top + height : top);
  context.stroke();
  write(context, kind[0].toUpperCase() + kind.slice(1), middle, top + 10, "center", "600 12px", "--text");
  write(context, frames.length === 1 ? "1 frame" : `${frames.length.toLocaleString("en")} frames`, middle, top + 24, "center", "400 11px", "--dim");
}

/**
 * @param {Context} context
 * @param {Point[]} line
 * @param {number} width
 * @param {string} color
 */
function drawPart(context, line, width, color) {
  context.strokeStyle = color;
  context.lineWidth = width;
  context.lineCap = context.lineJoin = "round";
  context.beginPath();
  const [first, ...others] = line.length > 1 ? line : [line[0], line[0]];
  context.moveTo(...first);
  for (const point of others) context.lineTo(...point);
  context.stroke();
}

/** @param {Context} context
 * @param {number} scale CSS pixels a metre
 * @param {number} width
 * @param {number} height
 */
function drawScale(context, scale, width, height) {
  const metres = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000].find((length) => length * scale > 60) ?? 20000;
  const [right, bottom] = [width - 14, height - 12];
  context.strokeStyle = cssColor("--dim");
  context.lineWidth = 1.5;
  context.beginPath();
  context.moveTo(right - metres * scale, bottom);
  context.lineTo(right, bottom);
  context.stroke();
  write(context, metres < 1000 ? `${metres} m` : `${metres / 1000} km`, right, bottom - 8, "right", "400 11px", "--dim");
}

/**
 * @param {Context} context
 * @param {string} text
 * @param {number} x
 * @param {number} y
 * @param {CanvasTextAlign} align
 * @param {string} font its weight and size
 * @param {string} color
 */
function write(context, text, x, y, align, font, color) {
  context.font = `${font} Inter, "Liberation Sans", Arial, sans-serif`;
  context.textAlign = align;
  context.textBaseline = "middle";
  context.fillStyle = cssColor(color);
  context.fillText(text, x, y);
}

/** The colour of a share of wrong frames: the page's ramp, from the second colour on.
 *
 * @param {number} share
 */
function shareColor(share) {
  return cssColor(share < 0.34 ? "--ramp-1" : share < 0.67 ? "--ramp-2" : "--ramp-3");
}
