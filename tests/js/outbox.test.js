import assert from "node:assert/strict";
import { webcrypto } from "node:crypto";
import { beforeEach, test } from "node:test";
import { Outbox } from "../../semviz/annotator/page/outbox.js";

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
  const outbox = new Outbox(workspace, ({ request, edit }) => {
    if (connection.up) sent.push({ request, ...edit });
    return connection.up;
  });
  return { outbox, sent, connection };
}

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
  assert.deepEqual(sent, [{ request: "r", kind: "delete", seen: { frame: 1 } }]);
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

test("a replaced edit keeps its request and its place", () => {
  const { outbox, sent } = made();
  outbox.add({ kind: "one" });
  outbox.add({ kind: "two" });
  outbox.replace(outbox.entries[0], { kind: "another" });
  assert.deepEqual(kinds(sent), ["one", "another"]);
  assert.equal(sent[0].request, sent[1].request);
  assert.deepEqual(kinds(outbox.entries.map(({ edit }) => edit)), ["another", "two"]);
});

test("a refusal of another edit does not release the next one", () => {
  const { outbox, sent } = made();
  outbox.add({ kind: "one" });
  outbox.add({ kind: "two" });
  outbox.settle(outbox.entries[1].request);
  assert.deepEqual(kinds(sent), ["one"]);
  assert.equal(outbox.entries.length, 1);
});
