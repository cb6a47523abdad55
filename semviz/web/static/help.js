// @ts-check
/* The overlay that lists the keys of the view on screen and can change them. */

import { el } from "./dom.js";
import { keyBadges, keyName } from "./keys.js";

/** @typedef {import("./keys.js").Command} Command */
/** @typedef {import("./keys.js").Keys} Keys */
/** @typedef {{text: string, run: () => void}} More */

const ARROWS = "←,→,↑,↓";
const FOOT = "W A S D Q E move the camera of the 3D scene and nothing else. Two commands cannot share a key.";

/** Opens the overlay. `more` are further buttons; each closes it.
 *
 * @param {Keys} keys
 * @param {string} title
 * @param {More[]} more
 */
export function showHelp(keys, title, more = []) {
  const { dialog } = new Help(keys, title, more);
  document.body.append(dialog);
  dialog.showModal();
}

class Help {
  /**
   * @param {Keys} keys
   * @param {string} title
   * @param {More[]} more
   */
  constructor(keys, title, more) {
    this.keys = keys;
    this.changing = false;
    /** @type {Command | null} */
    this.waiting = null; // the command whose new key is awaited
    const close = () => this.dialog.close();
    const button = (/** @type {More} */ { text, run }) => el("button", { text, onclick: () => { close(); run(); } });
    this.change = el("button", { text: "Change keys…", onclick: () => this.#setChanging(!this.changing) });
    this.reset = el("button", { text: "Reset to defaults", hidden: "", onclick: () => this.#reset() });
    this.message = el("p", { class: "dim", role: "status", text: FOOT });
    this.groups = el("div", { class: "groups" });
    this.dialog = el("dialog", { class: "help", "aria-label": title },
      el("header", {}, el("h2", { text: title }), el("span", { class: "dim", text: "work anywhere on this page" }),
        el("span", { class: "push" }), this.reset, this.change, ...more.map(button), el("button", { class: "plain", "aria-label": "Close", onclick: close }, el("kbd", { text: "Esc" }))),
      this.groups, this.message);
    this.#show();
    this.dialog.addEventListener("close", () => this.dialog.remove());
    this.dialog.addEventListener("click", (event) => { if (event.target === this.dialog) close(); });
    this.dialog.addEventListener("keydown", (event) => this.#pressed(event), { capture: true });
  }

  /** @param {KeyboardEvent} event */
  #pressed(event) {
    if (this.waiting && !["Shift", "Control", "Alt", "Meta", "AltGraph"].includes(event.key)) {
      event.preventDefault();
      event.stopPropagation();
      const command = this.waiting;
      this.#await(null);
      if (event.key !== "Escape") this.#change(command, event);
      this.#show();
      const own = this.groups.querySelector(`[data-own="${CSS.escape(keyName(command))}"]`);
      if (own instanceof HTMLElement) own.focus();
    } else if (event.key === "?" && !this.changing) {
      this.dialog.close();
    }
  }

  /**
   * @param {Command} command
   * @param {KeyboardEvent} event
   */
  #change(command, event) {
    const refusal = this.keys.change(command, event);
    this.#setMessage(refusal || `“${command.title}” is now ${keyName(this.keys.of(command))}.`, refusal ? "warning" : "dim");
  }

  /** @param {boolean} on */
  #setChanging(on) {
    this.changing = on;
    this.change.textContent = on ? "Done" : "Change keys…";
    this.reset.hidden = !on;
    this.#await(null);
    this.#setMessage(on ? "Choose a key, then press the new one. This browser keeps it." : FOOT);
    this.#show();
  }

  #reset() {
    this.keys.reset();
    this.#setMessage("All keys are reset to their defaults.");
    this.#show();
  }

  /** @param {Command | null} command */
  #await(command) {
    this.waiting = command;
    if (command) this.#setMessage(`Press the new key for “${command.title}”. Esc leaves it as it is.`);
  }

  /** @param {string} text */
  #setMessage(text, look = "dim") {
    this.message.textContent = text;
    this.message.className = look;
  }

  #show() {
    const here = this.keys.commands.filter(({ view }) => view === undefined || view === this.keys.view);
    const groups = Map.groupBy(here, (command) => command.group);
    this.groups.replaceChildren(...[...groups].map(([name, commands]) =>
      el("section", {}, el("h3", { text: name }),
        el("ul", {}, ...[...Map.groupBy(commands, rowKey).values()].map((row) => this.#row(row))))));
  }

  /** @param {Command[]} commands */
  #row(commands) {
    const badges = this.changing ? commands.map((command) => this.#button(command)) : badgesOf(this.keys, commands);
    return el("li", {}, el("span", { class: "keys" }, ...badges), el("span", { text: commands[0].row ?? commands[0].title }));
  }

  /** @param {Command} command */
  #button(command) {
    const name = keyName(this.keys.of(command));
    if (!this.keys.canChange(command)) return el("kbd", { text: name });
    const choose = (/** @type {import("./dom.js").Click} */ event) => {
      this.groups.querySelector(".waiting")?.classList.remove("waiting");
      event.currentTarget.classList.add("waiting");
      this.#await(command);
    };
    const label = `${command.title}: ${name}. Change`;
    return el("button", { class: "kbd", "aria-label": label, data: { own: keyName(command) }, text: name, onclick: choose });
  }
}

/** One badge per key; modifiers shared by all keys of a row come once, in front.
 *
 * @param {Keys} keys
 * @param {Command[]} commands
 */
export function badgesOf(keys, commands) {
  const names = commands.map((command) => keyBadges(keys.of(command)));
  const shared = names[0].slice(0, -1);
  const isShared = names.every((badges) => badges.slice(0, -1).join() === shared.join());
  const last = names.map((badges) => badges[badges.length - 1]);
  const badges = isShared ? [...shared, ...(last.join() === ARROWS ? ["Arrows"] : last)] : names.flat();
  return badges.map((name) => el("kbd", { text: name }));
}

/** The row of a command: those with the same title (or `row`) and modifiers share one.
 *
 * @param {Command} command
 */
function rowKey({ title, row, ctrl = false, shift = false }) {
  return `${row ?? title} ${ctrl} ${shift}`;
}
