// @ts-check
// Frames that two people label blind: who, how far, how they agree, and which are to be merged.
/** @import {annotator} from "/static/protocol" */
/** @import {Child} from "/static/dom.js" */
/** @import {Page} from "../main.js" */
/** @import {State} from "../state.js" */
import { byId, el, svg } from "/static/dom.js";
import { counted, rangeOf, spaced } from "../values.js";
import { row } from "../panels/widgets.js";

const NEEDED = 20; // pairs, before figures say something
const BARS = 24;

export class Shares {
  /**
   * @param {State} state
   * @param {Page} page
   */
  constructor(state, page) {
    this.state = state;
    this.page = page;
    /** @type {annotator.ShareView[]} */
    this.known = [];
    page.socket.on("share_opened", ({ address }) => location.assign(address));
    byId("team-twice", HTMLFormElement).addEventListener("submit", (event) => this.#assign(event));
  }

  /** Frames to be merged. */
  get ready() {
    return this.known.flatMap(({ ready }) => ready).sort((a, b) => a - b);
  }

  /** Frames to be merged, those whose labels differ most first. */
  get worstFirst() {
    return this.known.flatMap(({ ready, worst_px: px }) => ready.map((frame, at) => ({ frame, px: px[at] }))).sort((a, b) => b.px - a.px).map(({ frame }) => frame);
  }

  /** Frames that a person labels blind.
   *
   * @param {string} name
   */
  of(name) {
    return this.known.filter(({ people }) => people.includes(name)).flatMap(({ frames }) => frames);
  }

  /** Goes to where one labels one's own frames. */
  open() {
    this.page.ask("open_share", {});
  }

  /** @param {SubmitEvent} event */
  #assign(event) {
    event.preventDefault();
    const field = byId("twice-frames", HTMLInputElement);
    const frames = rangeOf(field.value);
    const percent = Number(byId("twice-percent", HTMLInputElement).value);
    const people = /** @type {[string, string]} */ (["twice-first", "twice-second"].map((id) => byId(id, HTMLSelectElement).value));
    if (!frames || !(percent > 0 && percent <= 100) || people[0] === people[1]) {
      this.page.notify(`A share in percent, frames as ${this.state.wholeDrive}, and two different people.`, "wrong");
      return;
    }
    if (this.page.ask("assign_share", { frames, percent, people })) field.value = "";
    if (document.activeElement instanceof HTMLElement) document.activeElement.blur(); // keys are commands again
  }

  /** What the list shows of them: each share, then its frames that are to be merged.
   *
   * @returns {Child[]}
   */
  rows() {
    if (!this.known.length) return [el("p", { class: "dim team-text", text: "No frames are labelled twice. Shift T lets two people label a share of them, neither seeing the other's labels." })];
    return this.known.flatMap((share) => [
      this.#head(share), ...this.#figures(share),
      ...share.ready.map((frame) => row({ chosen: frame === this.state.frame, onclick: () => this.page.go(frame) },
        el("b", { class: "team-frame", text: frame }), el("span", { class: "fill", text: "both have reviewed it" }), el("span", { class: "dim", text: "merge" }))),
    ]);
  }

  /** @param {annotator.ShareView} share */
  #head({ number, people, frames, reviewed, merged }) {
    const { author, role } = this.state.workspace;
    const said = people.map((name, at) => `${name} ${reviewed[at]}`).join(", ");
    return el("div", { class: "share-head" },
      el("b", { text: people.join(" and ") }), el("span", { class: "dim fill", text: `${counted(frames.length, "frame")} blind; reviewed: ${said}; ${merged} merged` }),
      people.includes(author) ? el("button", { class: "small", onclick: () => this.open() }, "Label mine") : null,
      role === "review" ? el("button", { class: "small", title: "Label them as all others again; both files stay", onclick: () => this.page.ask("end_share", { number }) }, "End") : null);
  }

  /** @param {annotator.ShareView} share */
  #figures({ people, agreement, ready, worst_px: px }) {
    const worst = ready[px.indexOf(Math.max(...px))];
    if (!agreement) return [];
    if (agreement.labels < NEEDED) return [el("p", { class: "dim team-text", text: `Agreement: ${counted(agreement.labels, "pair")} of labels, ${NEEDED} needed.` })];
    const { both, elements, missed, other_class: other, labels, same_ends: ends, identical } = agreement;
    const share = Math.round((100 * both) / Math.max(1, elements));
    const fact = (/** @type {string} */ what, /** @type {string} */ is) => el("p", { class: "share-fact" }, el("span", { class: "dim", text: what }), el("b", { class: "push", text: is }));
    return [
      el("div", { class: "share-plots" }, plot("Poles, angle", agreement.pole_angle_deg, 1, "°"), plot("Poles, across", agreement.pole_px, 6, " px"), plot("Signs, middle", agreement.sign_px, 6, " px")),
      el("div", { class: "share-facts" },
        fact("Seen by both", `${spaced(both)} of ${spaced(elements)}, ${share} %`),
        fact("Missed", people.map((name, at) => `${name} ${missed[at]}`).join(", ")),
        fact("Same class", `${spaced(both - other)} of ${spaced(both)}`),
        fact("Same ends hidden or cut", `${spaced(ends)} of ${spaced(labels)}`),
        fact("At the very same place", `${spaced(identical)} of ${spaced(labels)}`),
        worst !== undefined ? fact("Worst to be merged", `frame ${worst}`) : null),
    ];
  }
}

/** A histogram with its median; what is beyond `most` is in the last bar.
 *
 * @param {string} title
 * @param {number[]} values ascending
 * @param {number} most
 * @param {string} unit
 */
function plot(title, values, most, unit) {
  const counts = Array.from({ length: BARS }, () => 0);
  for (const value of values) counts[Math.min(BARS - 1, Math.floor((value / most) * BARS))] += 1;
  const highest = Math.max(1, ...counts);
  const median = values.length ? `median ${values[Math.floor(values.length / 2)].toFixed(2)}${unit}` : "none";
  return el("div", { class: "share-plot", title: `${counted(values.length, "pair")}; the last bar is ${most}${unit} and more` },
    el("p", {}, el("b", { text: title }), el("span", { class: "push", text: median })),
    svg("svg", { viewBox: `0 0 ${BARS} 20`, preserveAspectRatio: "none" },
      ...counts.map((count, at) => svg("rect", { class: at === BARS - 1 ? "beyond" : "pair", x: at + 0.05, y: 20 - (19 * count) / highest, width: 0.9, height: (19 * count) / highest }))),
    el("p", { class: "dim" }, "0", el("span", { class: "push", text: `${most}${unit}` })));
}
