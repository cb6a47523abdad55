/* The forecast: its button, and what the band along the route in the 3D pane means. */

import { byId, el } from "/static/dom.js";
import { flag, yes } from "./address.js";

export class Forecast {
  constructor(page) {
    this.page = page;
    byId("forecast").addEventListener("click", () => this.toggle());
  }

  commands() {
    const title = "Forecast: how well the map lets a camera know its place";
    return [{ key: "f", group: "3D", title, run: () => this.toggle() }];
  }

  address() {
    return [{
      fields: { forecast: flag() },
      get: () => ({ forecast: yes(this.page.state.forecast) }),
      set: ({ forecast }) => this.ask(forecast === "yes"),
    }];
  }

  toggle() {
    this.ask(!this.page.state.forecast);
  }

  ask(shown) {
    this.page.socket.send({ verb: "forecast", shown });
  }

  showRun() {
    byId("forecast-legend").replaceChildren();
  }

  showState(state) {
    byId("forecast").setAttribute("aria-pressed", state.forecast);
    byId("forecast-legend").hidden = !state.forecast;
  }

  showForecast(forecast) {
    if (!forecast.ready) {
      byId("forecast-legend").replaceChildren(el("span", { text: `Forecast: ${forecast.doing}` }));
      return;
    }
    const hatch = el("span", {}, el("i", { class: "hatch" }), "mostly ambiguous");
    const added = forecast.suggested.map(({ position, text }, row) => el("button", {
      class: "added",
      title: "Go to the first frame that it helps",
      text: `${row + 1}  Add a ${text}`,
      onclick: () => { if (position !== null) this.page.go(position); },
    }));
    byId("forecast-legend").replaceChildren(el("b", { text: "Expected error" }), scale(forecast.limits), hatch, ...added);
  }
}

/** Swatches as wide as the band's levels, with the limits between them. */
function scale(limits) {
  const swatches = [...limits, null].map((limit, level) => {
    const swatch = el("i", { class: "level", title: `level ${level + 1} of ${limits.length + 1}` });
    swatch.style.background = `var(--residual-${level})`;
    swatch.style.height = `${3 + 2 * level}px`;
    return el("span", { class: "step" }, swatch, el("small", { text: limit ?? "m" }));
  });
  return el("span", { class: "scale" }, ...swatches);
}
