import assert from "node:assert/strict";
import { beforeEach, test } from "node:test";
import { Keys, keyBadges, keyName } from "/static/keys.js";

class FakeElement {
  constructor(matching = "") {
    this.matching = matching;
  }

  matches(selector) {
    return this.matching !== "" && selector.includes(this.matching);
  }

  closest() {
    return null;
  }
}

beforeEach(() => {
  const stored = new Map();
  globalThis.localStorage = { getItem: (key) => stored.get(key) ?? null, setItem: (key, value) => stored.set(key, value) };
  globalThis.Element = FakeElement;
  globalThis.HTMLElement = FakeElement;
  globalThis.document = { querySelector: () => null };
});

const ran = [];
const command = (key, title, more = {}) => ({ key, title, group: "Test", run: () => ran.push(title), ...more });
const event = (key, more = {}) => ({
  key, code: "", shiftKey: false, ctrlKey: false, metaKey: false, altKey: false, target: new FakeElement(),
  preventDefault() {}, stopImmediatePropagation() {}, ...more,
});

/** Presses keys on a page and returns the titles of the commands that ran. */
function press(keys, ...events) {
  let handler;
  ran.length = 0;
  keys.listen({ addEventListener: (name, listener) => { if (name === "keydown") handler = listener; } });
  events.forEach((pressed) => handler(pressed));
  return [...ran];
}

test("keys have familiar names", () => {
  assert.deepEqual(keyBadges({ key: " ", shift: true }), ["Shift", "Space"]);
  assert.deepEqual(["k", "Escape", "Delete", "ArrowLeft", "F6"].map((key) => keyName({ key })), ["K", "Esc", "Del", "←", "F6"]);
  assert.equal(keyName({ key: "z", ctrl: true, shift: true }), "Ctrl Shift Z");
});

test("a key runs its command; with other modifiers it is another key", () => {
  const keys = new Keys("t", [command("z", "plain"), command("z", "undo", { ctrl: true }), command("z", "redo", { ctrl: true, shift: true })]);
  assert.deepEqual(press(keys, event("z")), ["plain"]);
  assert.deepEqual(press(keys, event("z", { ctrlKey: true })), ["undo"]);
  assert.deepEqual(press(keys, event("Z", { metaKey: true, shiftKey: true })), ["redo"]);
  assert.deepEqual(press(keys, event("z", { altKey: true }), event("y")), []);
});

test("digits and commas match with Shift on any layout, symbols without it", () => {
  const keys = new Keys("t", [command("1", "class", { shift: true }), command(",", "before", { shift: true }), command("?", "help")]);
  assert.deepEqual(press(keys, event("!", { code: "Digit1", shiftKey: true })), ["class"]);
  assert.deepEqual(press(keys, event("<", { code: "Comma", shiftKey: true })), ["before"]);
  assert.deepEqual(press(keys, event("?", { code: "Slash", shiftKey: true })), ["help"]);
});

test("two commands cannot share a key", () => {
  assert.throws(() => new Keys("t", [command("a", "one"), command("A", "two")]), /A is both "one" and "two"/);
});

test("a changed key is stored, shown and reset", () => {
  const [one, two] = [command("1", "one"), command("2", "two")];
  const keys = new Keys("t", [one, two]);
  assert.equal(keys.change(one, event("y")), "");
  assert.equal(keys.shown("1"), "Y");
  assert.deepEqual(press(keys, event("y"), event("1")), ["one"]);
  const again = new Keys("t", [one, two]);
  assert.equal(again.shown("1"), "Y");
  assert.equal(again.change(one, event("1")), ""); // its own key
  assert.equal(again.shown("1"), "1");
  again.change(two, event("x"));
  again.reset();
  assert.equal(again.shown("2"), "2");
});

test("keys of other commands, of the browser and of the camera are refused by name", () => {
  const one = command("1", "one");
  const keys = new Keys("t", [one, command("2", "two")]);
  assert.match(keys.change(one, event("2")), /^2 is both “two” and “one”/);
  assert.match(keys.change(one, event("w")), /camera/);
  assert.match(keys.change(one, event("t", { ctrlKey: true })), /browser/);
  assert.equal(keys.shown("1"), "1");
});

test("a changed key that a later version gives to another command falls back", () => {
  const one = command("1", "one");
  new Keys("t", [one]).change(one, event("y"));
  const keys = new Keys("t", [one, command("y", "new")]);
  assert.deepEqual([keys.shown("1"), keys.shown("Y")], ["1", "Y"]);
  assert.deepEqual(press(keys, event("y"), event("1")), ["new", "one"]);
});

test("typing in a field or operating a control runs no command", () => {
  const keys = new Keys("t", [command("a", "letter"), command("Enter", "enter")]);
  const [field, button] = [new FakeElement("input"), new FakeElement("button")];
  assert.deepEqual(press(keys, event("a", { target: field })), []);
  assert.deepEqual(press(keys, event("Enter", { target: button }), event("a", { target: button })), ["letter"]);
});

test("the 3D pane keeps the keys that move its camera", () => {
  const keys = new Keys("t", [command("w", "own"), command("x", "other")]);
  let handler;
  ran.length = 0;
  keys.listen({ addEventListener: (name, listener) => { handler = listener; } }, true);
  handler(event("w"));
  handler(event("x"));
  assert.deepEqual(ran, ["other"]);
});
