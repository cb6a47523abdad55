/* The 3D panel around viser's iframe: viewpoints, colours of the map, and what they mean. */

import { byId, el } from "/static/dom.js";
import { classGlyph, statusMark } from "/static/glyphs.js";
import { currentTheme } from "/static/theme.js";
import { flag, oneOf, yes } from "./address.js";

const POSES = [
  ["truth", ""],
  ["estimate", ""],
  ["prior", "dashed"],
  ["alternative", "dotted"],
];
const STATUS = ["ok", "ambiguous", "cannot"];
const COLORS = { class: "Class", residual: "Residual", times: "Times used" };
const NAMES = Object.keys(COLORS);
const TITLES = {
  residual: "Median residual, px: elements",
  times: "Times used: elements",
};

export class SpacePanel {
  constructor(page) {
    this.page = page;
    this.coloring = null;
    for (const button of document.querySelectorAll("[data-view]")) {
      button.addEventListener("click", () => page.look(button.dataset.view));
    }
    byId("map-colors").addEventListener("click", () => this.nextColors());
    byId("ellipsoids").addEventListener("click", () => this.toggleEllipsoids());
  }

  commands() {
    const own = (key, title, run, shift = false) => ({ key, shift, title, run, group: "3D" });
    return [
      own("v", "Map by class, residual, times used", () => this.nextColors()),
      own("v", "Covariance of the elements", () => this.toggleEllipsoids(), true),
    ];
  }

  address() {
    return [
      { // a viewpoint of one's own stays with who has it
        fields: { view: oneOf("behind", "above", "camera") },
        get: () => ({ view: this.state.view === "free" ? "behind" : this.state.view }),
        set: ({ view }) => this.page.look(view),
      },
      {
        fields: { colors: oneOf(...NAMES), sigma: flag() },
        get: () => ({ colors: this.state.colors, sigma: yes(this.state.ellipsoids) }),
        set: ({ colors, sigma }) => this.ask({ colors, ellipsoids: sigma === "yes" }),
      },
      {
        fields: { others: flag("yes") },
        get: () => ({ others: yes(this.state.alternatives) }),
        set: ({ others }) => this.page.socket.send({ verb: "alternatives", shown: others === "yes" }),
      },
    ];
  }

  nextColors() {
    this.ask({ colors: NAMES[(NAMES.indexOf(this.state.colors) + 1) % NAMES.length] });
  }

  toggleEllipsoids() {
    this.ask({ ellipsoids: !this.state.ellipsoids });
  }

  ask(wanted) {
    this.state = { ...this.state, ...wanted }; // the next key may come before the answer
    this.page.socket.send({ verb: "colors", ...wanted });
  }

  showRun(run) {
    this.run = run;
  }

  showFrame(frame) {
    const about = byId("space-about");
    about.textContent = `${frame.mapped.length} of ${this.run.elements} elements`;
    about.title = "In the submap: near the prior, given to the solver";
  }

  showState(state) {
    this.state = state;
    for (const button of document.querySelectorAll("[data-view]")) {
      button.setAttribute("aria-pressed", button.dataset.view === state.view);
    }
    byId("map-colors").firstChild.textContent = `${COLORS[state.colors]} `;
    byId("ellipsoids").setAttribute("aria-pressed", state.ellipsoids);
  }

  showColoring(coloring) {
    byId("space-legend").replaceChildren(
      el("div", {}, ...(coloring.steps.length ? this.steps(coloring) : this.classes())),
      el("div", {}, ...POSES.map(([role, style]) => el("span", {}, poseLine(role, style), role)),
        ...STATUS.map((status) => el("span", {}, statusMark(status), status)), "frames: click to go",
        coloring.magnified && el("span", {}, el("i", { class: "ball" }), `1σ × ${coloring.magnified}`)),
    );
  }

  classes() {
    const light = currentTheme() === "light";
    return this.run.classes.map((one) => el("span", {}, classGlyph(one, light ? one.colorLight : one.color), one.name));
  }

  steps({ by, steps }) {
    const shown = steps.map(({ color, width, name, elements }) => {
      const line = el("i", { class: "line" });
      line.style.borderTop = `${width}px solid ${color}`;
      return el("span", {}, line, el("b", { text: name }), String(elements));
    });
    return [el("span", { text: TITLES[by] }), ...shown];
  }
}

function poseLine(role, style) {
  const line = el("i", { class: `line ${style}` });
  line.style.borderColor = `var(--${role})`;
  return line;
}
