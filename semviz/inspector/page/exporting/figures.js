/* A panel's figure as a file: PNG at up to four times its size, or SVG.
 *
 * Panels offer figures by `figures()`: `{name, title, width, height, draw(context, {photo, legend})}`
 * with sizes in CSS pixels. `hasPhoto` and `hasLegend` say that the options mean something to it; one
 * with `render(scale)`, a promise of a PNG, instead of `draw` can be had as PNG only. */

import { cssColor } from "/static/canvas.js";
import { inTheme } from "/static/theme.js";
import { SvgContext } from "./svg.js";

/** All that can be saved now, each with the panel that draws it. */
export function figuresOf(panels) {
  return panels.flatMap((panel) => (panel.figures?.() ?? []).map((figure) => ({ ...figure, panel })));
}

/** The file's bytes. `options`: `{format: "png" or "svg", scale, theme, photo, legend}`. */
export async function fileOf(figure, options) {
  if (figure.render) return figure.render(options.scale);
  if (options.format === "svg") return new Blob([svgOf(figure, options)], { type: "image/svg+xml" });
  const canvas = canvasOf(figure, options.scale, options);
  return new Promise((done) => { canvas.toBlob(done, "image/png"); });
}

export function svgOf(figure, options) {
  const context = new SvgContext(whole(figure.width), whole(figure.height));
  paint(figure, context, options);
  return String(context);
}

export function canvasOf(figure, scale, options) {
  const canvas = document.createElement("canvas");
  canvas.width = whole(figure.width * scale);
  canvas.height = whole(figure.height * scale);
  const context = canvas.getContext("2d");
  context.scale(scale, scale);
  paint(figure, context, options);
  return canvas;
}

function paint(figure, context, options) {
  inTheme(options.theme, () => {
    figure.panel.showTheme?.(); // it may keep colours
    context.fillStyle = cssColor("--panel");
    context.fillRect(0, 0, figure.width, figure.height);
    figure.draw(context, options);
  });
  figure.panel.showTheme?.();
}

/** Says what is in it: `demo-frame-97-image.svg`. */
export function fileName(run, frame, figure, format) {
  const plain = run.replace(/[^\p{L}\p{N}._-]+/gu, "-").replace(/^[-.]+|[-.]+$/g, "");
  return `${plain}-frame-${frame}-${figure.name}.${format}`;
}

export function download(blob, name) {
  const address = URL.createObjectURL(blob);
  const link = document.createElement("a");
  [link.href, link.download] = [address, name];
  link.click();
  setTimeout(() => URL.revokeObjectURL(address), 60_000); // the browser may still read it
}

/** Whole pixels: a part of one at the edge is left out. */
export const whole = (size) => Math.max(1, Math.floor(size));
