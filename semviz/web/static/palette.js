// @ts-check
/* The command palette: search the commands of a page by words, and run one with Enter. */

import { el } from "./dom.js";
import { badgesOf } from "./help.js";

/** @typedef {import("./keys.js").Command} Command */
/** @typedef {import("./keys.js").Keys} Keys */

/** Opens the palette over the page. The chosen command runs after it has closed.
 *
 * @param {Keys} keys
 */
export function showPalette(keys) {
  const palette = new Palette(keys);
  document.body.append(palette.dialog);
  palette.dialog.showModal();
}

class Palette {
  /** @param {Keys} keys */
  constructor(keys) {
    this.keys = keys;
    this.all = keys.commands.filter((command) => command.run);
    this.matches = this.all;
    this.index = 0;
    this.input = el("input", { type: "text", placeholder: "What to do", "aria-label": "What to do", role: "combobox", "aria-expanded": "true", "aria-controls": "palette-list", autocomplete: "off", spellcheck: "false" });
    this.list = el("ul", { id: "palette-list", role: "listbox", "aria-label": "Commands" });
    this.dialog = el("dialog", { class: "palette", "aria-label": "All commands" }, this.input, this.list);
    this.input.addEventListener("input", () => this.#search());
    this.dialog.addEventListener("keydown", (event) => this.#pressed(event));
    this.dialog.addEventListener("close", () => this.dialog.remove());
    this.dialog.addEventListener("click", (event) => { if (event.target === this.dialog) this.dialog.close(); });
    this.#search();
  }

  /** Lists the commands in which every typed word begins a word. */
  #search() {
    const words = this.input.value.toLowerCase().split(/\s+/).filter(Boolean);
    const isMatch = (/** @type {Command} */ { group, title, words: others = "" }) => {
      const titleWords = `${group} ${title} ${others}`.toLowerCase().split(/[^\p{L}\p{N}]+/u);
      return words.every((word) => titleWords.some((titleWord) => titleWord.startsWith(word)));
    };
    this.matches = this.all.filter(isMatch);
    this.index = 0;
    this.list.replaceChildren(...this.matches.map((command, index) => this.#row(command, index)));
    if (!this.matches.length) this.list.append(el("li", { class: "dim", text: "No command matches." }));
    this.#mark();
  }

  /**
   * @param {Command} command
   * @param {number} index
   */
  #row(command, index) {
    return el("li", { role: "option", id: `palette-${index}`, onclick: () => this.#run(command) },
      el("span", { class: "dim group", text: command.group }), el("span", { class: "fill", text: command.title }), ...badgesOf(this.keys, [command]));
  }

  #mark() {
    [...this.list.children].forEach((row, index) => row.setAttribute("aria-selected", String(index === this.index)));
    this.input.setAttribute("aria-activedescendant", `palette-${this.index}`);
    this.list.children[this.index]?.scrollIntoView({ block: "nearest" });
  }

  /** @param {KeyboardEvent} event */
  #pressed(event) {
    const by = event.key === "ArrowDown" ? 1 : event.key === "ArrowUp" ? -1 : 0;
    if (by && this.matches.length) {
      event.preventDefault();
      this.index = (this.index + by + this.matches.length) % this.matches.length;
      this.#mark();
    } else if (event.key === "Enter" && this.matches.length) {
      event.preventDefault();
      this.#run(this.matches[this.index]);
    }
  }

  /** @param {Command} command */
  #run(command) {
    this.dialog.close();
    this.keys.run(command);
  }
}
