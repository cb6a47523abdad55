/* Viewpoints of a person's own in 3D, kept in this browser for all runs in the same map frame. */

import { byId, el } from "/static/dom.js";

export class Viewpoints {
  constructor(page) {
    this.page = page;
    byId("viewpoints-open").addEventListener("click", () => this.toggle());
    byId("viewpoints-form").addEventListener("submit", (event) => {
      event.preventDefault();
      page.socket.send({ verb: "viewpoint" });
    });
    byId("viewpoints").addEventListener("keydown", (event) => {
      if (event.key === "Escape") this.toggle(false);
    });
  }

  commands() {
    return [{ key: "y", group: "3D", title: "Viewpoints of your own", run: () => this.toggle() }];
  }

  showRun(run) {
    this.place = `semviz.viewpoints.${run.mapFrame}`;
    this.fill();
  }

  /** A link's viewpoint is taken when it is followed; where somebody looks from is not written. */
  address() {
    return [{
      fields: { eye: { initial: null, knows: (text) => viewpointOf(text) !== null } },
      get: () => ({ eye: null }),
      set: ({ eye }) => this.go(viewpointOf(eye)),
    }];
  }

  showViewpoint(viewpoint) {
    const name = byId("viewpoints-name").value.trim() || `Frame ${this.page.frame.index}`;
    this.keep([...this.kept().filter((one) => one.name !== name), { name, ...viewpoint }]);
    byId("viewpoints-name").value = "";
    byId("viewpoints-name").blur(); // the page has its keys again
  }

  toggle(open = byId("viewpoints").hidden) {
    byId("viewpoints").hidden = !open;
    byId("viewpoints-open").setAttribute("aria-pressed", open);
    if (open) byId("viewpoints-name").focus();
    else byId("viewpoints-name").blur();
  }

  kept() {
    return JSON.parse(localStorage.getItem(this.place) ?? "[]");
  }

  keep(viewpoints) {
    localStorage.setItem(this.place, JSON.stringify(viewpoints));
    this.fill();
  }

  fill() {
    const rows = this.kept().map((one) => this.row(one));
    const none = el("li", { class: "dim", text: "None kept yet for this map." });
    byId("viewpoints-list").replaceChildren(...(rows.length ? rows : [none]));
  }

  row(one) {
    const button = (text, title, run) => el("button", { class: "plain", text, title, onclick: run });
    return el("li", {},
      el("button", { class: "plain name", text: one.name, title: "Look from there", onclick: () => this.go(one) }),
      button("Link", "Copy a link that looks from there", () => this.copy(one)),
      button("×", "Delete", () => this.keep(this.kept().filter(({ name }) => name !== one.name))));
  }

  go({ eye, target }) {
    this.page.socket.send({ verb: "stand", eye, target });
  }

  copy({ eye, target }) {
    const address = new URL(location.href);
    address.searchParams.set("eye", [...eye, ...target].join(","));
    navigator.clipboard.writeText(address.href);
  }
}

/** `x,y,z` of the eye, then of its target; null for any other text. */
function viewpointOf(text) {
  const numbers = text.split(",").map(Number);
  if (numbers.length !== 6 || !numbers.every(Number.isFinite)) return null;
  return { eye: numbers.slice(0, 3), target: numbers.slice(3) };
}
