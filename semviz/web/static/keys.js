// @ts-check
/* All keys of a page in one table: no clashes, any key can be changed, the help lists them all. */

/** @typedef {{key: string, shift?: boolean, ctrl?: boolean}} Key */
/** `view`: the only view of the page in which the key works; "" is its first view.
 * @typedef {Key & {group: string, title: string, row?: string, words?: string, view?: string, run?: (event?: KeyboardEvent) => void}} Command */

/** @type {Record<string, string>} */
const NAMES = { " ": "Space", arrowleft: "←", arrowright: "→", arrowup: "↑", arrowdown: "↓", escape: "Esc", delete: "Del" };
const CAMERA_KEYS = new Set(["w", "a", "s", "d", "q", "e", "arrowleft", "arrowright", "arrowup", "arrowdown"]);
const BROWSER_KEYS = new Set(["ctrl+n", "ctrl+t", "ctrl+w", "ctrl+r", "ctrl+l", "f5", "f11", "f12"]);
const CONTROLS = "button, select, input, a[href], summary";
const CONTROL_KEYS = new Set(["enter", " ", "tab", "home", "end", "pageup", "pagedown", "arrowleft", "arrowright", "arrowup", "arrowdown"]);

/** The name of a key as badges: `["Shift", "Space"]`.
 *
 * @param {Key} key
 */
export function keyBadges({ key, shift, ctrl }) {
  const plain = NAMES[key.toLowerCase()] ?? (key.length === 1 ? key.toUpperCase() : key);
  return [...(ctrl ? ["Ctrl"] : []), ...(shift ? ["Shift"] : []), plain];
}

/** The name of a key: `Shift Space`, `Ctrl K`.
 *
 * @param {Key} key
 */
export const keyName = (key) => keyBadges(key).join(" ");

/** The name of a key in the code: `shift+x`.
 *
 * @param {Key} key
 */
export function signature({ key, shift = false, ctrl = false }) {
  return `${ctrl ? "ctrl+" : ""}${shift ? "shift+" : ""}${key.toLowerCase()}`;
}

/** The name under which a command's changed key is stored: its default key, after its view.
 *
 * @param {Command} command
 */
const nameOf = (command) => `${command.view ? `${command.view}:` : ""}${signature(command)}`;

/** Commands by key.
 * @typedef {Map<string, Command[]>} ByKey */

/** The command that has a key where `command` works; undefined if there is none.
 *
 * @param {ByKey} byKey
 * @param {Key} key
 * @param {Command} command
 */
function clash(byKey, key, { view }) {
  return byKey.get(signature(key))?.find((other) => view === undefined || other.view === undefined || other.view === view);
}

/**
 * @param {ByKey} byKey
 * @param {Key} key
 * @param {Command} command
 */
function put(byKey, key, command) {
  byKey.set(signature(key), [...byKey.get(signature(key)) ?? [], command]);
}

/** The keys that an event may mean, most likely first. Symbols that need Shift on some layouts only
 * (for example ?) match with and without it.
 *
 * @param {KeyboardEvent} event
 * @returns {Key[]}
 */
function pressed(event) {
  const { shiftKey: shift } = event;
  const ctrl = event.ctrlKey || event.metaKey;
  /** @type {Record<string, string>} */
  const codes = { Comma: ",", Period: "." }; // Shift , is < on many layouts, Shift 1 is !
  const code = codes[event.code] ?? event.code.match(/^Digit(\d)$/)?.[1];
  const key = shift && code ? code : event.key;
  const isSymbol = shift && /^[^a-z0-9 ,.]$/i.test(key);
  return isSymbol ? [{ key, shift, ctrl }, { key, shift: false, ctrl }] : [{ key, shift, ctrl }];
}

/** The commands of a page, `{key, shift, ctrl, group, title, row, run}`, with the keys that the user chose.
 * Commands with the same `row` share a row of the help. Entries without `run` are mouse gestures, for
 * the help only. Commands of different views may share a key. Stored key changes refer to a command by its
 * default key. */
export class Keys {
  /** Changed keys are stored in localStorage under the name `page`.
   *
   * @param {string} page
   * @param {Command[]} commands
   */
  constructor(page, commands = []) {
    this.storageKey = `semviz.keys.${page}`;
    this.onchange = () => {};
    this.view = ""; // on screen
    this.enter = (/** @type {string} */ view) => { this.view = view; }; // shows a view, for a command of it
    /** @type {Command[]} */
    this.commands = [];
    /** @type {Record<string, Key>} by the names of commands */
    this.changed = {};
    /** @type {ByKey} by present key */
    this._byKey = new Map();
    this.use(commands);
  }

  /** Replaces the commands. Throws if two of them share a key.
   *
   * @param {Command[]} commands
   */
  use(commands) {
    this.commands = commands;
    /** @type {ByKey} */
    const defaults = new Map();
    for (const command of commands) {
      const other = clash(defaults, command, command);
      if (other) throw new Error(`${keyName(command)} is both "${other.title}" and "${command.title}"`);
      put(defaults, command, command);
    }
    this._apply(JSON.parse(localStorage.getItem(this.storageKey) ?? "{}"));
    this.onchange();
  }

  /** The present key of `command`.
   *
   * @param {Command} command
   * @returns {Key}
   */
  of(command) {
    return this.changed[nameOf(command)] ?? command;
  }

  /** The name of a command's present key, by the name of its default key, for example `Shift Enter`. If
   * several views have one, it is that of the view on screen.
   *
   * @param {string} name
   */
  shown(name) {
    const named = this.commands.filter((candidate) => candidate.run && keyName(candidate) === name);
    const command = named.find(({ view }) => view === undefined || view === this.view) ?? named[0];
    return command ? keyName(this.of(command)) : name;
  }

  /** Runs a command that was chosen by its name, in its view.
   *
   * @param {Command} command
   */
  run(command) {
    if (command.view !== undefined && command.view !== this.view) this.enter(command.view);
    command.run?.();
  }

  /** Whether the key of `command` may be changed.
   *
   * @param {Command} command
   */
  canChange(command) {
    return Boolean(command.run) && command.key !== "Escape";
  }

  /** Gives `command` the pressed key. Returns "", or why the key was refused.
   *
   * @param {Command} command
   * @param {KeyboardEvent} event
   */
  change(command, event) {
    const key = pressed(event).slice(-1)[0];
    const [id, name] = [signature(key), keyName(key)];
    const other = this._byKey.get(id)?.find((one) => one !== command && clash(new Map([[id, [one]]]), key, command));
    if (other) return `${name} is both “${other.title}” and “${command.title}”: nothing was changed.`;
    const isDefault = id === signature(command);
    if (!isDefault && !key.ctrl && CAMERA_KEYS.has(key.key.toLowerCase())) return `${name} moves the camera of the 3D scene: nothing was changed.`;
    if (BROWSER_KEYS.has(id)) return `${name} belongs to the browser: nothing was changed.`;
    const changed = { ...this.changed, [nameOf(command)]: key };
    if (isDefault) delete changed[nameOf(command)];
    this._store(changed);
    return "";
  }

  /** Gives every command its default key. */
  reset() {
    this._store({});
  }

  /** Listens for keys on a window. The 3D pane (`isScene`) keeps the keys that move its camera; a focused
   * control keeps the keys that operate it.
   *
   * @param {Window} target
   */
  listen(target, isScene = false) {
    target.addEventListener("keydown", (event) => {
      if (event.altKey || isTyping(event.target)) return;
      const key = event.key.toLowerCase();
      if (isScene && !event.ctrlKey && CAMERA_KEYS.has(key)) return;
      if (!isScene && CONTROL_KEYS.has(key) && event.target instanceof Element && event.target.matches(CONTROLS)) return;
      const command = pressed(event).map((key) => this._at(key)).find(Boolean);
      if (!command?.run || document.querySelector("dialog[open]")) return;
      event.preventDefault();
      event.stopImmediatePropagation();
      command.run(event);
    }, { capture: true });
    if (isScene) return;
    // clicking a button does not move the focus
    target.addEventListener("mousedown", (event) => {
      if (event.target instanceof Element && event.target.closest("button")) event.preventDefault();
    });
  }

  /** The command that a key runs in the view on screen.
   *
   * @param {Key} key
   */
  _at(key) {
    return this._byKey.get(signature(key))?.find(({ view }) => view === undefined || view === this.view);
  }

  /** @param {Record<string, Key>} changed */
  _store(changed) {
    localStorage.setItem(this.storageKey, JSON.stringify(changed));
    this._apply(changed);
    this.onchange();
  }

  /** Applies changed keys. One that another command has by now falls back to its default.
   *
   * @param {Record<string, Key>} changed
   */
  _apply(changed) {
    /** @type {ByKey} */
    const byKey = new Map();
    for (const command of this.commands) {
      const own = nameOf(command), key = changed[own] ?? command;
      const other = clash(byKey, key, command);
      if (other) {
        const { [own in changed ? own : nameOf(other)]: _, ...rest } = changed;
        this._apply(rest);
        return;
      }
      put(byKey, key, command);
    }
    this.changed = changed;
    this._byKey = byKey;
  }
}

/** @param {EventTarget | null} target */
function isTyping(target) {
  return target instanceof HTMLElement
    && target.matches("input:not([type=checkbox], [type=range]), textarea, select, [contenteditable]");
}
