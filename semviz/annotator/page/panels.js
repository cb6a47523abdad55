// Around the images: classes, elements, card, hints and frames. Rebuilt from the state.
import { byId, el, fixed, svg } from "/static/dom.js";
import { classGlyph } from "/static/glyphs.js";
import { Aids } from "./aids.js";
import { Conflict } from "./conflict.js";
import { editing } from "./commands.js";
import { hints } from "./hints.js";
import { Jumps } from "./jumps.js";
import { SIDES, shownScore } from "./state.js";
import { Strip } from "./strip.js";
import { TopBar } from "./topbar.js";
import { Kept, badge, capital, header, row } from "./widgets.js";

const TOLD_MS = 6000;

export class Panels {
  /** `more`: further parts of the page, each with `show()`. */
  constructor(state, images, keys, actions, more) {
    this.state = state;
    this.images = images;
    this.keys = keys;
    this.actions = actions;
    this.edit = editing(state, actions);
    this.parts = [new TopBar(state, keys, actions), new Aids(state, keys), new Jumps(state, keys, actions), new Strip(state, actions), new Conflict(state, actions), ...more];
    this.timer = 0;
    this.kept = new Kept(state);
    state.onChange(() => this.#queue());
  }

  /** What never changes after the first greeting. */
  start() {
    const { workspace, images } = this.state.hello;
    document.title = `${workspace} · semviz annotate`;
    for (const side of SIDES) {
      const size = images[side] ? `${images[side].width} × ${images[side].height}` : "none";
      byId(`${side}-image`).querySelector(".about").textContent = size;
    }
  }

  /** Says something for a few seconds, below the images. */
  tell(text, kind = "") {
    if (!text) return;
    const message = byId("message");
    message.textContent = text;
    message.className = `toast ${kind}`;
    message.hidden = false;
    clearTimeout(this.timer);
    this.timer = setTimeout(() => { message.hidden = true; }, TOLD_MS);
  }

  #queue() {
    if (this.queued) return;
    this.queued = true;
    requestAnimationFrame(() => {
      this.queued = false;
      if (this.state.labels) this.#show();
    });
  }

  #show() {
    const { state } = this;
    byId("scene").hidden = !state.aids.map; // a hidden scene costs no time
    this.parts.forEach((part) => part.show());
    this.kept.show("classes", [state.classId, state.labels.counts], () => this.#classes());
    this.kept.show("elements", [state.elements, state.offers, state.nearby, state.selected], () => this.#elements());
    this.kept.show("card", [state.selected, state.selectedElement, state.look, Boolean(state.drawing)], () => this.#card());
    this.kept.show("hints", hints(state), () => hints(state).map((one) => hintItem(one, this.keys)));
    this.#status();
  }

  #glyph(one) {
    return classGlyph(one, this.state.colorOf(one));
  }

  #classes() {
    const { hello, classId, labels } = this.state;
    return hello.classes.map((one, place) =>
      row({ chosen: one.id === classId, onclick: () => this.edit.chooseClass(one.id) },
        place < 9 ? badge(this.keys, `${place + 1}`) : null, this.#glyph(one),
        el("span", { class: "fill", text: capital(one.name) }),
        el("span", { class: "dim", text: labels.counts[one.id] ?? 0 })));
  }

  /** Takes an element in hand; with Ctrl beside the one that was, to be linked. */
  #choose(id, event) {
    const { selected } = this.state;
    this.actions.select(id);
    const isSecond = (event.ctrlKey || event.metaKey) && selected && selected.element !== id;
    if (isSecond) this.state.set({ selected: { ...this.state.selected, also: selected.element } });
  }

  #elements() {
    const { state } = this;
    const line = (one, about) =>
      row({ chosen: one.id === state.selected?.element, onclick: (event) => this.#choose(one.id, event) },
        this.#glyph(state.classOf(one.class)), el("span", { class: "fill", text: one.name }), ...about);
    const seen = state.elements.map((one) => {
      const sides = SIDES.filter((side) => one.observations[side]);
      const lacks = state.hasRight && sides.length < 2;
      const offer = state.offers.find(({ id }) => id === one.id);
      return line(one, [
        offer ? scoreBar(offer) : null,
        el("span", { class: lacks ? "warning" : "dim", text: lacks ? `${sides[0]} only` : "left, right" }),
        el("span", { class: "views dim", text: one.views ? `${one.views}` : "" })]);
    });
    const offered = state.expected.map((one) => line(one, [scoreBar(one), el("span", { class: "views dim", text: about(one) })]));
    const near = state.nearby.map((one) => line(one, [el("span", { class: "faint", text: whence(one) })]));
    const count = (list, what) => (list.length ? `${list.length} ${what}` : "");
    byId("elements-about").textContent = [`${seen.length} here`, count(offered, "proposed"), count(near, "nearby")].filter(Boolean).join(", ");
    byId("map-about").textContent = `${state.labels.mapped} elements`;
    return [...seen, ...offered, ...near];
  }

  #card() {
    const { state } = this;
    const { look, drawing, selectedElement: element } = state;
    const card = look?.card;
    const id = drawing?.class ?? element?.class ?? state.selectedGhost?.class;
    if (id === undefined) return [header("Element", "nothing selected"), el("p", { class: "empty dim", text: "Click an element to see its depth, height and errors." })];
    const name = drawing ? look?.joins ?? `New ${state.classOf(id).name}` : (element ?? state.selectedGhost).name;
    const about = drawing ? "not saved yet" : element?.kept ? "kept here" : element ? state.classOf(id).name : whence(state.selectedGhost);
    const views = card ? el("span", { class: "push chip", text: card.views === 1 ? "1 view" : `${card.views} views` }) : null;
    const title = header(name, about, this.#glyph(state.classOf(id)), views);
    return [title, el("dl", { class: "numbers" }, ...numbers(card, state.selected?.side)), this.#judged(element) ?? warning(card), this.#buttons(element)];
  }

  /** What people decided about the element; null where nothing. */
  #judged(element) {
    if (!element?.judged?.length) return null;
    const takeBack = ({ id, text }) => el("button", {
      class: "small", title: "Leave it to the map again", onclick: () => this.actions.submit({ kind: "take back", judgement_id: id }),
    }, capital(text), " ✕");
    return el("p", { class: "about-card judged" }, ...element.judged.map(takeBack));
  }

  #buttons(element) {
    if (!element || this.state.drawing) return "";
    const observation = this.state.selectedObservation;
    const { kind } = this.state.classOf(element.class);
    const button = (text, key, run, pressed) =>
      el("button", { class: "small", "aria-pressed": pressed, onclick: run }, text, badge(this.keys, key));
    if (kind === "point") return el("div", { class: "buttons" }, ...this.#reclass(element), button("Delete", "Del", this.edit.remove));
    return el("div", { class: "buttons" },
      button("Hidden", "O", () => this.edit.flag("end_known"), String(observation?.end_known === false)),
      button("Cut", "C", () => this.edit.flag("anchor_known"), String(observation?.anchor_known === false)),
      button("Delete", "Del", this.edit.remove));
  }

  /** The other classes that a sign can be. */
  #reclass(element) {
    const { classes } = this.state.hello;
    const others = classes.filter((one) => one.kind === "point" && one.id !== element.class);
    return others.map((one) => {
      const title = `Make it a ${one.name} (${this.keys.shown(`Shift ${classes.indexOf(one) + 1}`)})`;
      return el("button", { class: "small", title, "aria-label": title, onclick: () => this.edit.setClass(one.id) }, this.#glyph(one));
    });
  }

  /** With one camera the images are of two frames, and are called so. */
  #paneTitle(side) {
    const pane = this.state.panes[side];
    return this.state.hasRight || !pane ? capital(side) : `Frame ${pane.frame}`;
  }

  #status() {
    const { state } = this;
    for (const side of SIDES) {
      byId(`${side}-image`).querySelector("h2").textContent = this.#paneTitle(side);
      const node = byId(`${side}-image`).querySelector(".status");
      const { drawing } = state;
      if (drawing?.side === side) {
        const { name, kind } = state.classOf(drawing.class);
        const next = kind === "line" ? "second click sets the bottom" : "release sets the middle";
        const joins = state.look?.joins ? ` of ${state.look.joins}` : "";
        node.textContent = `drawing ${name}${joins}: ${next}`;
      } else {
        const there = state.elements.filter((one) => one.observations[side]).length;
        node.textContent = there === 1 ? "1 element" : `${there} elements`;
      }
    }
  }
}

/** Why an element that is not labelled here is listed. */
const whence = (one) => {
  if (one.labelled_in !== undefined) return `labelled in frame ${one.labelled_in}`;
  return `proposed, ${about(one)}${one.refused ? ", turned down elsewhere" : ""}`;
};

/** What there is to say of a proposal: its depth, or where it comes from. */
const about = ({ depth_m, origin }) => (depth_m !== null ? `${depth_m.toFixed(0)} m` : origin === "map" ? "far" : origin);

/** How sure a proposal is, and that it is weak. */
function scoreBar({ score, sure }) {
  if (score === null) return el("span", { class: "faint", text: "looking …" });
  const bar = svg("svg", { class: sure ? "score" : "score weak", viewBox: "0 0 40 6", preserveAspectRatio: "none" },
    svg("rect", { class: "track", width: 40, height: 6 }), svg("rect", { class: "done", width: 40 * score, height: 6 }));
  return el("span", { class: "scored" }, bar, el("span", { class: "dim", text: shownScore(score) }), sure ? null : el("span", { class: "faint", text: "weak" }));
}

function hintItem({ keys: names, text, push }, keys) {
  return el("span", { class: push ? "push dim" : "hint" }, ...names.map((name) => badge(keys, name)), text);
}

function numbers(card, side) {
  const length = card?.length_px?.[side] ?? Object.values(card?.length_px ?? {})[0];
  return [
    number("Depth", card?.depth_m, "m", 1, card?.depth_sigma_m),
    number("Height", card?.height_m, "m", 2, card?.height_sigma_m),
    number("Ray angle", card?.angle_deg, "°", 2),
    number("Length", length, "px", 1),
    number("Epipolar error", card?.epipolar_px, "px", 2),
    number("RMS", card?.rms_px, "px", 2),
  ];
}

function number(name, value, unit, decimals, sigma) {
  const known = value !== undefined && value !== null;
  return el("div", {}, el("dt", { text: name }),
    el("dd", {}, el("b", { text: known ? `${fixed(value, decimals)} ${unit}` : "—" }),
      sigma !== undefined ? el("span", { class: "dim", text: ` ± ${fixed(sigma, sigma < 0.1 ? 2 : 1)}` }) : null));
}

function warning(card) {
  if (card?.is_thin) {
    return el("p", { class: "about-card" }, el("span", { class: "chip thin", text: "◆ Thin rays" }), " below 1°, add frames");
  }
  return el("p", { class: "about-card dim", text: card?.reason ? capital(card.reason) : "" });
}
