/* The overlay with every key of a page, where keys can be changed too. */

import { el } from "./dom.js";
import { keyBadges, keyName } from "./keys.js";

const ARROWS = "←,→,↑,↓";
const FOOT = "W A S D Q E are never used, so a key pressed over the 3D scene moves that camera and nothing else. "
  + "Two commands can't share a key: the second is refused by name.";

/** Opens the overlay. `more` are further buttons `{text, run}`, each of which closes it. */
export function showHelp(keys, title, more = []) {
  document.body.append(new Help(keys, title, more).dialog);
  document.querySelector("dialog.help").showModal();
}

class Help {
  constructor(keys, title, more) {
    this.keys = keys;
    this.changing = false;
    this.waiting = null; // the command whose new key is awaited
    const close = () => this.dialog.close();
    const button = ({ text, run }) => el("button", { text, onclick: () => { close(); run(); } });
    this.change = el("button", { text: "Change keys…", onclick: () => this.#setChanging(!this.changing) });
    this.reset = el("button", { text: "Reset to defaults", hidden: "", onclick: () => this.#reset() });
    this.said = el("p", { class: "dim", role: "status", text: FOOT });
    this.groups = el("div", { class: "groups" });
    this.dialog = el("dialog", { class: "help", "aria-label": title },
      el("header", {}, el("h2", { text: title }), el("span", { class: "dim", text: "work while the pointer is anywhere on this page" }),
        el("span", { class: "push" }), this.reset, this.change, ...more.map(button), el("button", { class: "plain", "aria-label": "Close", onclick: close }, el("kbd", { text: "Esc" }))),
      this.groups, this.said);
    this.#show();
    this.dialog.addEventListener("close", () => this.dialog.remove());
    this.dialog.addEventListener("click", (event) => { if (event.target === this.dialog) close(); });
    this.dialog.addEventListener("keydown", (event) => this.#pressed(event), { capture: true });
  }

  #pressed(event) {
    if (this.waiting && !["Shift", "Control", "Alt", "Meta", "AltGraph"].includes(event.key)) {
      event.preventDefault();
      event.stopPropagation();
      const command = this.waiting;
      this.#await(null);
      if (event.key !== "Escape") this.#change(command, event);
      this.#show();
      this.groups.querySelector(`[data-own="${CSS.escape(keyName(command))}"]`)?.focus();
    } else if (event.key === "?" && !this.changing) {
      this.dialog.close();
    }
  }

  #change(command, event) {
    const refusal = this.keys.change(command, event);
    this.#say(refusal || `“${command.title}” is now ${keyName(this.keys.of(command))}.`, refusal ? "warning" : "dim");
  }

  #setChanging(on) {
    this.changing = on;
    this.change.textContent = on ? "Done" : "Change keys…";
    this.reset.hidden = !on;
    this.#await(null);
    this.#say(on ? "Choose a key, then press the new one. Kept in this browser." : FOOT);
    this.#show();
  }

  #reset() {
    this.keys.reset();
    this.#say("Every command has its own key again.");
    this.#show();
  }

  #await(command) {
    this.waiting = command;
    if (command) this.#say(`Press the new key for “${command.title}”. Esc leaves it as it is.`);
  }

  #say(text, look = "dim") {
    this.said.textContent = text;
    this.said.className = look;
  }

  #show() {
    const groups = Map.groupBy(this.keys.commands, (command) => command.group);
    this.groups.replaceChildren(...[...groups].map(([name, commands]) =>
      el("section", {}, el("h3", { text: name }),
        el("ul", {}, ...[...Map.groupBy(commands, rowKey).values()].map((row) => this.#row(row))))));
  }

  #row(commands) {
    const badges = this.changing ? commands.map((one) => this.#button(one)) : badgesOf(this.keys, commands);
    return el("li", {}, el("span", { class: "keys" }, ...badges), el("span", { text: commands[0].row ?? commands[0].title }));
  }

  #button(command) {
    const name = keyName(this.keys.of(command));
    if (!this.keys.canChange(command)) return el("kbd", { text: name });
    const choose = (event) => {
      this.groups.querySelector(".waiting")?.classList.remove("waiting");
      event.currentTarget.classList.add("waiting");
      this.#await(command);
    };
    const label = `${command.title}: ${name}. Change`;
    return el("button", { class: "kbd", "aria-label": label, data: { own: keyName(command) }, text: name, onclick: choose });
  }
}

/** One badge a key; the modifiers that all keys of a row share stand once, in front. */
export function badgesOf(keys, commands) {
  const names = commands.map((one) => keyBadges(keys.of(one)));
  const shared = names[0].slice(0, -1);
  const isShared = names.every((one) => one.slice(0, -1).join() === shared.join());
  const last = names.map((one) => one.at(-1));
  const badges = isShared ? [...shared, ...(last.join() === ARROWS ? ["Arrows"] : last)] : names.flat();
  return badges.map((name) => el("kbd", { text: name }));
}

/** Commands with one title (or `row`) and the same modifiers share a row. */
function rowKey({ title, row = title, ctrl = false, shift = false }) {
  return `${row} ${ctrl} ${shift}`;
}
