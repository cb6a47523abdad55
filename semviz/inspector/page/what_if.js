/* What-if: what can be tried with this frame, what came of it, and what is kept of it. Nothing here
 * is on disk until somebody saves it as a run. */

import { byId, el, fixed } from "/static/dom.js";
import { statusMark } from "/static/glyphs.js";

const FOLLOWED = 12; // so many frames that are fixed or broken are named
const COMPILING = "; on a new machine, up to a minute of compiling first.";
const REST_MS = 300; // a frame that is passed over is not asked about

export class WhatIf {
  constructor(page) {
    this.page = page;
    this.shown = { trying: "", kept: [], result: null, sweep: null, said: "" };
    this.offers = [];
    this.note = "";
    byId("trying-keep").addEventListener("click", () => this.send("keep"));
    byId("trying-drop").addEventListener("click", () => this.send("drop"));
    this.parts = Object.fromEntries(["best", "answer", "kept", "offers"].map((name) => [name, el("section", { class: name })]));
    byId("what-if-body").replaceChildren(...Object.values(this.parts));
    const button = el("button", { class: "primary", onclick: () => this.tryBest() }, "Try what tells most", el("kbd", { text: "X" }));
    this.noteLine = el("p", { class: "dim" });
    this.parts.best.append(button, this.noteLine);
  }

  commands() {
    const whatIf = (key, title, run) => ({ key, title, run, group: "What if" });
    return [
      whatIf("x", "Try the change that tells most about this frame", () => this.tryBest()),
    ];
  }

  get isShown() {
    return !byId("what-if-body").hidden;
  }

  send(verb, values = {}) {
    this.page.socket.send({ verb, ...values });
  }

  tryBest() {
    this.page.right.show("what-if");
    this.showBestTried(`Looking for it${COMPILING}`);
    this.send("try best");
  }

  /* What the server says */

  showRun(run) {
    this.run = run;
  }

  showFrame(frame) {
    this.showBestTried("");
    clearTimeout(this.resting);
    if (frame.verdict !== "healthy") this.resting = setTimeout(() => this.send("advise"), REST_MS);
  }

  showState() {
    this.ask();
  }

  showTabs() {
    this.ask();
  }

  ask() {
    if (this.isShown && this.page.frame) this.send("offers");
  }

  showBestTried(note) {
    this.noteLine.textContent = note;
  }

  /** On the card that says why: what would mend the frame, tried already. */
  showAdvice({ position, text, before, after }) {
    if (!text || position !== this.page.frame.position) return;
    const row = el("div", { class: "advice" },
      el("span", { class: "dim", text: `${text[0].toUpperCase()}${text.slice(1)}` }),
      el("span", {}, error(before), el("span", { class: "dim", text: " → " }), el("b", { text: error(after) })),
      el("button", { class: "small", onclick: () => this.tryBest() }, "Try it live", el("kbd", { text: "X" })));
    document.querySelector("#why-body .advice")?.remove();
    document.querySelector("#why-body dl").after(row);
  }

  showOffers(groups) {
    this.parts.offers.replaceChildren(...groups.flatMap(({ title, offers }) => [
      el("h4", { text: title }),
      el("div", { class: "choices" }, ...offers.map((offer) => this.offer(offer))),
    ]));
  }

  showWhatIf(shown) {
    this.shown = shown;
    this.showBar();
    this.parts.answer.replaceChildren(...this.answer());
    this.parts.kept.replaceChildren(...this.kept());
  }

  showBar() {
    const { trying, result } = this.shown;
    byId("trying").hidden = !trying;
    const errors = result?.after ? `: ${change(result)}` : "";
    byId("trying-text").textContent = `Trying ${trying}${errors}. Nothing is changed.`;
  }

  /* The answer */

  answer() {
    const { trying, kept, result, isSolving } = this.shown;
    if (!trying && !kept.length) return [];
    const title = trying ? `Trying ${trying}` : `With what is kept (${kept.length})`;
    return [el("h3", { text: title }), ...(isSolving ? [el("p", { class: "dim", text: `Solving this frame${COMPILING}` })] : this.numbers(result))];
  }

  numbers({ failure, matters, before, after, reason, ms }) {
    if (failure) return [el("p", { class: "wrong", text: failure })];
    if (!matters) return [el("p", { class: "dim", text: "It changes nothing in this frame." })];
    const row = (label, from, to) => [el("dt", { text: label }), el("dd", { text: `${from} → ${to}` })];
    const fitting = ({ fitting: number, seen }) => `${number} of ${seen}`;
    const angle = ({ errorDeg }) => (errorDeg === null ? "none" : `${fixed(errorDeg, 2)}°`);
    return [
      el("p", { class: "change" }, statusMark(before.status), error(before), el("span", { class: "dim", text: "→" }), statusMark(after.status), el("b", { text: error(after) }),
        el("small", { class: "dim", text: `in ${fixed(ms, 0)} ms` })),
      el("p", { class: "sentence", text: reason }),
      el("dl", {}, ...row("Elements that fit", fitting(before), fitting(after)), ...row("Rotation off by", angle(before), angle(after))),
    ];
  }

  /* What is kept */

  kept() {
    const { kept, file, sweep } = this.shown;
    if (!kept.length) return [];
    const chips = kept.map(({ text }, number) => el("li", { class: "chip" }, text,
      el("button", { class: "small", title: "Keep it no longer", "aria-label": `Keep ${text} no longer`, text: "×", onclick: () => this.send("forget", { number }) })));
    return [
      el("h4", { text: "Kept on this page" }),
      el("ul", { class: "choices" }, ...chips),
      el("div", { class: "choices" },
        el("button", { class: "small", text: "Try on all frames", title: "All in which they matter", onclick: () => this.send("try all") }),
        el("button", { class: "small", text: "Copy", title: "As JSON", onclick: () => navigator.clipboard.writeText(file) }),
        el("a", { class: "button small", text: "Export", title: "As a JSON file", download: `${this.run.name}-changes.json`, href: `data:application/json,${encodeURIComponent(file)}` })),
      ...(sweep ? this.sweep(sweep) : []),
    ];
  }

  sweep({ isOver, canSave, text, changed }) {
    if (!isOver) return [el("div", { class: "choices" }, el("span", { class: "dim", text: `On all frames: ${text}` }), el("button", { class: "small", text: "Stop", onclick: () => this.send("stop") }))];
    const parts = [el("p", { class: "sentence", text })];
    if (changed.length) parts.push(el("div", { class: "choices" }, ...changed.slice(0, FOLLOWED).map((one) => this.frame(one)), changed.length > FOLLOWED ? `and ${changed.length - FOLLOWED} more` : ""));
    if (canSave) parts.push(el("button", { class: "small", text: "Save as run", title: "A new .rrd beside this one, which 'semviz compare' reads", onclick: () => this.send("save") }));
    if (this.shown.said) parts.push(el("p", { class: "path", text: this.shown.said }));
    return parts;
  }

  frame({ index, change: became }) {
    const position = this.run.frames.findIndex((row) => row.index === index);
    return el("button", { class: "small", title: `Go to frame ${index}: ${became}`, text: `${became === "fixed" ? "▲" : "▼"} ${index}`, onclick: () => this.page.go(position) });
  }

  /* What can be tried */

  offer({ text, change: wanted, choice, fields }) {
    const attempt = (values = {}) => this.send("try", { change: { ...wanted, ...values } });
    if (choice) {
      const options = choice.options.map(({ value, text: name }) => el("option", { value, text: name, selected: value === wanted[choice.name] ? "" : null }));
      const box = el("select", { "aria-label": text, onchange: () => attempt({ [choice.name]: choice.options[box.selectedIndex].value }) }, ...options);
      return el("label", {}, text, box);
    }
    if (!fields) return el("button", { class: "small", text, onclick: () => attempt() });
    const inputs = fields.map(({ name, label, value, unit }) => [el("input", { type: "number", step: "any", name, value, "aria-label": `${text} ${label}` }), [unit, label].filter(Boolean).join(" ")]);
    const values = () => Object.fromEntries(inputs.map(([input]) => [input.name, input.valueAsNumber]));
    const go = (event) => { event.preventDefault(); attempt(values()); };
    return el("form", { onsubmit: go }, text, ...inputs.flat(), el("button", { class: "small", text: "Try" }));
  }
}

function error({ errorM, status }) {
  if (errorM !== null) return `${fixed(errorM, 2)} m`;
  return status === "cannot" ? "no pose" : status;
}

function change({ before, after, matters }) {
  return matters ? `${error(before)} → ${error(after)}` : "nothing here";
}
