// The bar at the top: which frame, how far, undo, and what is on disk.
import { byId, el, svg } from "/static/dom.js";
import { neighbour } from "./commands.js";
import { spaced } from "./state.js";
import { Kept, badge } from "./widgets.js";

export class TopBar {
  constructor(state, keys, actions) {
    this.state = state;
    this.keys = keys;
    this.kept = new Kept(state);
    const press = (id, run) => byId(id).addEventListener("click", run);
    press("undo", () => actions.submit({ kind: "undo" }));
    press("redo", () => actions.submit({ kind: "redo" }));
    press("help", actions.help);
    press("step", (event) => {
      const box = event.currentTarget.getBoundingClientRect();
      actions.go(neighbour(state, event.clientX - box.left < box.width / 2 ? -1 : 1));
    });
  }

  show() {
    const { hello, labels, frame, order } = this.state;
    const { workspace, source, author } = hello;
    this.kept.show("workspace", hello, () => [workspace, el("span", { class: "dim", text: ` ${source}` })]);
    this.kept.show("author", author, () => [author]);
    this.kept.show("step", [frame, order.length], () => this.#step());
    const done = labels.frames.filter(({ state }) => state.startsWith("reviewed")).length;
    this.kept.show("reviewed", [done, order.length], () => progress(done, order.length));
    this.#saved();
    byId("undo").disabled = !labels.can_undo;
    byId("redo").disabled = !labels.can_redo;
  }

  #saved() {
    const { pending, connected, trouble, labels, onDisk } = this.state;
    const node = byId("saved");
    const isOnDisk = ({ request }) => request === onDisk?.request;
    const unsaved = pending.filter((one) => !isOnDisk(one)).length;
    const operation = pending.some(isOnDisk) ? onDisk.operation : labels.operation;
    const [kind, text] = trouble
      ? ["wrong", `${trouble.replace(/\.$/, "")}, ${pending.length} kept here`]
      : !connected
        ? ["offline", `Offline, ${pending.length} kept here`]
        : unsaved
          ? ["saving", `Saving ${unsaved} …`]
          : ["saved", `Saved operation ${spaced(operation)}`];
    node.className = `chip ${kind}`;
    node.textContent = text;
  }

  #step() {
    const { frame, order } = this.state;
    return [
      badge(this.keys, ","),
      el("b", { text: `Frame ${frame}` }),
      el("span", { class: "dim", text: `${order.indexOf(frame) + 1} of ${order.length}` }),
      badge(this.keys, "."),
    ];
  }
}

function progress(done, all) {
  const bar = svg("svg", { class: "bar", viewBox: "0 0 100 6", preserveAspectRatio: "none" },
    svg("rect", { class: "track", width: 100, height: 6 }),
    svg("rect", { class: "done", width: (100 * done) / all, height: 6 }));
  return ["Reviewed ", bar, el("b", { text: ` ${done}` }), ` / ${all}`];
}
