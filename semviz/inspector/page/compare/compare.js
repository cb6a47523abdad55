/* The run that is open (B) against another one (A): which one, and whether both are shown side by
 * side. Then the page keeps its own image, 3D pane and clock, which are of B. */

import { byId, el, fixed } from "/static/dom.js";
import { statusMark } from "/static/glyphs.js";
import { flag, known, yes } from "../address.js";
import { BaseImage } from "./base_image.js";
import { ErrorLines } from "./error_lines.js";
import { ChangedFrames } from "./frames.js";
import { Gates } from "./gates.js";
import { MapChanges } from "./map_changes.js";
import { Numbers } from "./numbers.js";
import { SameElement } from "./same_element.js";
import { ScatterPanel } from "./scatter.js";

const ALONE = "Only this run is served. Serve two to compare them: ";

export class Compare {
  constructor(page) {
    this.page = page;
    this.names = [];
    this.base = "";
    this.other = "";
    this.isOpen = false;
    this.same = new SameElement();
    this.frames = new ChangedFrames(page);
    const gates = new Gates(page);
    /** What is shown side by side: told of a comparison and of A's frames. */
    this.panels = [
      this.frames,
      new BaseImage(page, this.same),
      new ScatterPanel(page),
      new MapChanges(page, this.same),
      new Numbers((name) => gates.write(name)),
      gates,
      new ErrorLines(page),
    ];
    byId("compare").addEventListener("click", () => this.toggle());
    byId("compare-close").addEventListener("click", () => this.close());
    byId("swap").addEventListener("click", () => this.swap());
    byId("base").addEventListener("change", (event) => {
      this.ask(event.target.value, Boolean(event.target.value));
      event.target.blur();
    });
  }

  commands() {
    return [{ key: "c", group: "Page", title: "Compare with another run", run: () => this.toggle() }];
  }

  address() {
    return [{
      fields: { base: known(() => this.names.filter((name) => name !== this.page.run.name)), beside: flag() },
      get: () => ({ base: this.base || null, beside: yes(this.isOpen) }),
      set: ({ base, beside }) => this.ask(base ?? "", beside === "yes"),
    }];
  }

  /* From the server */

  showRuns(names) {
    this.names = names;
    this.fillChoice();
  }

  showRun({ name }) {
    if (this.base && name !== this.other) this.begin(this.base);
    this.other = name;
    this.fillChoice();
  }

  showState({ base, comparing }) {
    if (base !== this.base) this.begin(base);
    if (comparing !== this.isOpen) this.turn(comparing);
    byId("base").value = base;
  }

  /** Waits for another comparison, and says for how long. */
  begin(base) {
    this.base = base;
    document.body.classList.toggle("awaiting", Boolean(base));
    byId("compare-label").textContent = base ? `Against ${base}` : "Compare with…";
    clearInterval(this.waiting);
    const start = Date.now();
    const tell = () => { byId("compare-about").textContent = `reading ${base}, ${Math.round((Date.now() - start) / 1000)} s`; };
    byId("compare-about").textContent = "";
    if (base) this.waiting = setInterval(tell, 1000);
  }

  showComparison({ baseIds }) {
    clearInterval(this.waiting);
    byId("compare-about").textContent = "";
    document.body.classList.remove("awaiting");
    this.same.use(baseIds);
  }

  showRefusedComparison(why) {
    this.page.notice(why);
  }

  showFrame(frame) {
    byId("side-b").replaceChildren(...head("B", this.page.run.name, frame));
  }

  showBaseFrame({ frame }) {
    byId("side-a").replaceChildren(...head("A", this.base, frame));
  }

  /* What people ask for */

  ask(base, comparing) {
    this.page.socket.send({ verb: "compare", base, comparing });
  }

  toggle() {
    if (this.isOpen) this.close();
    else if (this.base) this.ask(this.base, true);
    else this.choose();
  }

  close() {
    this.ask(this.base, false);
  }

  /** A becomes B, and B becomes A. */
  swap() {
    const [base, other] = [this.base, this.page.run.name];
    this.page.open(base, this.page.frame.index);
    this.ask(other, true);
  }

  /** Asks which run to compare with. */
  choose() {
    const others = this.names.filter((name) => name !== this.page.run.name);
    const dialog = el("dialog", { class: "help ask choose-run" }, el("h2", { text: `Compare ${this.page.run.name} with` }));
    const choice = (name) => el("li", {}, el("button", { text: name, onclick: () => { dialog.close(); this.ask(name, true); } }));
    if (others.length) dialog.append(el("ul", {}, ...others.map(choice)));
    else dialog.append(el("p", {}, ALONE, el("code", { text: "semviz serve a.rrd b.rrd" })));
    dialog.addEventListener("close", () => dialog.remove());
    dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });
    document.body.append(dialog);
    dialog.showModal();
  }

  /* Showing */

  fillChoice() {
    const others = this.names.filter((name) => name !== this.page.run?.name);
    byId("base").replaceChildren(...others.map((name) => el("option", { text: name, value: name })), el("option", { text: "no other run", value: "" }));
    byId("base").value = this.base;
  }

  turn(isOpen) {
    this.isOpen = isOpen;
    document.body.classList.toggle("comparing", isOpen);
  }
}

/** The title of one side: the run, and what it made of the frame. */
function head(letter, name, frame) {
  const title = [el("b", { class: "letter", text: letter }), el("b", { class: "run-name", title: name, text: name })];
  if (!frame) return title;
  const error = frame.errorM === null ? (frame.status === "cannot" ? "no pose" : "no truth") : `${fixed(frame.errorM, 2)} m`;
  return [...title, statusMark(frame.status), el("span", { text: frame.status }), el("span", { class: "push" }),
    el("b", { class: frame.sureAndWrong ? "wrong" : "", text: error }), el("span", { class: "dim", text: frame.errorDeg === null ? "" : `${fixed(frame.errorDeg, 2)}°` })];
}
