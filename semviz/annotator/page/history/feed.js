// @ts-check
// What everybody did just now: the last operations, newest first, each with its frame.
/** @import {annotator} from "/static/protocol" */
/** @import {Page} from "../main.js" */
import { el } from "/static/dom.js";
import { initials } from "../team/people.js";
import { spaced } from "../values.js";
import { RenderCache, row } from "../panels/widgets.js";

const MOST = 50;

export class Feed {
  /** @param {Page} page */
  constructor(page) {
    this.page = page;
    this.cache = new RenderCache(page.state);
  }

  show() {
    const { labels, workspace } = this.page.state;
    this.cache.show("team-feed", [labels.operation, labels.history.length, workspace.author], () => labels.history.length
      ? labels.history.slice(0, MOST).map((operation) => this.#row(operation))
      : [el("p", { class: "dim team-text", text: "Nobody did anything yet." })]);
  }

  /** @param {annotator.OperationView} operation */
  #row({ number, text, author, time, frame }) {
    const asksMe = text.includes(`@${this.page.state.workspace.author}:`);
    const when = new Date(time).toLocaleTimeString([], { hour: "2-digit", minute: "2-digit", second: "2-digit" });
    return row({ title: frame === null ? text : `${text}; click: frame ${frame}`, onclick: () => this.page.go(frame) },
      el("span", { class: "dim", title: time, text: when }), el("span", { class: "initials", title: author, text: initials(author) }),
      el("span", { class: "fill", text }),
      asksMe ? el("span", {}, el("span", { class: "warning", text: "◆ " }), "asks you") : el("span", { class: "dim", text: `operation ${spaced(number)}` }));
  }
}
