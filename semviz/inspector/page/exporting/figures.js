// @ts-check
/* Files of figures: PNG at up to four times the size, or SVG. */

import { cssColor } from "/static/canvas.js";
import { inTheme } from "/static/theme.js";
import { SvgContext } from "./svg.js";

/** @typedef {import("../panel.js").Context} Context */
/** @typedef {import("../panel.js").Figure} Figure */
/** @typedef {import("../panel.js").FigureOptions} FigureOptions */
/** @typedef {import("../panel.js").Panel} Panel */

/** @typedef {Figure & {panel: Panel}} PanelFigure */

/** All figures that can be saved, each with its panel.
 *
 * @param {Panel[]} panels
 * @returns {PanelFigure[]}
 */
export function figuresOf(panels) {
  return panels.flatMap((panel) => (panel.figures?.() ?? []).map((figure) => ({ ...figure, panel })));
}

/** The bytes of the file.
 *
 * @param {PanelFigure} figure
 * @param {FigureOptions} options
 * @returns {Promise<Blob>}
 */
export async function fileOf(figure, options) {
  if (figure.render) return figure.render(options.scale);
  if (options.format === "svg") return new Blob([svgOf(figure, options)], { type: "image/svg+xml" });
  const canvas = canvasOf(figure, options.scale, options);
  return new Promise((resolve, reject) => {
    canvas.toBlob((blob) => (blob ? resolve(blob) : reject(new Error("the image is too large"))), "image/png");
  });
}

/**
 * @param {PanelFigure} figure
 * @param {FigureOptions} options
 */
export function svgOf(figure, options) {
  const context = new SvgContext(wholePixels(figure.width), wholePixels(figure.height));
  paint(figure, /** @type {any} */ (context), options); // implements what drawing needs
  return String(context);
}

/**
 * @param {PanelFigure} figure
 * @param {number} scale
 * @param {FigureOptions} options
 */
export function canvasOf(figure, scale, options) {
  const canvas = document.createElement("canvas");
  canvas.width = wholePixels(figure.width * scale);
  canvas.height = wholePixels(figure.height * scale);
  const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  context.scale(scale, scale);
  paint(figure, context, options);
  return canvas;
}

/**
 * @param {PanelFigure} figure
 * @param {Context} context
 * @param {FigureOptions} options
 */
function paint(figure, context, options) {
  inTheme(options.theme, () => {
    figure.panel.showTheme?.(); // it may cache colours
    context.fillStyle = cssColor("--panel");
    context.fillRect(0, 0, figure.width, figure.height);
    figure.draw?.(context, options);
  });
  figure.panel.showTheme?.();
}

/** For example `demo-frame-97-image.svg`.
 *
 * @param {string} run
 * @param {number} frame
 * @param {Figure} figure
 * @param {"png" | "svg"} format
 */
export function fileName(run, frame, figure, format) {
  const plain = run.replace(/[^\p{L}\p{N}._-]+/gu, "-").replace(/^[-.]+|[-.]+$/g, "");
  return `${plain}-frame-${frame}-${figure.name}.${format}`;
}

/**
 * @param {Blob} blob
 * @param {string} name
 */
export function download(blob, name) {
  const address = URL.createObjectURL(blob);
  const link = document.createElement("a");
  [link.href, link.download] = [address, name];
  link.click();
  setTimeout(() => URL.revokeObjectURL(address), 60_000); // the browser may still read it
}

/** Whole pixels: a fraction at the edge is cut off.
 *
 * @param {number} size
 */
export const wholePixels = (size) => Math.max(1, Math.floor(size));
