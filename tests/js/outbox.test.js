import assert from "node:assert/strict";
import { webcrypto } from "node:crypto";
import { beforeEach, test } from "node:test";
import { Outbox } from "../../semviz/annotator/page/saving/outbox.js";
import { moveToRestored, replacedLabels } from "../../semviz/annotator/page/saving/questions.js";

/** localStorage: entries are own properties, methods are not. */
class FakeStorage {
  static of() {
    return Object.create(FakeStorage.prototype);
  }

  getItem(key) {
    return Object.hasOwn(this, key) ? this[key] : null;
  }

  setItem(key, value) {
    this[key] = String(value);
  }

  removeItem(key) {
    delete this[key];
  }
}

globalThis.crypto ??= webcrypto;
let timers = [];

beforeEach(() => {
  globalThis.localStorage = FakeStorage.of();
  globalThis.setTimeout = (callback, ms) => timers.push({ callback, ms });
  globalThis.clearTimeout = () => (timers = []);
  timers = [];
});

/** An outbox with the requests that it has sent; `connection.up` is whether the page is connected. */
function made(connection = { up: true }, workspace = "w") {
  const sent = [];
  const outbox = new Outbox(workspace, ({ request, edit, base }) => {
    if (connection.up) sent.push({ request, base, ...edit });
    return connection.up;
  });
  return { outbox, sent, connection };
}

const SINCE = { operation: 7, hash: "5e" };
const kinds = (edits) => edits.map(({ kind }) => kind);

test("edits are sent one at a time, in order", () => {
  const { outbox, sent } = made();
  for (const kind of ["one", "two", "three"]) outbox.add({ kind });
  assert.deepEqual(kinds(sent), ["one"]);
  outbox.settle(sent[0].request);
  assert.deepEqual(kinds(sent), ["one", "two"]);
  outbox.settle(sent[1].request);
  outbox.settle(sent[2].request);
  assert.deepEqual(kinds(sent), ["one", "two", "three"]);
  assert.deepEqual(outbox.entries, []);
});

test("edits wait without a connection, and are sent once there is one", () => {
  const { outbox, sent, connection } = made({ up: false });
  outbox.add({ kind: "one" });
  outbox.add({ kind: "two" });
  assert.deepEqual(sent, []);
  connection.up = true;
  outbox.flush();
  assert.deepEqual(kinds(sent), ["one"]);
  outbox.settle(sent[0].request);
  assert.deepEqual(kinds(sent), ["one", "two"]);
});

test("an edit without an answer is sent again after a break, under the same request", () => {
  const { outbox, sent } = made();
  outbox.add({ kind: "one" });
  outbox.flush();
  assert.equal(sent.length, 1);
  outbox.disconnected();
  outbox.flush();
  assert.equal(sent.length, 2);
  assert.equal(sent[0].request, sent[1].request);
});

test("edits outlive the page; those of other workspaces are not touched", () => {
  made({ up: false }).outbox.add({ kind: "one" }, { frame: 3, side: "left", class: 0 });
  made({ up: false }, "other").outbox.add({ kind: "foreign" });
  const { outbox, sent } = made();
  assert.deepEqual(kinds(outbox.entries.map(({ edit }) => edit)), ["one"]);
  assert.deepEqual(outbox.entries[0].shown, { frame: 3, side: "left", class: 0 });
  outbox.flush();
  outbox.settle(sent[0].request);
  assert.deepEqual(kinds(sent), ["one"]);
  assert.equal(made({ up: true }, "other").outbox.entries.length, 1);
});

test("entries of the previous version are sent unchanged", () => {
  const entry = { request: "r", place: 4, edit: { kind: "delete", seen: { frame: 1 } }, shown: null };
  localStorage.setItem("semviz.outbox.w.r", JSON.stringify(entry));
  const { outbox, sent } = made();
  outbox.flush();
  assert.deepEqual(sent, [{ request: "r", base: undefined, kind: "delete", seen: { frame: 1 } }]);
  assert.deepEqual(outbox.find("r"), entry);
  assert.equal(outbox.find("another"), null);
  assert.equal(outbox.find(null), null);
});

test("an edit that could not be saved is sent again after a while, before later ones", () => {
  const { outbox, sent } = made();
  outbox.add({ kind: "one" });
  outbox.add({ kind: "two" });
  outbox.retry();
  assert.deepEqual(kinds(sent), ["one"]);
  assert.equal(timers.length, 1);
  timers[0].callback();
  assert.deepEqual(kinds(sent), ["one", "one"]);
});

test("an edit knows the page's own edits, and what the user chose to overwrite", () => {
  const { outbox, sent } = made();
  outbox.saw("long ago", 3);
  outbox.saw("just now", 9);
  for (const id of ["a", "a", "b"]) outbox.add({ kind: "move", observation_id: id }, null, SINCE);
  const [first, second] = outbox.entries;
  assert.deepEqual(sent[0].base, { ...SINCE, known: ["just now"] });
  outbox.overwrite(first, ["theirs"]);
  assert.deepEqual(outbox.entries.map(({ base }) => base.known.includes("theirs")), [true, true, false]);
  assert.deepEqual(sent.map(({ request }) => request), [first.request, first.request]);
  outbox.saw(first.request, 10);
  outbox.settle(first.request);
  assert.deepEqual(sent.at(-1).request, second.request);
  assert.deepEqual(sent.at(-1).base.known, ["theirs", "just now", first.request]);
});

test("what the user chose to overwrite is not extended to edits of other ends", () => {
  const { outbox } = made();
  outbox.add({ kind: "move", observation_id: "a", anchor_px: [1, 2], end_px: null }, null, 7);
  outbox.add({ kind: "move", observation_id: "a", anchor_px: null, end_px: [3, 4] }, null, 7);
  outbox.overwrite(outbox.entries[0], ["theirs"]);
  assert.deepEqual(outbox.entries.map(({ base }) => base.known), [["theirs"], []]);
});

test("a page opened later still knows which edits of this browser were saved", () => {
  const before = made();
  before.outbox.add({ kind: "one" }, null, SINCE);
  before.outbox.add({ kind: "two" }, null, SINCE);
  before.outbox.saw(before.sent[0].request, 8);
  before.outbox.settle(before.sent[0].request);
  const { outbox, sent } = made();
  outbox.flush();
  assert.deepEqual(sent[0].base.known, [before.sent[0].request]);
});

test("a thousand unsaved edits take room for a thousand edits, and the first without room is told", () => {
  const { outbox } = made({ up: false });
  for (let i = 0; i < 1000; i += 1) assert.equal(outbox.add({ kind: "move", observation_id: "a" }, null, 7), true);
  const size = Object.values(localStorage).reduce((sum, text) => sum + text.length, 0);
  assert.ok(size < 300_000, `${size} characters`);
  const { setItem } = FakeStorage.prototype;
  FakeStorage.prototype.setItem = () => { throw new DOMException("full", "QuotaExceededError"); };
  assert.equal(outbox.add({ kind: "move", observation_id: "a" }, null, 7), false);
  FakeStorage.prototype.setItem = setItem;
  assert.equal(outbox.entries.length, 1000);
});

test("a refusal of another edit does not release the next one", () => {
  const { outbox, sent } = made();
  outbox.add({ kind: "one" });
  outbox.add({ kind: "two" });
  outbox.settle(outbox.entries[1].request);
  assert.deepEqual(kinds(sent), ["one"]);
  assert.equal(outbox.entries.length, 1);
});

const RESTORED = { operation: 3, hash: "a1" };
const view = (id, top) => ({ id, frame: 5, side: "left", anchor: [9, top], end: [9, 50], anchor_known: true, end_known: true });
const element = (id, top) => ({ id: `of ${id}`, class_id: 0, observations: { left: view(id, top) } });

/** A page that shows labels which a backup put in place. */
function restoredPage(outbox) {
  const frame = { index: 5, elements: [element("same", 10), element("other", 33)] };
  return { outbox, state: { lastShown: RESTORED, received: { frame } }, settle: (request) => outbox.settle(request) };
}

test("edits of replaced labels move one by one, those made while the question is open stay as they are", () => {
  const { outbox, sent } = made();
  for (const kind of ["draw", "undo", "move", "restore"]) outbox.add({ kind }, null, SINCE);
  const page = restoredPage(outbox);
  const { answers } = replacedLabels(outbox.entries[0], { text: "" }, page);
  for (const kind of ["move", "undo"]) outbox.add({ kind }, null, RESTORED);
  answers[0].run();
  const stored = [];
  while (outbox.entries.length) {
    const { request, kind, base } = sent.at(-1);
    if (base.hash === SINCE.hash) { // the server refuses it
      const entry = outbox.find(request);
      assert.ok(entry.place <= outbox.agreed);
      moveToRestored(entry, page);
    } else {
      stored.push([kind, base.operation]);
      outbox.settle(request);
    }
  }
  assert.deepEqual(stored, [["draw", 0], ["move", 0], ["move", RESTORED.operation], ["undo", RESTORED.operation]]);
});

test("an edit of a replaced label asks again only if the restored label looks otherwise", () => {
  const { outbox } = made();
  const page = restoredPage(outbox);
  for (const id of ["same", "other", "gone"]) {
    const then = { element: `of ${id}`, frame: 5, side: "left", anchor: [9, 10], end: [9, 50], anchor_known: true, end_known: true };
    outbox.add({ kind: "move", observation_id: id, seen: then }, null, SINCE);
  }
  for (const entry of outbox.entries) moveToRestored(entry, page);
  const unseen = { operation: 0, known: [] };
  assert.deepEqual(outbox.entries.map(({ base }) => base), [{ ...RESTORED, known: [] }, unseen, unseen]);
});
