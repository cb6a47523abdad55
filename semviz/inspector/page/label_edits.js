// @ts-check
/* Opens the label behind an element, counts label edits newer than the run's map, and rebuilds map
 * and run. */

import { byId, el } from "/static/dom.js";

/** @typedef {import("/static/protocol").inspector.FrameView} FrameView */
/** @typedef {import("/static/protocol").inspector.LabelEditsEvent} LabelEditsEvent */
/** @typedef {import("/static/protocol").inspector.RebuildView} RebuildView */
/** @typedef {import("/static/protocol").inspector.StateView} StateView */
/** @typedef {import("/static/keys.js").Command} Command */
/** @typedef {import("./main.js").Page} Page */

export class LabelEdits {
  /** @param {Page} page */
  constructor(page) {
    this.page = page;
    const { socket, store } = page;
    /** @type {LabelEditsEvent | null} */
    this.shown = null;
    this.saved = ""; // where the new map was saved
    socket.on("label_edits", (event) => this.showEdits(event));
    socket.on("label_page", ({ address }) => this.openPage(address));
    socket.on("map_saved", ({ text }) => this.showMapSaved(text));
    window.addEventListener("focus", () => { if (store.isOpen) socket.send("get_label_edits"); }); // back from the annotator
  }

  /** @returns {Command[]} */
  commands() {
    const { socket, store } = this.page;
    return [
      { key: "o", group: "Labels", title: "Open the label of the selected or diagnosed element", run: () => socket.send("open_label", { element: store.state.element }) },
      { key: "n", group: "Labels", title: "Merge the duplicates of the diagnosis", run: () => socket.send("merge_duplicates", this.base) },
    ];
  }

  /** What this page has seen of the labels, for an edit. */
  get base() {
    return { base: this.shown?.seen ?? null };
  }

  get hasLabels() {
    return Boolean(this.shown?.workspace);
  }

  /* From the server */

  showRun() {
    this.saved = "";
  }

  /** @param {FrameView} frame */
  showFrame(frame) {
    const { implicated } = frame.card;
    const actions = [];
    if (implicated.length && this.hasLabels) actions.push(this.labelButton(null));
    if (frame.diagnosis === "twice in the map" && this.hasLabels) {
      actions.push(el("button", { class: "small", title: "Link their labels as one landmark", onclick: () => this.page.socket.send("merge_duplicates", this.base) },
        `Merge ${implicated.join(" and ")} `, el("kbd", { text: "N" })));
    }
    byId("why-actions").replaceChildren(...actions);
  }

  /** @param {StateView} state */
  showState({ element }) {
    this.fill(); // a comparison has no room for the bar
    byId("selected-actions").replaceChildren(...(element === null || !this.hasLabels ? [] : [
      this.labelButton(element),
      el("button", { class: "small", text: "Exclude from the map", title: "Edits the labels; can be undone", onclick: () => this.page.socket.send("exclude_element", { element, ...this.base }) }),
    ]));
  }

  /** @param {number | null} element */
  labelButton(element) {
    return el("button", { class: "small", title: "Opens semviz annotate in another tab, at a frame that shows it", onclick: () => this.page.socket.send("open_label", { element }) },
      "Open label ", el("kbd", { text: "O" }));
  }

  /** @param {string} address */
  openPage(address) {
    if (!window.open(address, "semviz-annotate")) this.page.notice(`The browser blocked a new tab. The label is at ${new URL(address, location.href)}`);
  }

  /** @param {string} text */
  showMapSaved(text) {
    this.saved = text;
    this.fill();
  }

  /** @param {LabelEditsEvent} event */
  showEdits(event) {
    this.shown = event;
    const { store } = this.page;
    if (store.hasFrame) {
      this.showFrame(store.frame);
      this.showState(store.state);
    }
    this.fill();
  }

  /* The bar */

  fill() {
    const { shown } = this;
    const parts = shown?.rebuild ? this.rebuildBar(shown.rebuild) : shown?.edits ? this.editsBar(shown) : [];
    byId("label-edits").hidden = !parts.length || this.page.store.state.comparing;
    byId("label-edits").replaceChildren(...parts);
  }

  /** @param {LabelEditsEvent} edits */
  editsBar({ edits, workspace, undoable }) {
    const { socket } = this.page;
    const count = edits === 1 ? "1 edit" : `${edits} edits`;
    return [
      el("span", { class: "text", text: `The labels of ${workspace} have ${count} newer than this map.` }),
      el("span", { class: "push" }),
      ...(undoable ? [button("Undo the last edit", () => socket.send("undo_label_edit", this.base))] : []),
      button("Rebuild map and run", () => socket.send("rebuild_map"), "primary"),
    ];
  }

  /** @param {RebuildView} rebuild */
  rebuildBar({ is_over: isOver, progress, run }) {
    const { socket } = this.page;
    const text = el("span", { class: "text", text: run ? `${run}: ${this.saved || progress}` : progress });
    const push = el("span", { class: "push" });
    if (!isOver) return [text, push, button("Stop", () => socket.send("stop_rebuild"))];
    const again = button("Rebuild", () => socket.send("rebuild_map"));
    if (!run) return [text, push, again];
    return [text, push, again, button("Save this map", () => socket.send("keep_map")), button("Compare", () => this.compare(run), "primary")];
  }

  /** Compares the new run (B) with the one it was rebuilt from (A).
   *
   * @param {string} run
   */
  compare(run) {
    const { run: shown, frame } = this.page.store;
    this.page.open(run, frame.index);
    this.page.socket.send("compare_runs", { base: shown.name, side_by_side: true });
  }
}

/**
 * @param {string} text
 * @param {() => void} onclick
 * @param {string} [kind]
 */
function button(text, onclick, kind = "") {
  return el("button", { class: `small ${kind}`, text, onclick });
}
