/* The 3D panel around viser's iframe: viewpoints and legend. */

import { byId, el } from "/static/dom.js";
import { classGlyph } from "/static/glyphs.js";
import { currentTheme } from "/static/theme.js";

const POSES = [
  ["truth", ""],
  ["estimate", ""],
  ["prior", "dashed"],
  ["alternative", "dotted"],
];

export class SpacePanel {
  constructor(page) {
    this.page = page;
    for (const button of document.querySelectorAll("[data-view]")) {
      button.addEventListener("click", () => page.look(button.dataset.view));
    }
  }

  showRun(run) {
    this.run = run;
    this.showTheme();
  }

  showFrame(frame) {
    byId("space-about").textContent = `${frame.mapped.length} of ${this.run.elements} elements near the prior`;
  }

  showState(state) {
    for (const button of document.querySelectorAll("[data-view]")) {
      button.setAttribute("aria-pressed", button.dataset.view === state.view);
    }
  }

  showTheme() {
    const light = currentTheme() === "light";
    const classes = this.run.classes.map((one) =>
      el("span", {}, classGlyph(one, light ? one.colorLight : one.color), one.name));
    const poses = POSES.map(([role, style]) => {
      const line = el("i", { class: `line ${style}` });
      line.style.borderColor = `var(--${role})`;
      return el("span", {}, line, role);
    });
    byId("space-legend").replaceChildren(...classes, ...poses);
  }
}
