import assert from "node:assert/strict";
import { beforeEach, test } from "node:test";
import { Keys } from "/static/keys.js";

beforeEach(() => {
  const stored = new Map();
  globalThis.localStorage = { getItem: (key) => stored.get(key) ?? null, setItem: (key, value) => stored.set(key, value) };
  globalThis.Element = globalThis.HTMLElement = class {};
  globalThis.document = { querySelector: () => null };
});

const ran = [];
const command = (key, title, view) => ({ key, title, group: "Test", view, run: () => ran.push(title) });
const event = (key) => ({ key, code: "", shiftKey: false, ctrlKey: false, metaKey: false, altKey: false, target: null, preventDefault() {}, stopImmediatePropagation() {} });

/** The titles of the commands that a key runs in a view. */
function press(keys, key, view) {
  let handler;
  ran.length = 0;
  keys.view = view;
  keys.listen({ addEventListener: (name, listener) => { if (name === "keydown") handler = listener; } });
  handler(event(key));
  return [...ran];
}

test("views may share a key, and a command of the whole page may not", () => {
  const keys = new Keys("t", [command("x", "reject", ""), command("x", "reject here", "tracks"), command("h", "history")]);
  assert.deepEqual(press(keys, "x", ""), ["reject"]);
  assert.deepEqual(press(keys, "x", "tracks"), ["reject here"]);
  assert.deepEqual(press(keys, "x", "poses"), []);
  assert.deepEqual(press(keys, "h", "tracks"), ["history"]);
  assert.throws(() => keys.use([command("h", "history"), command("h", "here", "tracks")]), /is both/);
});

test("a key changed in one view stays what it was in another, also after a reload", () => {
  const commands = [command("x", "reject", ""), command("x", "reject here", "tracks"), command("h", "history")];
  const keys = new Keys("t", commands);
  assert.equal(keys.change(commands[1], event("y")), "");
  assert.match(keys.change(commands[1], event("h")), /both “history”/);
  const again = new Keys("t", commands);
  assert.deepEqual(press(again, "y", "tracks"), ["reject here"]);
  assert.deepEqual(press(again, "x", ""), ["reject"]);
  assert.deepEqual(press(again, "y", ""), []);
});

test("a command chosen by its name runs in its view", () => {
  const keys = new Keys("t", [command("x", "reject here", "tracks")]);
  keys.run(keys.commands[0]);
  assert.equal(keys.view, "tracks");
});
