// @ts-check
/* The forecast: its button, and the legend of its band in the 3D pane. */

import { byId, el } from "/static/dom.js";
import { flag, yes } from "./address.js";

/** @typedef {import("/static/protocol").inspector.ForecastEvent} ForecastEvent */
/** @typedef {import("/static/protocol").inspector.StateView} StateView */
/** @typedef {import("/static/keys.js").Command} Command */
/** @typedef {import("./panel.js").AddressPart} AddressPart */
/** @typedef {import("./main.js").Page} Page */

export class Forecast {
  /** @param {Page} page */
  constructor(page) {
    this.page = page;
    page.socket.on("forecast", (event) => this.showForecast(event));
    byId("forecast").addEventListener("click", () => this.toggle());
  }

  /** @returns {Command[]} */
  commands() {
    const title = "Forecast: the expected error";
    return [{ key: "f", group: "3D", title, run: () => this.toggle() }];
  }

  /** @returns {AddressPart[]} */
  address() {
    return [{
      fields: { forecast: flag() },
      get: () => ({ forecast: yes(this.page.store.state.forecast) }),
      set: ({ forecast }) => this.setShown(forecast === "yes"),
    }];
  }

  toggle() {
    this.setShown(!this.page.store.state.forecast);
  }

  /** @param {boolean} shown */
  setShown(shown) {
    this.page.socket.send("show_forecast", { shown });
  }

  showRun() {
    byId("forecast-legend").replaceChildren();
  }

  /** @param {StateView} state */
  showState(state) {
    byId("forecast").setAttribute("aria-pressed", String(state.forecast));
    byId("forecast-legend").hidden = !state.forecast;
  }

  /** @param {ForecastEvent} event */
  showForecast({ progress, found: forecast }) {
    if (!forecast) {
      byId("forecast-legend").replaceChildren(el("span", { text: `Forecast: ${progress}` }));
      return;
    }
    const hatch = el("span", {}, el("i", { class: "hatch" }), "mostly ambiguous");
    const added = forecast.suggested.map(({ position, text }, row) => el("button", {
      class: "added",
      title: "Go to the first frame that it improves",
      text: `${row + 1}  Add a ${text}`,
      onclick: () => { if (position !== null) this.page.go(position); },
    }));
    byId("forecast-legend").replaceChildren(el("b", { text: "Expected error" }), scale(forecast.limits), hatch, ...added);
  }
}

/** Swatches of the band's levels, with the limits between them.
 *
 * @param {number[]} limits
 */
function scale(limits) {
  const swatches = [...limits, null].map((limit, level) => {
    const swatch = el("i", { class: "level", title: `level ${level + 1} of ${limits.length + 1}` });
    swatch.style.background = `var(--residual-${level})`;
    swatch.style.height = `${3 + 2 * level}px`;
    return el("span", { class: "step" }, swatch, el("small", { text: limit ?? "m" }));
  });
  return el("span", { class: "scale" }, ...swatches);
}
