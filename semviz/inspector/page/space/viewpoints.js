// @ts-check
/* Saved viewpoints in 3D, stored in this browser for all runs in the same map frame. */

import { byId, el } from "/static/dom.js";

/** @typedef {import("../run_rows.js").OpenRun} OpenRun */
/** @typedef {import("/static/keys.js").Command} Command */
/** @typedef {import("../panel.js").AddressPart} AddressPart */
/** @typedef {import("../main.js").Page} Page */

/** @typedef {{eye: [number, number, number], target: [number, number, number]}} Viewpoint */
/** @typedef {Viewpoint & {name: string}} SavedViewpoint */

export class Viewpoints {
  /** @param {Page} page */
  constructor(page) {
    this.page = page;
    this.key = ""; // in localStorage
    this.input = byId("viewpoints-name", HTMLInputElement);
    page.socket.on("viewpoint", ({ eye, target }) => this.add({ eye, target }));
    byId("viewpoints-open").addEventListener("click", () => this.toggle());
    byId("viewpoints-form").addEventListener("submit", (event) => {
      event.preventDefault();
      page.socket.send("get_viewpoint");
    });
    byId("viewpoints").addEventListener("keydown", (event) => {
      if (event.key === "Escape") this.toggle(false);
    });
  }

  /** @returns {Command[]} */
  commands() {
    return [{ key: "y", group: "3D", title: "Saved viewpoints", run: () => this.toggle() }];
  }

  /** @param {OpenRun} run */
  showRun(run) {
    this.key = `semviz.viewpoints.${run.map_frame}`;
    this.fill();
  }

  /** A viewpoint in a link is applied once; the present viewpoint is not written.
   *
   * @returns {AddressPart[]}
   */
  address() {
    return [{
      fields: { eye: { initial: null, accepts: (text) => viewpointOf(text) !== null } },
      get: () => ({ eye: null }),
      set: ({ eye }) => {
        const viewpoint = eye === null ? null : viewpointOf(eye);
        if (viewpoint) this.go(viewpoint);
      },
    }];
  }

  /** Saves a viewpoint under the name that was entered.
   *
   * @param {Viewpoint} viewpoint
   */
  add(viewpoint) {
    const name = this.input.value.trim() || `Frame ${this.page.store.frame.index}`;
    this.save([...this.saved().filter((other) => other.name !== name), { name, ...viewpoint }]);
    this.input.value = "";
    this.input.blur(); // give the keys back to the page
  }

  /** @param {boolean} [open] */
  toggle(open = byId("viewpoints").hidden) {
    byId("viewpoints").hidden = !open;
    byId("viewpoints-open").setAttribute("aria-pressed", String(open));
    if (open) this.input.focus();
    else this.input.blur();
  }

  /** @returns {SavedViewpoint[]} */
  saved() {
    return JSON.parse(localStorage.getItem(this.key) ?? "[]");
  }

  /** @param {SavedViewpoint[]} viewpoints */
  save(viewpoints) {
    localStorage.setItem(this.key, JSON.stringify(viewpoints));
    this.fill();
  }

  fill() {
    const rows = this.saved().map((viewpoint) => this.row(viewpoint));
    const none = el("li", { class: "dim", text: "No saved viewpoints for this map." });
    byId("viewpoints-list").replaceChildren(...(rows.length ? rows : [none]));
  }

  /** @param {SavedViewpoint} viewpoint */
  row(viewpoint) {
    /** @type {(text: string, title: string, run: () => void) => HTMLButtonElement} */
    const button = (text, title, run) => el("button", { class: "plain", text, title, onclick: run });
    return el("li", {},
      el("button", { class: "plain name", text: viewpoint.name, title: "Go to this viewpoint", onclick: () => this.go(viewpoint) }),
      button("Link", "Copy a link to this viewpoint", () => this.copy(viewpoint)),
      button("×", "Delete", () => this.save(this.saved().filter(({ name }) => name !== viewpoint.name))));
  }

  /** @param {Viewpoint} viewpoint */
  go({ eye, target }) {
    this.page.socket.send("go_to_viewpoint", { eye, target });
  }

  /** @param {Viewpoint} viewpoint */
  copy({ eye, target }) {
    const address = new URL(location.href);
    address.searchParams.set("eye", [...eye, ...target].join(","));
    navigator.clipboard.writeText(address.href);
  }
}

/** `x,y,z` of the eye, then of its target; null for any other text.
 *
 * @param {string} text
 * @returns {Viewpoint | null}
 */
function viewpointOf(text) {
  const numbers = text.split(",").map(Number);
  if (numbers.length !== 6 || !numbers.every(Number.isFinite)) return null;
  const [x, y, z, u, v, w] = numbers;
  return { eye: [x, y, z], target: [u, v, w] };
}
