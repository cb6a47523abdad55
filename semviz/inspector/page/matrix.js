/* Probabilities of all pairs: classes in blocks, dustbins, sums and entropies, marks on what matters. */

import { Surface, pointerAt } from "/static/canvas.js";
import { byId } from "/static/dom.js";
import { currentTheme } from "/static/theme.js";
import { flag, yes } from "./address.js";
import { Ramp, bitmapOf } from "./matrix_cells.js";
import { drawMatrix } from "./matrix_drawing.js";
import { MatrixLayout } from "./matrix_layout.js";
import { MatrixModel } from "./matrix_model.js";

export class MatrixPanel {
  constructor(page) {
    this.page = page;
    this.isLog = false;
    this.model = null; // of a frame with probabilities
    this.hovered = null; // what MatrixLayout.find gave
    this.selected = { observed: null, mapped: null };
    this.scroller = byId("matrix-scroller"); // lies over the canvas, which is never larger than the panel
    this.surface = new Surface(byId("matrix-canvas"), (context) => this.draw(context));
    this.surface.onresize = () => this.layOut();
    this.listen();
  }

  listen() {
    const placeOf = (event) => this.layout?.find(pointerAt(event)) ?? null;
    this.scroller.addEventListener("pointermove", (event) => this.hover(placeOf(event)));
    this.scroller.addEventListener("pointerleave", () => this.hover(null));
    this.scroller.addEventListener("click", (event) => this.pick(placeOf(event)));
    this.scroller.addEventListener("scroll", () => this.scrolled());
    byId("matrix-log").addEventListener("click", () => this.toggleLog());
  }

  commands() {
    return [{ key: "m", group: "Image and matrix", title: "Matrix linear, log", run: () => this.toggleLog() }];
  }

  address() {
    const turn = ({ log }) => { if ((log === "yes") !== this.isLog) this.toggleLog(); };
    return [{ fields: { log: flag() }, get: () => ({ log: yes(this.isLog) }), set: turn }];
  }

  showRun(run) {
    this.run = run;
    [this.model, this.layout] = [null, null]; // of another run, with other classes
    this.showTheme();
  }

  showFrame(frame) {
    this.frame = frame;
    this.hovered = null;
    this.model = frame.matrix ? new MatrixModel(frame) : null;
    this.bitmap = this.model && bitmapOf(this.model, this.look.ramp);
    const about = this.model ? `${this.model.m} seen × ${this.model.n} mapped` : "";
    byId("matrix-about").textContent = about;
    byId("matrix-about").title = about;
    byId("matrix-none").hidden = this.model !== null;
    byId("matrix-csv").hidden = !this.model;
    byId("matrix-csv").href = `matrix.csv?${new URLSearchParams({ run: this.run.name, position: frame.position })}`;
    this.layOut();
  }

  showState({ observed, element }) {
    const column = this.frame.mapped.findIndex((one) => one.id === element);
    const before = this.selected;
    this.selected = { observed, mapped: column < 0 ? null : column };
    if (before.observed !== observed || before.mapped !== this.selected.mapped) this.reveal();
    this.surface.redraw();
    this.showValue();
  }

  showTheme() {
    this.look = this.lookNow();
    this.bitmap = this.model && bitmapOf(this.model, this.look.ramp);
    this.surface.redraw();
  }

  /** Colours of the present theme. */
  lookNow() {
    const light = currentTheme() === "light";
    const classes = new Map(this.run.classes.map((one) => [one.id, { ...one, color: light ? one.colorLight : one.color }]));
    return { ramp: new Ramp(this.isLog), classes };
  }

  toggleLog() {
    this.isLog = !this.isLog;
    this.page.address.changed();
    byId("matrix-log").setAttribute("aria-pressed", this.isLog);
    byId("matrix-least").textContent = this.isLog ? "0.001" : "0";
    this.showTheme();
  }

  /* Layout and scrolling */

  /** Anew for another frame or size; the scroller has the size that all cells need. */
  layOut() {
    const sheet = this.scroller.firstElementChild;
    if (!this.model) {
      [this.layout, sheet.style.width, sheet.style.height] = [null, "0", "0"];
    } else {
      // twice: a scroll bar that appears takes room from the other direction
      for (let pass = 0; pass < 2; pass += 1) {
        this.layout = new MatrixLayout(this.model, this.scroller.clientWidth, this.scroller.clientHeight);
        sheet.style.width = `${this.layout.needs.width}px`;
        sheet.style.height = `${this.layout.needs.height}px`;
      }
      this.layout.scrollTo(this.scroller.scrollLeft, this.scroller.scrollTop);
    }
    this.surface.redraw();
  }

  scrolled() {
    this.layout?.scrollTo(this.scroller.scrollLeft, this.scroller.scrollTop);
    this.surface.redraw();
  }

  /** Scrolls to the selected row and column where they are out of sight. */
  reveal() {
    if (!this.layout) return;
    const { rows, columns } = this.layout;
    const { observed, mapped } = this.selected;
    this.scroller.scrollTo(intoView(columns, mapped, this.scroller.scrollLeft), intoView(rows, observed, this.scroller.scrollTop));
  }

  /* Selection */

  hover(place) {
    if (JSON.stringify(place) === JSON.stringify(this.hovered)) return;
    this.hovered = place;
    this.surface.redraw();
    this.showValue();
  }

  pick(place) {
    const column = place?.mapped ?? null;
    const element = column === null ? null : this.frame.mapped[column].id;
    this.page.select({ observed: place?.observed ?? null, element });
  }

  showValue() {
    const { observed, mapped } = this.selected;
    let place = this.hovered;
    if (!place && observed !== null) place = { of: mapped === null ? "row" : "cell", observed, mapped };
    else if (!place && mapped !== null) place = { of: "column", mapped };
    const said = this.model && place ? this.model.say(place) : "";
    byId("matrix-value").textContent = said;
    byId("matrix-value").title = said;
  }

  draw(context) {
    const { bitmap, selected, hovered } = this;
    if (this.layout) drawMatrix(context, this.model, this.layout, { ...this.look, bitmap, selected, hovered });
  }

  /** All of the matrix, also where the panel has to scroll. */
  figures() {
    if (!this.layout) return [];
    const { width, height } = this.layout.needs;
    const layout = new MatrixLayout(this.model, width, height);
    const draw = (context) => drawMatrix(context, this.model, layout, { ...this.lookNow(), bitmap: null, selected: this.selected, hovered: null });
    return [{ name: "matrix", title: "Match probability", width, height, draw }];
  }
}

/** The scroll that shows an index of an axis, nearest to the present one. */
function intoView(axis, index, scroll) {
  if (!axis.at.has(index)) return scroll;
  const start = axis.at.get(index);
  return Math.min(start, Math.max(scroll, start + axis.size - axis.shown));
}
