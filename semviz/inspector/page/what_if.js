// @ts-check
/* The tab "What if": changes, their results, and kept changes. Nothing is stored until it is saved
 * as a run. */

import { byId, el, fixed } from "/static/dom.js";
import { statusMark } from "/static/glyphs.js";

/** @typedef {import("/static/protocol").inspector.SolutionView} SolutionView */
/** @typedef {import("/static/protocol").inspector.ChangedFrame} ChangedFrame */
/** @typedef {import("/static/protocol").inspector.ChoiceField} ChoiceField */
/** @typedef {import("/static/protocol").inspector.FrameView} FrameView */
/** @typedef {import("/static/protocol").inspector.SuggestionEvent} SuggestionEvent */
/** @typedef {import("/static/protocol").inspector.SweepView} SweepView */
/** @typedef {import("/static/protocol").inspector.WhatIfEvent} WhatIfEvent */
/** @typedef {import("/static/protocol").inspector.WhatIfGroup} WhatIfGroup */
/** @typedef {import("/static/protocol").inspector.WhatIfOption} WhatIfOption */
/** @typedef {import("/static/protocol").inspector.WhatIfResult} WhatIfResult */
/** @typedef {import("/static/keys.js").Command} Command */
/** @typedef {import("./main.js").Page} Page */

const MAX_LISTED = 12; // fixed and broken frames listed
const COMPILING = "; on a new machine it compiles first, up to a minute.";
const DELAY_MS = 300; // skipped frames get no suggestion

export class WhatIf {
  /** @param {Page} page */
  constructor(page) {
    this.page = page;
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.timer = undefined;
    const { socket } = page;
    socket.on("what_if", (event) => this.showWhatIf(event));
    socket.on("what_if_options", ({ groups }) => this.showOptions(groups));
    socket.on("suggestion", (event) => this.showSuggestion(event));
    socket.on("suggestion_status", ({ text }) => this.showStatus(text));
    byId("what-if-keep").addEventListener("click", () => socket.send("keep_what_if"));
    byId("what-if-drop").addEventListener("click", () => socket.send("drop_what_if"));
    /** @param {string} name */
    const section = (name) => el("section", { class: name });
    this.parts = { best: section("best"), answer: section("answer"), kept: section("kept"), options: section("options") };
    byId("what-if-body").replaceChildren(...Object.values(this.parts));
    const button = el("button", { class: "primary", onclick: () => this.solveSuggestion() }, "Solve with the suggestion", el("kbd", { text: "X" }));
    this.statusLine = el("p", { class: "dim" });
    this.parts.best.append(button, this.statusLine);
  }

  /** @returns {Command[]} */
  commands() {
    const title = "Solve with the suggested change";
    return [{ key: "x", title, run: () => this.solveSuggestion(), group: "What if" }];
  }

  get isShown() {
    return !byId("what-if-body").hidden;
  }

  solveSuggestion() {
    this.page.right.show("what-if");
    this.showStatus(`Searching for a suggestion${COMPILING}`);
    this.page.socket.send("solve_suggestion");
  }

  /* From the server */

  /** @param {FrameView} frame */
  showFrame(frame) {
    this.showStatus("");
    clearTimeout(this.timer);
    if (frame.diagnosis !== "healthy") this.timer = setTimeout(() => this.page.socket.send("suggest_what_if"), DELAY_MS);
  }

  showState() {
    this.requestOptions();
  }

  showTabs() {
    this.requestOptions();
  }

  requestOptions() {
    if (this.isShown && this.page.store.hasFrame) this.page.socket.send("get_what_if_options");
  }

  /** Why there is no suggestion, or that the search is running.
   *
   * @param {string} text
   */
  showStatus(text) {
    this.statusLine.textContent = text;
  }

  /** Shows the suggested change on the tab "Why".
   *
   * @param {SuggestionEvent} event
   */
  showSuggestion({ position, text, before, after }) {
    if (position !== this.page.store.position) return;
    const row = el("div", { class: "suggestion" },
      el("span", { class: "dim", text: `${text[0].toUpperCase()}${text.slice(1)}` }),
      el("span", {}, error(before), el("span", { class: "dim", text: " → " }), el("b", { text: error(after) })),
      el("button", { class: "small", onclick: () => this.solveSuggestion() }, "Show", el("kbd", { text: "X" })));
    document.querySelector("#why-body .suggestion")?.remove();
    byId("why-actions").before(row);
  }

  /** @param {WhatIfGroup[]} groups */
  showOptions(groups) {
    this.parts.options.replaceChildren(...groups.flatMap(({ title, options }) => [
      el("h4", { text: title }),
      el("div", { class: "choices" }, ...options.map((option) => this.option(option))),
    ]));
  }

  /** @param {WhatIfEvent} event */
  showWhatIf(event) {
    this.showBar(event);
    this.parts.answer.replaceChildren(...this.answer(event));
    this.parts.kept.replaceChildren(...this.kept(event));
  }

  /** @param {WhatIfEvent} event */
  showBar({ change: solved, result }) {
    byId("what-if-bar").hidden = !solved;
    const errors = result ? `: ${change(result)}` : "";
    byId("what-if-text").textContent = `What if: solved ${solved}${errors}. Nothing is saved.`;
  }

  /* The result */

  /** @param {WhatIfEvent} event */
  answer({ change: solved, kept, result, failure, solving }) {
    if (!solved && !kept.length) return [];
    const title = el("h3", { text: solved ? `Solved ${solved}` : `With the kept changes (${kept.length})` });
    if (solving) return [title, el("p", { class: "dim", text: `Solving this frame${COMPILING}` })];
    if (failure) return [title, el("p", { class: "wrong", text: failure })];
    return result ? [title, ...this.numbers(result)] : [title];
  }

  /** @param {WhatIfResult} result */
  numbers({ has_effect: hasEffect, before, after, reason, ms }) {
    if (!hasEffect) return [el("p", { class: "dim", text: "No effect in this frame." })];
    /** @type {(label: string, from: string, to: string) => HTMLElement[]} */
    const row = (label, from, to) => [el("dt", { text: label }), el("dd", { text: `${from} → ${to}` })];
    /** @param {SolutionView} answer */
    const inliers = ({ inliers: number, detections }) => `${number} of ${detections}`;
    /** @param {SolutionView} answer */
    const angle = ({ error_deg: errorDeg }) => (errorDeg === null ? "none" : `${fixed(errorDeg, 2)}°`);
    return [
      el("p", { class: "change" }, statusMark(before.status), error(before), el("span", { class: "dim", text: "→" }), statusMark(after.status), el("b", { text: error(after) }),
        el("small", { class: "dim", text: `in ${fixed(ms, 0)} ms` })),
      el("p", { class: "sentence", text: reason }),
      el("dl", {}, ...row("Inliers", inliers(before), inliers(after)), ...row("Rotation error", angle(before), angle(after))),
    ];
  }

  /* Kept changes */

  /** @param {WhatIfEvent} event */
  kept({ kept, file, sweep, saved }) {
    if (!kept.length) return [];
    const { socket, store } = this.page;
    const chips = kept.map((text, number) => el("li", { class: "chip" }, text,
      el("button", { class: "small", title: "Drop this change", "aria-label": `Drop: ${text}`, text: "×", onclick: () => socket.send("forget_what_if", { number }) })));
    return [
      el("h4", { text: "Kept changes" }),
      el("ul", { class: "choices" }, ...chips),
      el("div", { class: "choices" },
        el("button", { class: "small", text: "Solve all frames", title: "Solves all frames that the changes affect", onclick: () => socket.send("sweep_what_if") }),
        el("button", { class: "small", text: "Copy", title: "As JSON", onclick: () => navigator.clipboard.writeText(file) }),
        el("a", { class: "button small", text: "Export", title: "As a JSON file", download: `${store.run.name}-changes.json`, href: `data:application/json,${encodeURIComponent(file)}` })),
      ...(sweep ? this.sweep(sweep, saved) : []),
    ];
  }

  /**
   * @param {SweepView} sweep
   * @param {string} saved
   */
  sweep({ is_over: isOver, can_save: canSave, text, changed }, saved) {
    const { socket } = this.page;
    if (!isOver) return [el("div", { class: "choices" }, el("span", { class: "dim", text: `All frames: ${text}` }), el("button", { class: "small", text: "Stop", onclick: () => socket.send("stop_sweep") }))];
    /** @type {HTMLElement[]} */
    const parts = [el("p", { class: "sentence", text })];
    if (changed.length) parts.push(el("div", { class: "choices" }, ...changed.slice(0, MAX_LISTED).map((frame) => this.frame(frame)), changed.length > MAX_LISTED ? `and ${changed.length - MAX_LISTED} more` : ""));
    if (canSave) parts.push(el("button", { class: "small", text: "Save as run", title: "A new .rrd file beside this run, for semviz compare", onclick: () => socket.send("save_sweep") }));
    if (saved) parts.push(el("p", { class: "path", text: saved }));
    return parts;
  }

  /** @param {ChangedFrame} frame */
  frame({ index, change: outcome }) {
    const position = this.page.store.run.frames.findIndex((row) => row.index === index);
    return el("button", { class: "small", title: `Go to frame ${index}: ${outcome}`, text: `${outcome === "fixed" ? "▲" : "▼"} ${index}`, onclick: () => this.page.go(position) });
  }

  /* Options */

  /**
   * @param {WhatIfOption["change"]} change
   * @param {WhatIfOption["change"]} values that replace its own
   */
  solve(change, values = {}) {
    this.page.socket.send("solve_what_if", { change: { ...change, ...values } });
  }

  /** @param {WhatIfOption} option */
  option(option) {
    const { text, change: initial, choice, fields } = option;
    if (choice) return this.choice(option, choice);
    if (!fields.length) return el("button", { class: "small", text, onclick: () => this.solve(initial) });
    const inputs = fields.map(({ name, label, value }) => el("input", { type: "number", step: "any", name, value, "aria-label": `${text} ${label}` }));
    const parts = fields.flatMap(({ unit, label }, at) => [inputs[at], [unit, label].filter(Boolean).join(" ")]);
    const values = () => Object.fromEntries(inputs.map((input) => [input.name, input.valueAsNumber]));
    /** @param {Event} event */
    const solve = (event) => {
      event.preventDefault();
      this.solve(initial, values());
    };
    return el("form", { onsubmit: solve }, text, ...parts, el("button", { class: "small", text: "Solve" }));
  }

  /**
   * @param {WhatIfOption} option
   * @param {ChoiceField} choice
   */
  choice({ text, change: initial }, { name, options }) {
    const shown = options.map((option) => el("option", { value: option.value, text: option.text, selected: option.value === initial[name] ? "" : null }));
    const box = el("select", { "aria-label": text, onchange: () => this.solve(initial, { [name]: options[box.selectedIndex].value }) }, ...shown);
    return el("label", {}, text, box);
  }
}

/** @param {SolutionView} answer */
function error({ error_m: errorM, status }) {
  if (errorM !== null) return `${fixed(errorM, 2)} m`;
  return status === "cannot" ? "no pose" : status;
}

/** @param {WhatIfResult} result */
function change({ before, after, has_effect: hasEffect }) {
  return hasEffect ? `${error(before)} → ${error(after)}` : "no effect here";
}
