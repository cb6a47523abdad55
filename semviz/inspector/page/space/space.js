// @ts-check
/* The 3D panel around viser's iframe: viewpoints, colours of the map, legend. */

import { byId, el } from "/static/dom.js";
import { classGlyph, statusMark } from "/static/glyphs.js";
import { currentTheme } from "/static/theme.js";
import { flag, oneOf, yes } from "../address.js";

/** @typedef {import("/static/protocol").inspector.FrameView} FrameView */
/** @typedef {import("/static/protocol").inspector.MapColorsEvent} MapColorsEvent */
/** @typedef {import("/static/protocol").inspector.MapLegend} MapLegend */
/** @typedef {import("/static/protocol").inspector.StateView} StateView */
/** @typedef {import("/static/keys.js").Command} Command */
/** @typedef {import("../panel.js").AddressPart} AddressPart */
/** @typedef {import("../main.js").Page} Page */

const POSES = [
  ["truth", ""],
  ["estimate", ""],
  ["prior", "dashed"],
  ["alternative", "dotted"],
];
const STATUS = ["ok", "ambiguous", "cannot"];
const COLORS = { class: "Class", residual: "Residual", times: "Usage" };
/** @type {MapColors[]} */
const NAMES = ["class", "residual", "times"];

/** @typedef {StateView["colors"]} MapColors */
const TITLES = {
  class: "",
  residual: "Median residual, px: elements",
  times: "Frames that use it: elements",
};

export class SpacePanel {
  /** @param {Page} page */
  constructor(page) {
    this.page = page;
    this.state = page.store.state;
    /** @type {NodeListOf<HTMLElement>} */
    this.views = document.querySelectorAll("[data-view]");
    for (const button of this.views) {
      button.addEventListener("click", () => page.setView(/** @type {StateView["view"]} */ (button.dataset.view)));
    }
    page.socket.on("map_colors", (event) => this.showMapColors(event));
    byId("map-colors").addEventListener("click", () => this.nextColors());
    byId("ellipsoids").addEventListener("click", () => this.toggleEllipsoids());
  }

  /** @returns {Command[]} */
  commands() {
    /** @type {(key: string, title: string, run: () => void, shift?: boolean) => Command} */
    const own = (key, title, run, shift = false) => ({ key, shift, title, run, group: "3D" });
    return [
      own("v", "Map by class, residual, usage", () => this.nextColors()),
      own("v", "Covariance ellipsoids", () => this.toggleEllipsoids(), true),
    ];
  }

  /** @returns {AddressPart[]} */
  address() {
    return [
      { // a free viewpoint is not shared
        fields: { view: oneOf("behind", "above", "camera") },
        get: () => ({ view: this.state.view === "free" ? "behind" : this.state.view }),
        set: ({ view }) => this.page.setView(view),
      },
      {
        fields: { colors: oneOf(...NAMES), sigma: flag() },
        get: () => ({ colors: this.state.colors, sigma: yes(this.state.ellipsoids) }),
        set: ({ colors, sigma }) => this.setColors({ colors, ellipsoids: sigma === "yes" }),
      },
      {
        fields: { others: flag("yes") },
        get: () => ({ others: yes(this.state.alternatives) }),
        set: ({ others }) => this.page.socket.send("show_alternatives", { shown: others === "yes" }),
      },
    ];
  }

  nextColors() {
    this.setColors({ colors: NAMES[(NAMES.indexOf(this.state.colors) + 1) % NAMES.length] });
  }

  toggleEllipsoids() {
    this.setColors({ ellipsoids: !this.state.ellipsoids });
  }

  /** @param {{colors?: MapColors, ellipsoids?: boolean}} wish */
  setColors(wish) {
    this.state = { ...this.state, ...wish }; // the next key may come before the reply
    this.page.socket.send("set_map_colors", wish);
  }

  /** @param {FrameView} frame */
  showFrame(frame) {
    const about = byId("space-about");
    about.textContent = `${frame.mapped.length} of ${this.page.store.run.elements} elements`;
    about.title = "Elements of the submap: those near the prior";
  }

  /** @param {StateView} state */
  showState(state) {
    this.state = state;
    for (const button of this.views) {
      button.setAttribute("aria-pressed", String(button.dataset.view === state.view));
    }
    byId("map-colors-name").textContent = COLORS[state.colors];
    byId("ellipsoids").setAttribute("aria-pressed", String(state.ellipsoids));
  }

  /** @param {MapColorsEvent} event */
  showMapColors({ legend, magnified }) {
    byId("space-legend").replaceChildren(
      el("div", {}, ...(legend.levels.length ? this.levels(legend) : this.classes())),
      el("div", {}, ...POSES.map(([role, style]) => el("span", {}, poseLine(role, style), role)),
        ...STATUS.map((status) => el("span", {}, statusMark(status), status)), "click a frame to go there",
        magnified && el("span", {}, el("i", { class: "ball" }), `1σ × ${magnified}`)),
    );
  }

  classes() {
    const light = currentTheme() === "light";
    return this.page.store.run.classes.map((kind) => el("span", {}, classGlyph(kind, light ? kind.color_light : kind.color), kind.name));
  }

  /** @param {MapLegend} legend */
  levels({ by, levels }) {
    const shown = levels.map(({ color, width, name, elements }) => {
      const line = el("i", { class: "line" });
      line.style.borderTop = `${width}px solid ${color}`;
      return el("span", {}, line, el("b", { text: name }), String(elements));
    });
    return [el("span", { text: TITLES[by] }), ...shown];
  }
}

/**
 * @param {string} role
 * @param {string} style
 */
function poseLine(role, style) {
  const line = el("i", { class: `line ${style}` });
  line.style.borderColor = `var(--${role})`;
  return line;
}
