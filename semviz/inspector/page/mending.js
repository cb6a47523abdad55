/* From error to label: opens the label behind an element, says what was edited since the run's map
 * was built, and has map and run made again. */

import { byId, el } from "/static/dom.js";

export class Mending {
  constructor(page) {
    this.page = page;
    this.shown = { workspace: "", edits: 0, undoable: 0, rebuild: null };
    this.kept = "";
    window.addEventListener("focus", () => { if (page.run) this.send("mending"); }); // back from the labels
  }

  commands() {
    const mend = (key, title, run) => ({ key, title, run, group: "Mend" });
    return [
      mend("o", "Open the label behind the selected or blamed element", () => this.openLabel()),
      mend("n", "Merge what the verdict says is in the map twice", () => this.send("merge")),
    ];
  }

  send(verb, values = {}) {
    this.page.socket.send({ verb, ...values });
  }

  openLabel() {
    this.send("label", { element: this.page.state.element });
  }

  /* What the server says */

  showRun() {
    this.kept = "";
  }

  showFrame(frame) {
    const { blamed } = frame.why;
    const actions = [];
    if (blamed.length && this.shown.workspace) actions.push(this.labelButton(null));
    if (frame.verdict === "twice in the map" && this.shown.workspace) {
      actions.push(el("button", { class: "small", title: "Say in the labels that they are one thing", onclick: () => this.send("merge") },
        `Merge ${blamed.join(" and ")} `, el("kbd", { text: "N" })));
    }
    byId("why-actions").replaceChildren(...actions);
  }

  showState({ element }) {
    this.fill(); // beside another run there is no room for the bar
    byId("selected-actions").replaceChildren(...(element === null || !this.shown.workspace ? [] : [
      this.labelButton(element),
      el("button", { class: "small", text: "Leave out of the map", title: "An edit of the labels, which can be taken back", onclick: () => this.send("leave out", { element }) }),
    ]));
  }

  labelButton(element) {
    return el("button", { class: "small", title: "Opens annotate in a tab of its own, at a frame that shows it", onclick: () => this.send("label", { element }) },
      "Open label ", el("kbd", { text: "O" }));
  }

  showLabel(address) {
    if (!window.open(address, "semviz-annotate")) this.page.notice(`The browser does not open another tab. The label is at ${new URL(address, location.href)}`);
  }

  showMapKept(text) {
    this.kept = text;
    this.fill();
  }

  showMending(shown) {
    this.shown = shown;
    if (this.page.frame) {
      this.showFrame(this.page.frame);
      this.showState(this.page.state);
    }
    this.fill();
  }

  /* The bar */

  fill() {
    const { edits, rebuild } = this.shown;
    const parts = rebuild ? this.madeAgain(rebuild) : edits ? this.edited() : [];
    byId("mending").hidden = !parts.length || this.page.state.comparing;
    byId("mending").replaceChildren(...parts);
  }

  edited() {
    const { edits, workspace, undoable } = this.shown;
    const count = edits === 1 ? "1 edit" : `${edits} edits`;
    return [
      el("span", { class: "text", text: `The labels of ${workspace} have ${count} that this run's map does not know.` }),
      el("span", { class: "push" }),
      undoable ? button("Take back the last", () => this.send("take back")) : null,
      button("Build the map and localize again", () => this.send("rebuild"), "primary"),
    ];
  }

  madeAgain({ isOver, doing, run }) {
    const text = el("span", { class: "text", text: run ? `${run}: ${this.kept || doing}` : doing });
    const push = el("span", { class: "push" });
    if (!isOver) return [text, push, button("Stop", () => this.send("stop rebuild"))];
    const again = button("Build again", () => this.send("rebuild"));
    if (!run) return [text, push, again];
    return [text, push, again, button("Keep this map", () => this.send("keep map")), button("Side by side", () => this.compare(run), "primary")];
  }

  /** The new run as B, the one it was made from as A. */
  compare(run) {
    const base = this.page.run.name;
    this.page.open(run, this.page.frame.index);
    this.send("compare", { base, comparing: true });
  }
}

function button(text, onclick, kind = "") {
  return el("button", { class: `small ${kind}`, text, onclick });
}
