/* One place for all keys of a page: no clashes, and a help overlay that cannot miss one. */

import { el } from "./dom.js";

const NAMES = { " ": "Space", ArrowLeft: "←", ArrowRight: "→", ArrowUp: "↑", ArrowDown: "↓", Escape: "Esc", Delete: "Del" };
const CAMERA_KEYS = new Set(["w", "a", "s", "d", "q", "e", "arrowleft", "arrowright", "arrowup", "arrowdown"]);

/** What a key is called on badges: `Shift Space`, `Ctrl K`. */
export function keyName({ key, shift, ctrl }) {
  const plain = NAMES[key] ?? (key.length === 1 ? key.toUpperCase() : key);
  return [ctrl && "Ctrl", shift && "Shift", plain].filter(Boolean).join(" ");
}

function signature({ key, shift = false, ctrl = false }) {
  return `${ctrl ? "ctrl+" : ""}${shift ? "shift+" : ""}${key.toLowerCase()}`;
}

/** What was pressed, as a signature. Keys made with Shift on some layouts only (such as ?) are
 * found with and without it. */
function pressed(event) {
  const ctrl = event.ctrlKey || event.metaKey;
  const codes = { Comma: ",", Period: "." }; // Shift , is < on many layouts, Shift 1 is !
  const code = codes[event.code] ?? event.code.match(/^Digit(\d)$/)?.[1];
  const key = event.shiftKey && code ? code : event.key;
  const exact = signature({ key, shift: event.shiftKey, ctrl });
  return [exact, signature({ key, ctrl })].slice(0, event.shiftKey && /^[^a-z0-9 ,.]$/i.test(key) ? 2 : 1);
}

/** The commands of a page: `{key, shift, ctrl, group, title, run}`. Two with one key are refused. */
export class Keys {
  constructor(commands) {
    this.commands = commands;
    this._bySignature = new Map();
    for (const command of commands) {
      const id = signature(command);
      const other = this._bySignature.get(id);
      if (other) throw new Error(`${keyName(command)} is both "${other.title}" and "${command.title}"`);
      this._bySignature.set(id, command);
    }
  }

  /** Listens on a window. In the 3D pane (`isScene`) the keys that move its camera stay its own. */
  listen(target, isScene = false) {
    target.addEventListener("keydown", (event) => {
      if (event.altKey || isTyping(event.target)) return;
      if (isScene && !event.ctrlKey && CAMERA_KEYS.has(event.key.toLowerCase())) return;
      const command = pressed(event).map((id) => this._bySignature.get(id)).find(Boolean);
      if (!command || document.querySelector("dialog[open]")) return;
      event.preventDefault();
      event.stopImmediatePropagation();
      command.run(event);
    }, { capture: true });
  }

  /** Opens the overlay with every key, in groups. */
  showHelp(title) {
    const groups = Map.groupBy(this.commands, (command) => command.group);
    const sections = [...groups].map(([name, commands]) =>
      el("section", {}, el("h3", { text: name }), el("ul", {}, ...Map.groupBy(commands, helpKey).values().map(helpRow))));
    const close = el("button", { class: "small", text: "Close", onclick: () => dialog.close() });
    const dialog = el("dialog", { class: "help" },
      el("h2", { text: title }), el("div", { class: "groups" }, ...sections), close);
    dialog.addEventListener("close", () => dialog.remove());
    dialog.addEventListener("keydown", (event) => { if (event.key === "?") dialog.close(); });
    dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });
    document.body.append(dialog);
    dialog.showModal();
  }
}

/** Commands with one title and the same modifiers share a row. */
function helpKey({ title, ctrl = false, shift = false }) {
  return `${title} ${ctrl} ${shift}`;
}

function helpRow([first, ...more]) {
  const plain = more.map(({ key }) => keyName({ key }));
  const badges = [...keyName(first).split(" "), ...plain].map((name) => el("kbd", { text: name }));
  return el("li", {}, el("span", { class: "keys" }, ...badges), el("span", { text: first.title }));
}

function isTyping(target) {
  return target instanceof HTMLElement && target.matches("input:not([type=checkbox]), textarea, select, [contenteditable]");
}
