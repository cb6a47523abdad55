/* Labels on the image that never cover each other: where two would, the one with less to say goes. */

import { drawText } from "/static/glyphs.js";

const LINE_PX = 14;

export class Labels {
  constructor(context, width, height) {
    this.context = context;
    this.width = width;
    this.height = height;
    this.wanted = [];
  }

  /** A label beside a point that is on the canvas; `first` ones always stay, `second` is a second
   * line. */
  add(text, [x, y], { color = "#FFFFFF", weight = 600, first = false, second = "" } = {}) {
    if (!first && (x < 0 || x > this.width)) return;
    this.wanted.push({ text, x, y, color, weight, first, second });
  }

  draw() {
    const order = this.wanted.sort((a, b) => b.first - a.first || b.weight - a.weight);
    const taken = [];
    for (const label of order) {
      const box = this.place(label);
      if (!label.first && taken.some((other) => overlap(box, other))) continue;
      taken.push(box);
      const { color, weight } = label;
      drawText(this.context, label.text, box.x, box.y + LINE_PX / 2, { color, weight });
      if (label.second) drawText(this.context, label.second, box.x, box.y + 1.5 * LINE_PX, { color, weight: 400 });
    }
  }

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

function overlap(a, b) {
  return a.x < b.x + b.width + 3 && b.x < a.x + a.width + 3 && a.y < b.y + b.height && b.y < a.y + a.height;
}
