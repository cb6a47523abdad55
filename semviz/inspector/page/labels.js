// @ts-check
/* Labels on the image that never overlap: of two that would, the less important one is left out. */

import { drawText } from "/static/glyphs.js";

/** @typedef {import("/static/canvas.js").Point} Point */
/** @typedef {import("./panel.js").Context} Context */

const LINE_PX = 14;

/** @typedef {{text: string, x: number, y: number, color: string, weight: number, first: boolean, second: string}} Label */
/** @typedef {{x: number, y: number, width: number, height: number}} Box */

export class Labels {
  /**
   * @param {Context} context
   * @param {number} width
   * @param {number} height
   */
  constructor(context, width, height) {
    this.context = context;
    this.width = width;
    this.height = height;
    /** @type {Label[]} */
    this.labels = [];
  }

  /** Adds a label beside a point on the canvas. `first` labels always stay; `second` is a second line.
   *
   * @param {string} text
   * @param {Point} at
   * @param {{color?: string, weight?: number, first?: boolean, second?: string}} [style]
   */
  add(text, [x, y], { color = "#FFFFFF", weight = 600, first = false, second = "" } = {}) {
    if (!first && (x < 0 || x > this.width)) return;
    this.labels.push({ text, x, y, color, weight, first, second });
  }

  draw() {
    const order = this.labels.sort((a, b) => Number(b.first) - Number(a.first) || b.weight - a.weight);
    /** @type {Box[]} */
    const boxes = [];
    for (const label of order) {
      const box = this.place(label);
      if (!label.first && boxes.some((other) => overlap(box, other))) continue;
      boxes.push(box);
      const { color, weight } = label;
      drawText(this.context, label.text, box.x, box.y + LINE_PX / 2, { color, weight });
      if (label.second) drawText(this.context, label.second, box.x, box.y + 1.5 * LINE_PX, { color, weight: 400 });
    }
  }

  /** @param {Label} label */
  place({ text, x, y, second, weight, first }) {
    this.context.font = `${weight} 11px Inter, "Liberation Sans", Arial, sans-serif`;
    const width = Math.max(this.context.measureText(text).width, this.context.measureText(second).width);
    const gap = first ? 18 : 11;
    const left = x + gap + width > this.width - 4 ? x - gap - width : x + gap;
    const height = second ? 2 * LINE_PX : LINE_PX;
    const top = Math.min(Math.max(y - LINE_PX / 2, 2), this.height - height - 2);
    return { x: left, y: top, width, height };
  }
}

/**
 * @param {Box} a
 * @param {Box} b
 */
function overlap(a, b) {
  return a.x < b.x + b.width + 3 && b.x < a.x + a.width + 3 && a.y < b.y + b.height && b.y < a.y + a.height;
}
