// @ts-check
/* The map from above: changes with their marks and names, standing elements faint. */

import { Surface, View, cssColor, enablePicking, enableZoomAndPan } from "/static/canvas.js";
import { byId } from "/static/dom.js";
import { traceGlyph } from "/static/glyphs.js";
import { drawChangeMark } from "./change_marks.js";

/** @typedef {import("/static/protocol").inspector.OverTimeChange} OverTimeChange */
/** @typedef {import("/static/protocol").inspector.OverTimeView} OverTimeView */
/** @typedef {import("/static/canvas.js").Point} Point */
/** @typedef {import("../panel.js").Context} Context */
/** @typedef {import("./over_time.js").OverTime} OverTime */

const MARGIN_PX = 34;
const NEAR_PX = 14; // a click hits a change up to this distance
const ROAD_M = 7;
const SELECTED_M = 12; // around the selected change, when it is zoomed to
const AROUND_M = 20; // around all changes

export class ChangeMap {
  view = new View();
  isFitted = false;
  showsAll = false;
  /** @type {OverTimeView | null} */
  found = null;

  /** @param {OverTime} page */
  constructor(page) {
    this.page = page;
    const canvas = byId("change-map", HTMLCanvasElement);
    this.surface = new Surface(canvas, (...size) => this.draw(...size));
    this.surface.onresize = () => { this.isFitted = false; };
    enableZoomAndPan(canvas, this.view, () => this.surface.redraw());
    const text = (/** @type {OverTimeChange} */ { name, story }) => `${name}: ${story}`;
    enablePicking(canvas, (at) => this.changeAt(at), text, ({ name }) => page.select(name));
  }

  /** @param {OverTimeView} found */
  show(found) {
    if (found.map !== this.found?.map) this.isFitted = false;
    this.found = found;
    this.surface.redraw();
  }

  /** Shows the whole map, or the surroundings of the selected change.
   *
   * @param {boolean} whole
   */
  zoom(whole) {
    const change = whole ? null : this.page.change;
    if (change) this.fitTo([change.place, change.place], SELECTED_M);
    else {
      this.showsAll = whole;
      this.isFitted = false;
    }
    this.surface.redraw();
  }

  /** @param {Point} at */
  changeAt(at) {
    /** @type {{change: OverTimeChange | null, distance: number}} */
    let best = { change: null, distance: NEAR_PX };
    for (const change of this.found?.changes ?? []) {
      const [x, y] = this.screen(change.place);
      const distance = Math.hypot(at[0] - x, at[1] - y);
      if (distance < best.distance) best = { change, distance };
    }
    return best.change;
  }

  /** North is up.
   *
   * @param {Point} place
   */
  screen([x, y]) {
    return this.view.toScreen([x, -y]);
  }

  /** Shows the changes, or all elements if there are none, or if they are asked for.
   *
   * @param {OverTimeView} found
   */
  fit({ route, standing, changes }) {
    const places = changes.map(({ place }) => place);
    const all = this.showsAll || !places.length;
    if (all) this.fitTo([...places, ...route, ...standing.map(({ place }) => place)], 2);
    else this.fitTo(places, AROUND_M);
  }

  /**
   * @param {Point[]} points
   * @param {number} around m
   */
  fitTo(points, around) {
    const { width, height } = this.surface;
    this.view.fitPoints(points.map(([x, y]) => [x, -y]), around, MARGIN_PX, width, height);
    this.isFitted = true;
  }

  /**
   * @param {Context} context
   * @param {number} width
   * @param {number} height
   */
  draw(context, width, height) {
    const { found } = this;
    if (!found) return;
    if (!this.isFitted) this.fit(found);
    this.drawRoute(context, found.route);
    context.globalAlpha = 0.42;
    for (const { class_id: id, place } of found.standing) this.drawElement(context, id, place, 4, []);
    context.globalAlpha = 1;
    const selected = this.page.change;
    for (const change of found.changes) this.drawChange(context, change);
    if (selected) this.drawRing(context, selected);
    this.drawNames(context, found.changes, width, height);
    drawScale(context, this.view.scale, width, height);
  }

  /**
   * @param {Context} context
   * @param {Point[]} route
   */
  drawRoute(context, route) {
    if (route.length < 2) return;
    for (const [name, size] of /** @type {[string, number][]} */ ([["--road", Math.max(ROAD_M * this.view.scale, 6)], ["--dim", 1]])) {
      context.strokeStyle = cssColor(name);
      context.lineWidth = size;
      context.lineJoin = context.lineCap = "round";
      context.beginPath();
      route.forEach((place, at) => (at ? context.lineTo(...this.screen(place)) : context.moveTo(...this.screen(place))));
      context.stroke();
    }
  }

  /**
   * @param {Context} context
   * @param {number} id of its class
   * @param {Point} place
   * @param {number} radius
   * @param {number[]} dash
   */
  drawElement(context, id, place, radius, dash) {
    const look = this.page.look(id);
    if (!look) return;
    traceGlyph(context, look.shape, ...this.screen(place), radius);
    context.strokeStyle = look.color;
    context.lineWidth = 1.6;
    context.setLineDash(dash);
    context.stroke();
    context.setLineDash([]);
  }

  /**
   * @param {Context} context
   * @param {OverTimeChange} change
   */
  drawChange(context, { kind, class_id: id, place, was }) {
    const [x, y] = this.screen(place);
    this.drawElement(context, id, place, 5.5, kind === "vanished" ? [2, 2] : []);
    if (was) {
      this.drawElement(context, id, was, 5.5, [2, 2]);
      context.strokeStyle = cssColor("--ambiguous");
      context.lineWidth = 1.5;
      context.beginPath();
      context.moveTo(...this.screen(was));
      context.lineTo(x, y);
      context.stroke();
    }
    drawChangeMark(context, kind, x + 10, y - 9);
  }

  /**
   * @param {Context} context
   * @param {OverTimeChange} change
   */
  drawRing(context, { place }) {
    context.strokeStyle = cssColor("--accent");
    context.lineWidth = 2.2;
    context.beginPath();
    context.arc(...this.screen(place), 13, 0, 2 * Math.PI);
    context.stroke();
  }

  /** Names beside the marks; where two would overlap, the later one goes. The selected one stays.
   *
   * @param {Context} context
   * @param {OverTimeChange[]} changes
   * @param {number} width
   * @param {number} height
   */
  drawNames(context, changes, width, height) {
    context.font = `600 11px Inter, "Liberation Sans", Arial, sans-serif`;
    context.textBaseline = "middle";
    const taken = [{ left: 0, right: 300, top: height - 34, bottom: height }]; // the legend
    const { selected } = this.page;
    for (const { name, place } of [...changes].sort((a, b) => Number(b.name === selected) - Number(a.name === selected))) {
      const [x, y] = this.screen(place);
      const size = context.measureText(name).width;
      const fits = x + 20 + size < width - 4;
      const left = fits ? x + 19 : x - 12 - size;
      const box = { left: left - 2, right: left + size + 2, top: y - 17, bottom: y - 2 };
      if (name !== selected && taken.some((other) => box.left < other.right && other.left < box.right && box.top < other.bottom && other.top < box.bottom)) continue;
      taken.push(box);
      context.textAlign = "left";
      context.lineWidth = 3;
      context.strokeStyle = cssColor("--scene");
      context.strokeText(name, left, y - 9);
      context.fillStyle = cssColor("--text");
      context.fillText(name, left, y - 9);
    }
  }
}

/**
 * @param {Context} context
 * @param {number} scale CSS pixels a metre
 * @param {number} width
 * @param {number} height
 */
function drawScale(context, scale, width, height) {
  const metres = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000].find((length) => length * scale > 60) ?? 10000;
  const [right, bottom] = [width - 14, height - 12];
  context.strokeStyle = context.fillStyle = cssColor("--dim");
  context.lineWidth = 1.5;
  context.beginPath();
  context.moveTo(right - metres * scale, bottom);
  context.lineTo(right, bottom);
  context.stroke();
  context.font = `400 11px Inter, "Liberation Sans", Arial, sans-serif`;
  context.textAlign = "right";
  context.fillText(metres < 1000 ? `${metres} m` : `${metres / 1000} km`, right, bottom - 9);
}
