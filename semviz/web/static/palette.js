/* All commands of a page, found by their words and run by Enter. */

import { el } from "./dom.js";
import { badgesOf } from "./help.js";

/** Opens the palette over the page. What is chosen runs after it has closed. */
export function showPalette(keys) {
  const palette = new Palette(keys);
  document.body.append(palette.dialog);
  palette.dialog.showModal();
}

class Palette {
  constructor(keys) {
    this.keys = keys;
    this.all = keys.commands.filter((one) => one.run);
    this.input = el("input", { type: "text", placeholder: "What to do", "aria-label": "What to do", role: "combobox", "aria-expanded": "true", "aria-controls": "palette-list", autocomplete: "off", spellcheck: "false" });
    this.list = el("ul", { id: "palette-list", role: "listbox", "aria-label": "Commands" });
    this.dialog = el("dialog", { class: "palette", "aria-label": "All commands" }, this.input, this.list);
    this.input.addEventListener("input", () => this.#find());
    this.dialog.addEventListener("keydown", (event) => this.#pressed(event));
    this.dialog.addEventListener("close", () => this.dialog.remove());
    this.dialog.addEventListener("click", (event) => { if (event.target === this.dialog) this.dialog.close(); });
    this.#find();
  }

  /** Commands in which every word begins a word. */
  #find() {
    const words = this.input.value.toLowerCase().split(/\s+/).filter(Boolean);
    const has = ({ group, title }) => {
      const there = `${group} ${title}`.toLowerCase().split(/[^\p{L}\p{N}]+/u);
      return words.every((word) => there.some((one) => one.startsWith(word)));
    };
    this.found = this.all.filter(has);
    this.place = 0;
    this.list.replaceChildren(...this.found.map((one, place) => this.#row(one, place)));
    if (!this.found.length) this.list.append(el("li", { class: "dim", text: "No command has these words." }));
    this.#mark();
  }

  #row(command, place) {
    return el("li", { role: "option", id: `palette-${place}`, onclick: () => this.#run(command) },
      el("span", { class: "dim group", text: command.group }), el("span", { class: "fill", text: command.title }), ...badgesOf(this.keys, [command]));
  }

  #mark() {
    [...this.list.children].forEach((row, place) => row.setAttribute("aria-selected", String(place === this.place)));
    this.input.setAttribute("aria-activedescendant", `palette-${this.place}`);
    this.list.children[this.place]?.scrollIntoView({ block: "nearest" });
  }

  #pressed(event) {
    const by = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if (by && this.found.length) {
      event.preventDefault();
      this.place = (this.place + by + this.found.length) % this.found.length;
      this.#mark();
    } else if (event.key === "Enter" && this.found.length) {
      event.preventDefault();
      this.#run(this.found[this.place]);
    }
  }

  #run(command) {
    this.dialog.close();
    command.run();
  }
}
