// @ts-check
// The top bar: frame, review progress, undo, and the last saved operation.
/** @import {Keys} from "/static/keys.js" */
/** @import {Page} from "../main.js" */
/** @import {State} from "../state.js" */
/** @import {Entry} from "../values.js" */
import { byId, el, svg } from "/static/dom.js";
import { neighbour } from "../commands.js";
import { spaced } from "../values.js";
import { RenderCache, badge } from "./widgets.js";

const CHECKED = {
  checking: "The label file is being checked …",
  sound: "The label file was checked: log and labels are as they were written",
  damaged: "The label file is damaged",
  missing: "The label file is not at its place",
};

export class TopBar {
  /**
   * @param {State} state
   * @param {Keys} keys
   * @param {Pick<Page, "submit" | "help" | "go">} page
   */
  constructor(state, keys, page) {
    this.state = state;
    this.keys = keys;
    this.cache = new RenderCache(state);
    byId("undo").addEventListener("click", () => page.submit({ kind: "undo" }));
    byId("redo").addEventListener("click", () => page.submit({ kind: "redo" }));
    byId("help").addEventListener("click", () => page.help());
    byId("step").addEventListener("click", (event) => {
      const box = byId("step").getBoundingClientRect();
      page.go(neighbour(state, event.clientX - box.left < box.width / 2 ? -1 : 1));
    });
  }

  show() {
    const { workspace, labels, frame, order } = this.state;
    const { name, source, author, role } = workspace;
    this.cache.show("workspace", workspace, () => [name, el("span", { class: "dim", text: ` ${source}` })]);
    this.cache.show("author", [author, role], () => [role === "look" ? `${author}, looking` : author]);
    this.cache.show("step", [frame, order.length], () => this.#step());
    const done = labels.frames.filter(({ state }) => state.startsWith("reviewed")).length;
    this.cache.show("reviewed", [done, order.length], () => progress(done, order.length));
    this.showSaved();
    this.#labelFile();
    byId("undo", HTMLButtonElement).disabled = !labels.can_undo;
    byId("redo", HTMLButtonElement).disabled = !labels.can_redo;
  }

  /** What is on disk. */
  showSaved() {
    const { pending, connected, trouble, labels, labelFile, onDisk, question } = this.state;
    const node = byId("saved");
    const isOnDisk = (/** @type {Entry} */ { request }) => request === onDisk?.request;
    const unsaved = pending.filter((entry) => !isOnDisk(entry)).length;
    const operation = onDisk && pending.some(isOnDisk) ? onDisk.operation : labels.operation;
    const [kind, text] = labelFile.text
      ? ["wrong", `Not saved, ${pending.length} kept here`]
      : trouble
        ? ["wrong", `${trouble.replace(/\.$/, "")}, ${pending.length} kept here`]
        : !connected
          ? ["offline", `Offline, ${pending.length} kept here`]
          : unsaved && question
            ? ["offline", "Waits for your answer"]
            : unsaved
              ? ["saving", `Saving ${unsaved} …`]
              : ["saved", `Saved operation ${spaced(operation)}`];
    node.className = `chip ${kind}`;
    node.textContent = text;
    node.title = connected ? CHECKED[labelFile.state] : "The server does not answer. Labels are shown as they were known last; edits are kept in this browser, and saved when it is back.";
  }

  /** A bar that stays as long as the label file takes no edits. */
  #labelFile() {
    const { pending, labelFile } = this.state;
    const bar = byId("label-file");
    bar.hidden = !labelFile.text;
    const edits = `${pending.length} ${pending.length === 1 ? "edit is" : "edits are"} kept in this page.`;
    if (!bar.hidden) bar.textContent = `${labelFile.text.replace(/\.?$/, ".")} ${edits}`;
  }

  #step() {
    const { frame, order } = this.state;
    return [
      badge(this.keys, ","),
      el("b", { text: `Frame ${frame}` }),
      el("span", { class: "dim", text: `${order.indexOf(frame ?? -1) + 1} of ${order.length}` }),
      badge(this.keys, "."),
    ];
  }
}

/**
 * @param {number} done
 * @param {number} all
 */
function progress(done, all) {
  const bar = svg("svg", { class: "bar", viewBox: "0 0 100 6", preserveAspectRatio: "none" },
    svg("rect", { class: "track", width: 100, height: 6 }),
    svg("rect", { class: "done", width: (100 * done) / all, height: 6 }));
  return ["Reviewed ", bar, el("b", { text: ` ${done}` }), ` / ${all}`];
}
