/* One place for all keys of a page: no clashes, every key can be changed, none is missing in the help. */

const NAMES = { " ": "Space", arrowleft: "←", arrowright: "→", arrowup: "↑", arrowdown: "↓", escape: "Esc", delete: "Del" };
const CAMERA_KEYS = new Set(["w", "a", "s", "d", "q", "e", "arrowleft", "arrowright", "arrowup", "arrowdown"]);
const BROWSER_KEYS = new Set(["ctrl+n", "ctrl+t", "ctrl+w", "ctrl+r", "ctrl+l", "f5", "f11", "f12"]);
const CONTROLS = "button, select, input, a[href], summary";
const CONTROL_KEYS = new Set(["enter", " ", "tab", "home", "end", "pageup", "pagedown", "arrowleft", "arrowright", "arrowup", "arrowdown"]);

/** What a key is called, badge by badge: `["Shift", "Space"]`. */
export function keyBadges({ key, shift, ctrl }) {
  const plain = NAMES[key.toLowerCase()] ?? (key.length === 1 ? key.toUpperCase() : key);
  return [ctrl && "Ctrl", shift && "Shift", plain].filter(Boolean);
}

/** The same in one: `Shift Space`, `Ctrl K`. */
export const keyName = (key) => keyBadges(key).join(" ");

function signature({ key, shift = false, ctrl = false }) {
  return `${ctrl ? "ctrl+" : ""}${shift ? "shift+" : ""}${key.toLowerCase()}`;
}

/** What was pressed, as it is most likely meant. Keys made with Shift on some layouts only (such as ?)
 * are found with and without it. */
function pressed(event) {
  const { shiftKey: shift } = event;
  const ctrl = event.ctrlKey || event.metaKey;
  const codes = { Comma: ",", Period: "." }; // Shift , is < on many layouts, Shift 1 is !
  const code = codes[event.code] ?? event.code.match(/^Digit(\d)$/)?.[1];
  const key = shift && code ? code : event.key;
  const isSymbol = shift && /^[^a-z0-9 ,.]$/i.test(key);
  return isSymbol ? [{ key, shift, ctrl }, { key, shift: false, ctrl }] : [{ key, shift, ctrl }];
}

/** The commands of a page, `{key, shift, ctrl, group, title, row, run}`, each under the key that the
 * person chose. Those with one `row` stand together in the help. Entries without `run` are gestures of the mouse, for the help only. A command's own key, as
 * written in the list, also names it where changed keys are kept. */
export class Keys {
  /** `page` names the place in localStorage. */
  constructor(page, commands = []) {
    this.place = `semviz.keys.${page}`;
    this.onchange = () => {};
    this.use(commands);
  }

  /** Takes over a list of commands. Throws where two of them have one key. */
  use(commands) {
    this.commands = commands;
    const found = new Map();
    for (const command of commands) {
      const other = found.get(signature(command));
      if (other) throw new Error(`${keyName(command)} is both "${other.title}" and "${command.title}"`);
      found.set(signature(command), command);
    }
    this._apply(JSON.parse(localStorage.getItem(this.place) ?? "{}"));
    this.onchange();
  }

  /** The key that `command` has now: `{key, shift, ctrl}`. */
  of(command) {
    return this.changed[signature(command)] ?? command;
  }

  /** The badge of a command as it is now, by the name of its own key, such as `Shift Enter`. */
  shown(name) {
    const command = this.commands.find((one) => one.run && keyName(one) === name);
    return command ? keyName(this.of(command)) : name;
  }

  /** Whether a person may give `command` another key. */
  canChange(command) {
    return Boolean(command.run) && command.key !== "Escape";
  }

  /** Gives `command` the key that was pressed. Returns why not, or "" where it has it now. */
  change(command, event) {
    const key = pressed(event).at(-1);
    const [id, name] = [signature(key), keyName(key)];
    const other = this._find.get(id);
    if (other && other !== command) return `${name} is both “${other.title}” and “${command.title}”: nothing was changed.`;
    const isOwn = id === signature(command);
    if (!isOwn && !key.ctrl && CAMERA_KEYS.has(key.key.toLowerCase())) return `${name} moves the camera of the 3D scene: nothing was changed.`;
    if (BROWSER_KEYS.has(id)) return `${name} belongs to the browser: nothing was changed.`;
    const changed = { ...this.changed, [signature(command)]: key };
    if (isOwn) delete changed[id];
    this._keep(changed);
    return "";
  }

  /** Every command has its own key again. */
  reset() {
    this._keep({});
  }

  /** Listens on a window. In the 3D pane (`isScene`) the keys that move its camera stay its own; a
   * control that was reached by keys keeps those that work it. */
  listen(target, isScene = false) {
    target.addEventListener("keydown", (event) => {
      if (event.altKey || isTyping(event.target)) return;
      const key = event.key.toLowerCase();
      if (isScene && !event.ctrlKey && CAMERA_KEYS.has(key)) return;
      if (!isScene && CONTROL_KEYS.has(key) && event.target.matches?.(CONTROLS)) return;
      const command = pressed(event).map((one) => this._find.get(signature(one))).find(Boolean);
      if (!command?.run || document.querySelector("dialog[open]")) return;
      event.preventDefault();
      event.stopImmediatePropagation();
      command.run(event);
    }, { capture: true });
    if (isScene) return;
    // the mouse presses a button, but the keys stay where they are
    target.addEventListener("mousedown", (event) => {
      if (event.target.closest?.("button")) event.preventDefault();
    });
  }

  _keep(changed) {
    localStorage.setItem(this.place, JSON.stringify(changed));
    this._apply(changed);
    this.onchange();
  }

  /** A changed key that the list gives to another command by now falls back to the command's own. */
  _apply(changed) {
    const found = new Map();
    for (const command of this.commands) {
      const [own, key] = [signature(command), changed[signature(command)] ?? command];
      const other = found.get(signature(key));
      if (other) {
        const { [own in changed ? own : signature(other)]: _, ...rest } = changed;
        this._apply(rest);
        return;
      }
      found.set(signature(key), command);
    }
    this.changed = changed;
    this._find = found;
  }
}

function isTyping(target) {
  return target instanceof HTMLElement
    && target.matches("input:not([type=checkbox], [type=range]), textarea, select, [contenteditable]");
}
