// @ts-check
/* The matrix panel: probabilities of all pairs in blocks of classes, dustbins, sums, entropies. */

import { Surface, pointerAt } from "/static/canvas.js";
import { byId } from "/static/dom.js";
import { currentTheme } from "/static/theme.js";
import { flag, yes } from "../address.js";
import { Ramp, bitmapOf } from "./matrix_cells.js";
import { drawMatrix } from "./matrix_drawing.js";
import { MatrixLayout } from "./matrix_layout.js";
import { MatrixModel } from "./matrix_model.js";

/** @typedef {import("../panel.js").Figure} Figure */
/** @typedef {import("/static/protocol").inspector.FrameView} FrameView */
/** @typedef {import("/static/protocol").inspector.StateView} StateView */
/** @typedef {import("/static/keys.js").Command} Command */
/** @typedef {import("../panel.js").AddressPart} AddressPart */
/** @typedef {import("./matrix_layout.js").Axis} Axis */
/** @typedef {import("../panel.js").Context} Context */
/** @typedef {import("./matrix_layout.js").MatrixPlace} MatrixPlace */
/** @typedef {import("./matrix_drawing.js").MatrixSelection} MatrixSelection */
/** @typedef {import("../main.js").Page} Page */

export class MatrixPanel {
  /** @param {Page} page */
  constructor(page) {
    this.page = page;
    this.isLog = false;
    /** @type {MatrixModel | null} */
    this.model = null; // null if the frame has no probabilities
    /** @type {MatrixLayout | null} */
    this.layout = null;
    /** @type {MatrixPlace | null} */
    this.hovered = null;
    /** @type {MatrixSelection} */
    this.selected = { observed: null, mapped: null };
    /** @type {HTMLCanvasElement | null} */
    this.bitmap = null;
    this.scroller = byId("matrix-scroller"); // covers the canvas, which is never larger than the panel
    this.surface = new Surface(byId("matrix-canvas", HTMLCanvasElement), (context) => this.draw(context));
    this.surface.onresize = () => this.layOut();
    this.listen();
  }

  listen() {
    /** @param {MouseEvent} event */
    const placeOf = (event) => this.layout?.find(pointerAt(event)) ?? null;
    this.scroller.addEventListener("pointermove", (event) => this.hover(placeOf(event)));
    this.scroller.addEventListener("pointerleave", () => this.hover(null));
    this.scroller.addEventListener("click", (event) => this.pick(placeOf(event)));
    this.scroller.addEventListener("scroll", () => this.scrolled());
    byId("matrix-log").addEventListener("click", () => this.toggleLog());
  }

  /** @returns {Command[]} */
  commands() {
    return [{ key: "m", group: "Image and matrix", title: "Matrix: linear or log colours", run: () => this.toggleLog() }];
  }

  /** @returns {AddressPart[]} */
  address() {
    /** @param {{[name: string]: string | null}} values */
    const setLog = ({ log }) => { if ((log === "yes") !== this.isLog) this.toggleLog(); };
    return [{ fields: { log: flag() }, get: () => ({ log: yes(this.isLog) }), set: setLog }];
  }

  showRun() {
    [this.model, this.layout] = [null, null]; // another run may have other classes
    this.showTheme();
  }

  /** @param {FrameView} frame */
  showFrame(frame) {
    this.hovered = null;
    this.model = frame.matrix ? new MatrixModel(frame, frame.matrix) : null;
    this.bitmap = this.model && this.style ? bitmapOf(this.model, this.style.ramp) : null;
    byId("matrix-about").textContent = this.model ? `${this.model.m} × ${this.model.n}` : "";
    byId("matrix-about").title = this.model ? `${this.model.m} detected × ${this.model.n} mapped` : "";
    byId("matrix-none").hidden = this.model !== null;
    byId("matrix-csv").hidden = !this.model;
    const query = new URLSearchParams({ run: this.page.store.run.name, position: String(frame.position) });
    byId("matrix-csv", HTMLAnchorElement).href = `matrix.csv?${query}`;
    this.layOut();
  }

  /** @param {StateView} state */
  showState({ observed, element }) {
    const column = this.page.store.frame.mapped.findIndex((mapped) => mapped.id === element);
    const before = this.selected;
    this.selected = { observed, mapped: column < 0 ? null : column };
    if (before.observed !== observed || before.mapped !== this.selected.mapped) this.reveal();
    this.surface.redraw();
    this.showValue();
  }

  showTheme() {
    this.style = this.currentStyle();
    this.bitmap = this.model && bitmapOf(this.model, this.style.ramp);
    this.surface.redraw();
  }

  /** Colours of the present theme. */
  currentStyle() {
    const light = currentTheme() === "light";
    const { classes: kinds } = this.page.store.run;
    const classes = new Map(kinds.map((kind) => [kind.id, { ...kind, color: light ? kind.color_light : kind.color }]));
    return { ramp: new Ramp(this.isLog), classes };
  }

  toggleLog() {
    this.isLog = !this.isLog;
    this.page.address.changed();
    byId("matrix-log").setAttribute("aria-pressed", String(this.isLog));
    byId("matrix-least").textContent = this.isLog ? "0.001" : "0";
    this.showTheme();
  }

  /* Layout and scrolling */

  /** Called for another frame or size. The scroller gets the size that all cells need. */
  layOut() {
    const sheet = byId("matrix-sheet");
    this.layout = null;
    if (!this.model) {
      [sheet.style.width, sheet.style.height] = ["0", "0"];
    } else {
      // twice: a scroll bar takes room from the other direction
      for (let pass = 0; pass < 2; pass += 1) {
        this.layout = new MatrixLayout(this.model, this.scroller.clientWidth, this.scroller.clientHeight);
        sheet.style.width = `${this.layout.needs.width}px`;
        sheet.style.height = `${this.layout.needs.height}px`;
      }
    }
    this.layout?.scrollTo(this.scroller.scrollLeft, this.scroller.scrollTop);
    this.surface.redraw();
  }

  scrolled() {
    this.layout?.scrollTo(this.scroller.scrollLeft, this.scroller.scrollTop);
    this.surface.redraw();
  }

  /** Scrolls to the selected row and column if they are not visible. */
  reveal() {
    if (!this.layout) return;
    const { rows, columns } = this.layout;
    const { observed, mapped } = this.selected;
    this.scroller.scrollTo(intoView(columns, mapped, this.scroller.scrollLeft), intoView(rows, observed, this.scroller.scrollTop));
  }

  /* Selection */

  /** @param {MatrixPlace | null} place */
  hover(place) {
    if (JSON.stringify(place) === JSON.stringify(this.hovered)) return;
    this.hovered = place;
    this.surface.redraw();
    this.showValue();
  }

  /** @param {MatrixPlace | null} place */
  pick(place) {
    const column = place && place.of !== "row" ? place.mapped : null;
    const observed = place && place.of !== "column" ? place.observed : null;
    this.page.select({ observed, element: column === null ? null : this.page.store.frame.mapped[column].id });
  }

  showValue() {
    const { observed, mapped } = this.selected;
    let place = this.hovered;
    if (!place && observed !== null) place = mapped === null ? { of: "row", observed } : { of: "cell", observed, mapped };
    else if (!place && mapped !== null) place = { of: "column", mapped };
    const text = this.model && place ? this.model.describe(place) : "";
    byId("matrix-value").textContent = text;
    byId("matrix-value").title = text;
  }

  /** @param {Context} context */
  draw(context) {
    const { model, layout, style, bitmap, selected, hovered } = this;
    if (model && layout && style) drawMatrix(context, model, layout, { ...style, bitmap, selected, hovered });
  }

  /** The whole matrix, without scrolling.
   *
   * @returns {Figure[]}
   */
  figures() {
    const { model } = this;
    if (!this.layout || !model) return [];
    const { width, height } = this.layout.needs;
    const layout = new MatrixLayout(model, width, height);
    /** @param {Context} context */
    const draw = (context) => drawMatrix(context, model, layout, { ...this.currentStyle(), bitmap: null, selected: this.selected, hovered: null });
    return [{ name: "matrix", title: "Match probability", width, height, draw }];
  }
}

/** The scroll that shows an index of an axis, nearest to the present one.
 *
 * @param {Axis} axis
 * @param {number | null} index
 * @param {number} scroll
 */
function intoView(axis, index, scroll) {
  if (index === null || !axis.at.has(index)) return scroll;
  const start = axis.start(index);
  return Math.min(start, Math.max(scroll, start + axis.size - axis.shown));
}
