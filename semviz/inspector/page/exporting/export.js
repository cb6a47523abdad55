// @ts-check
/* The dialog that saves a view as an image: view, format, preview. */

import { byId, el } from "/static/dom.js";
import { currentTheme } from "/static/theme.js";
import { canvasOf, download, figuresOf, fileName, fileOf, wholePixels } from "./figures.js";

/** @typedef {import("/static/protocol").inspector.SceneImageEvent} SceneImageEvent */
/** @typedef {import("/static/keys.js").Command} Command */
/** @typedef {import("/static/theme.js").Theme} Theme */
/** @typedef {import("../panel.js").Figure} Figure */
/** @typedef {import("../panel.js").FigureOptions} FigureOptions */
/** @typedef {import("../main.js").Page} Page */
/** @typedef {import("./figures.js").PanelFigure} PanelFigure */

const PREVIEW_PX = [420, 200];
const SCALES = [1, 2, 3, 4];

export class Exporter {
  /** @param {Page} page */
  constructor(page) {
    this.page = page;
    /** @type {Chosen} */
    this.chosen = { view: "", format: "png", scale: 2, theme: null, photo: true, legend: true };
    byId("export").addEventListener("click", () => this.open());
  }

  /** @returns {Command[]} */
  commands() {
    return [{ key: "p", group: "Page", title: "Save a view as PNG or SVG", run: () => this.open() }];
  }

  /** The 3D pane, which viser renders as PNG only.
   *
   * @returns {Figure[]}
   */
  figures() {
    const { width, height } = byId("scene").getBoundingClientRect();
    return byId("scene").matches(".ready") ? [{ name: "3d", title: "3D", width, height, render: (scale) => this.render(width, height, scale) }] : [];
  }

  /**
   * @param {number} width
   * @param {number} height
   * @param {number} scale
   * @returns {Promise<Blob>}
   */
  async render(width, height, scale) {
    const size = { width: wholePixels(scale * width), height: wholePixels(scale * height) };
    /** @type {SceneImageEvent} */
    const { png } = await this.page.socket.request("render_scene", size);
    return new Blob([Uint8Array.from(atob(png), (byte) => byte.charCodeAt(0))], { type: "image/png" });
  }

  open() {
    const figures = figuresOf(this.page.panels);
    if (!figures.length) return;
    this.chosen.theme ??= currentTheme();
    this.chosen.view = (figures.find((figure) => figure.title === this.chosen.view) ?? figures[0]).title;
    const dialog = new ExportDialog(figures, this.chosen, (figure) => this.nameOf(figure));
    document.body.append(dialog.dialog);
    dialog.dialog.showModal();
  }

  /** @param {Figure} figure */
  nameOf(figure) {
    const { run, frame } = this.page.store;
    return fileName(run.name, frame.index, figure, this.chosen.format);
  }
}

/** The user's choices, kept for the next time; `view` is a figure's title.
 *
 * @typedef {Omit<FigureOptions, "theme"> & {view: string, theme: Theme | null}} Chosen
 */

class ExportDialog {
  /**
   * @param {PanelFigure[]} figures
   * @param {Chosen} chosen
   * @param {(figure: Figure) => string} nameOf
   */
  constructor(figures, chosen, nameOf) {
    this.figures = figures;
    this.chosen = chosen;
    this.nameOf = nameOf;
    this.preview = el("div", { class: "preview" });
    this.status = el("p", { class: "dim", role: "status" });
    this.name = el("code");
    this.save = el("button", { class: "primary", type: "submit", text: "Save", autofocus: "" });
    this.form = el("form", { method: "dialog" });
    this.form.addEventListener("change", () => this.change());
    this.form.addEventListener("submit", (event) => { event.preventDefault(); this.store(); });
    this.dialog = el("dialog", { class: "help export", "aria-label": "Save image" }, this.form);
    this.dialog.addEventListener("close", () => this.dialog.remove());
    this.fill();
  }

  get figure() {
    return this.figures.find((figure) => figure.title === this.chosen.view) ?? this.figures[0];
  }

  /** @returns {FigureOptions} */
  get options() {
    return { ...this.chosen, theme: this.chosen.theme ?? currentTheme() };
  }

  /** A radio group or a checkbox of the form.
   *
   * @param {string} name
   */
  input(name) {
    return /** @type {RadioNodeList & HTMLInputElement} */ (this.form.elements.namedItem(name));
  }

  fill() {
    const { chosen } = this;
    this.form.replaceChildren(
      el("header", {}, el("h2", { text: "Save image" }), el("span", { class: "push" }),
        el("button", { class: "plain", type: "button", "aria-label": "Close", onclick: () => this.dialog.close() }, el("kbd", { text: "Esc" }))),
      radios("View", "view", this.figures.map(({ title }) => [title, title]), chosen.view),
      radios("As", "format", [["png", "PNG"], ["svg", "SVG"]], chosen.format),
      radios("Size", "scale", SCALES.map((scale) => [scale, `${scale}×`]), chosen.scale),
      radios("Theme", "theme", [["dark", "Dark"], ["light", "Light"]], this.options.theme),
      el("fieldset", {}, el("legend", { text: "With" }), box("photo", "Photo", chosen.photo), box("legend", "Legend", chosen.legend)),
      this.preview, this.status,
      el("footer", {}, this.name, el("span", { class: "push" }), this.save));
    this.show();
  }

  change() {
    Object.assign(this.chosen, {
      view: this.input("view").value, format: this.input("format").value, scale: Number(this.input("scale").value),
      theme: this.input("theme").value, photo: this.input("photo").checked, legend: this.input("legend").checked,
    });
    this.show();
  }

  /** Disables options that this view does not have. */
  show() {
    const { figure, chosen } = this;
    if (figure.render) chosen.format = "png";
    this.input("format").value = chosen.format;
    enable(this.input("format"), !figure.render);
    enable(this.input("scale"), chosen.format === "png");
    enable(this.input("theme"), !figure.render && !(figure.hasPhoto && chosen.photo));
    enable([this.input("photo")], Boolean(figure.hasPhoto));
    enable([this.input("legend")], Boolean(figure.hasLegend));
    this.name.textContent = this.nameOf(figure);
    this.status.textContent = this.sizes();
    this.showPreview();
  }

  sizes() {
    const { figure, chosen: { scale, format } } = this;
    const size = `${wholePixels(figure.width * scale)} × ${wholePixels(figure.height * scale)} px`;
    if (figure.render) return `${size}, as shown in the 3D pane. Not available as SVG.`;
    return format === "svg" ? "SVG: sharp at any size, with text as text." : size;
  }

  showPreview() {
    const { figure } = this;
    if (figure.render) {
      this.preview.replaceChildren();
      return;
    }
    const scale = Math.min(PREVIEW_PX[0] / figure.width, PREVIEW_PX[1] / figure.height);
    const canvas = canvasOf(figure, scale * devicePixelRatio, this.options);
    canvas.style.width = `${scale * figure.width}px`;
    this.preview.replaceChildren(canvas);
  }

  async store() {
    const { figure } = this;
    this.save.disabled = true;
    this.status.textContent = figure.render ? "Rendering the 3D pane …" : "";
    try {
      download(await fileOf(figure, this.options), this.nameOf(figure));
      this.dialog.close();
    } catch (error) {
      this.status.textContent = `Not saved: ${error instanceof Error ? error.message : error}`;
      this.save.disabled = false;
    }
  }
}

/**
 * @param {string} title
 * @param {string} name
 * @param {[string | number, string][]} choices
 * @param {string | number} value
 */
function radios(title, name, choices, value) {
  /** @param {[string | number, string]} choice */
  const radio = ([key, text]) => el("label", { class: "chip" }, el("input", { type: "radio", name, value: key, checked: key === value ? "" : undefined }), text);
  return el("fieldset", {}, el("legend", { text: title }), ...choices.map(radio));
}

/**
 * @param {string} name
 * @param {string} text
 * @param {boolean} checked
 */
function box(name, text, checked) {
  return el("label", { class: "chip" }, el("input", { type: "checkbox", name, checked: checked ? "" : undefined }), text);
}

/**
 * @param {Iterable<Node>} inputs
 * @param {boolean} isEnabled
 */
function enable(inputs, isEnabled) {
  for (const input of inputs) if (input instanceof HTMLInputElement) input.disabled = !isEnabled;
}
