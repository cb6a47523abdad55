/* "Save a picture": which view, as what, and how it will look. */

import { byId, el } from "/static/dom.js";
import { currentTheme } from "/static/theme.js";
import { canvasOf, download, figuresOf, fileName, fileOf, whole } from "./figures.js";

const PREVIEW_PX = [420, 200];
const SCALES = [1, 2, 3, 4];

export class Exporter {
  constructor(page) {
    this.page = page;
    this.chosen = { view: "", format: "png", scale: 2, theme: "", photo: true, legend: true };
    byId("export").addEventListener("click", () => this.open());
  }

  commands() {
    return [{ key: "p", group: "Page", title: "Save a view as PNG or SVG", run: () => this.open() }];
  }

  /** The 3D pane, which viser draws: as PNG only. */
  figures() {
    const { width, height } = byId("scene").getBoundingClientRect();
    return byId("scene").matches(".ready") ? [{ name: "3d", title: "3D", width, height, render: (scale) => this.render(width, height, scale) }] : [];
  }

  render(width, height, scale) {
    this.page.socket.send({ verb: "render", width: whole(scale * width), height: whole(scale * height) });
    return new Promise((done, failed) => { this.awaited = { done, failed }; });
  }

  showRender({ png, why }) {
    if (why) this.awaited?.failed(new Error(why));
    else this.awaited?.done(new Blob([Uint8Array.from(atob(png), (one) => one.charCodeAt(0))], { type: "image/png" }));
  }

  open() {
    const figures = figuresOf(this.page.panels);
    if (!figures.length) return;
    this.chosen.theme ||= currentTheme();
    this.chosen.view = (figures.find((one) => one.title === this.chosen.view) ?? figures[0]).title;
    const dialog = new ExportDialog(figures, this.chosen, (figure) => this.nameOf(figure));
    document.body.append(dialog.dialog);
    dialog.dialog.showModal();
  }

  nameOf(figure) {
    return fileName(this.page.run.name, this.page.frame.index, figure, this.chosen.format);
  }
}

class ExportDialog {
  /** `chosen` is changed by what people choose, and stays so for the next time. */
  constructor(figures, chosen, nameOf) {
    Object.assign(this, { figures, chosen, nameOf });
    this.preview = el("div", { class: "preview" });
    this.said = el("p", { class: "dim", role: "status" });
    this.name = el("code");
    this.save = el("button", { class: "primary", type: "submit", text: "Save", autofocus: "" });
    this.form = el("form", { method: "dialog" });
    this.form.addEventListener("change", () => this.change());
    this.form.addEventListener("submit", (event) => { event.preventDefault(); this.store(); });
    this.dialog = el("dialog", { class: "help export", "aria-label": "Save a picture" }, this.form);
    this.dialog.addEventListener("close", () => this.dialog.remove());
    this.fill();
  }

  get figure() {
    return this.figures.find((one) => one.title === this.chosen.view);
  }

  fill() {
    const { chosen } = this;
    this.form.replaceChildren(
      el("header", {}, el("h2", { text: "Save a picture" }), el("span", { class: "push" }),
        el("button", { class: "plain", type: "button", "aria-label": "Close", onclick: () => this.dialog.close() }, el("kbd", { text: "Esc" }))),
      radios("View", "view", this.figures.map((one) => [one.title, one.title]), chosen.view),
      radios("As", "format", [["png", "PNG"], ["svg", "SVG"]], chosen.format),
      radios("Size", "scale", SCALES.map((scale) => [scale, `${scale}×`]), chosen.scale),
      radios("Ground", "theme", [["dark", "Dark"], ["light", "Light"]], chosen.theme),
      el("fieldset", {}, el("legend", { text: "With" }), box("photo", "Photo", chosen.photo), box("legend", "Legend", chosen.legend)),
      this.preview, this.said,
      el("footer", {}, this.name, el("span", { class: "push" }), this.save));
    this.show();
  }

  change() {
    const { view, format, scale, theme, photo, legend } = this.form.elements;
    Object.assign(this.chosen, {
      view: view.value, format: format.value, scale: Number(scale.value), theme: theme.value,
      photo: photo.checked, legend: legend.checked,
    });
    this.show();
  }

  /** What cannot be chosen for this view is greyed out, and why is said. */
  show() {
    const { figure, chosen } = this;
    if (figure.render) chosen.format = "png";
    const { elements } = this.form;
    elements.format.value = chosen.format;
    enable(elements.format, !figure.render);
    enable(elements.scale, chosen.format === "png");
    enable(elements.theme, !figure.render && !(figure.hasPhoto && chosen.photo));
    enable([elements.photo], figure.hasPhoto);
    enable([elements.legend], figure.hasLegend);
    this.name.textContent = this.nameOf(figure);
    this.said.textContent = this.sizes();
    this.showPreview();
  }

  sizes() {
    const { figure, chosen: { scale, format } } = this;
    const size = `${whole(figure.width * scale)} × ${whole(figure.height * scale)} px`;
    if (figure.render) return `${size}, as the 3D pane shows it now; it cannot be drawn as SVG.`;
    return format === "svg" ? "SVG stays sharp at any size; text stays text." : size;
  }

  showPreview() {
    const { figure } = this;
    if (figure.render) {
      this.preview.replaceChildren();
      return;
    }
    const scale = Math.min(PREVIEW_PX[0] / figure.width, PREVIEW_PX[1] / figure.height);
    const canvas = canvasOf(figure, scale * devicePixelRatio, this.chosen);
    canvas.style.width = `${scale * figure.width}px`;
    this.preview.replaceChildren(canvas);
  }

  async store() {
    const { figure } = this;
    this.save.disabled = true;
    this.said.textContent = figure.render ? "The 3D pane is being drawn." : "";
    try {
      download(await fileOf(figure, this.chosen), this.nameOf(figure));
      this.dialog.close();
    } catch (error) {
      this.said.textContent = `Not saved: ${error.message}`;
      this.save.disabled = false;
    }
  }
}

function radios(title, name, choices, value) {
  const one = ([key, text]) => el("label", { class: "chip" }, el("input", { type: "radio", name, value: key, checked: key === value ? "" : undefined }), text);
  return el("fieldset", {}, el("legend", { text: title }), ...choices.map(one));
}

function box(name, text, checked) {
  return el("label", { class: "chip" }, el("input", { type: "checkbox", name, checked: checked ? "" : undefined }), text);
}

function enable(inputs, isEnabled) {
  for (const input of inputs) input.disabled = !isEnabled;
}
