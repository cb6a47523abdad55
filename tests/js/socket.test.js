import assert from "node:assert/strict";
import { beforeEach, test } from "node:test";
import { PageSocket, Refusal } from "/static/socket.js";

/** A WebSocket whose server is the test. */
class FakeWebSocket extends EventTarget {
  static OPEN = 1;
  static all = [];

  constructor(address) {
    super();
    this.address = String(address);
    this.readyState = 0;
    this.sent = [];
    FakeWebSocket.all.push(this);
  }

  send(text) {
    this.sent.push(JSON.parse(text));
  }

  open(session = "abc", protocol = 3) {
    this.readyState = FakeWebSocket.OPEN;
    this.tell({ type: "hello", reply_to: null, protocol, session });
  }

  tell(event) {
    this.dispatchEvent(Object.assign(new Event("message"), { data: JSON.stringify(event) }));
  }

  break() {
    this.readyState = 3;
    this.dispatchEvent(new Event("close"));
  }
}

const latest = () => FakeWebSocket.all.at(-1);
let reloads = 0;
let timers = []; // {callback, ms} of the running timers

/** Lets the only running timer expire; returns its duration. */
function expire() {
  const [{ callback, ms }, ...others] = timers;
  assert.deepEqual(others, []);
  timers = [];
  callback();
  return ms;
}

beforeEach(() => {
  globalThis.setTimeout = (callback, ms) => timers.push({ callback, ms });
  timers = [];
  FakeWebSocket.all = [];
  reloads = 0;
  const kept = new Map();
  globalThis.WebSocket = FakeWebSocket;
  globalThis.location = { href: "http://localhost:8000/?frame=3", reload: () => (reloads += 1) };
  globalThis.sessionStorage = {
    getItem: (key) => kept.get(key) ?? null,
    setItem: (key, value) => kept.set(key, value),
    removeItem: (key) => kept.delete(key),
  };
});

test("a request carries its type, a unique id and its fields; nothing is sent without a connection", () => {
  const socket = new PageSocket();
  assert.equal(latest().address, "ws://localhost:8000/socket");
  assert.equal(socket.send("select", { element: 4 }), false);
  latest().open();
  assert.equal(socket.send("select", { element: 4 }), true);
  assert.equal(socket.send("select", { element: 5 }), true);
  assert.equal(socket.send("apply_edit", {}, "own-id"), true);
  const [first, second, third] = latest().sent;
  assert.deepEqual({ ...first, id: "" }, { type: "select", id: "", element: 4 });
  assert.notEqual(first.id, second.id);
  assert.equal(third.id, "own-id");
});

test("an event goes to the handlers of its type, in order", () => {
  const seen = [];
  const socket = new PageSocket();
  socket.on("frame", ({ index }) => seen.push(["first", index]));
  socket.on("frame", ({ index }) => seen.push(["second", index]));
  socket.on("selection", () => seen.push("other"));
  latest().open();
  latest().tell({ type: "frame", reply_to: null, index: 7 });
  latest().tell({ type: "unheard of", reply_to: null });
  assert.deepEqual(seen, [["first", 7], ["second", 7]]);
});

test("a request resolves with its answer, after the handlers of that event", async () => {
  const seen = [];
  const socket = new PageSocket();
  socket.on("look", () => seen.push("handler"));
  latest().open();
  const answer = socket.request("look", { frame: 1 }).then((event) => seen.push(event.card));
  const [{ id }] = latest().sent;
  latest().tell({ type: "look", reply_to: "another", card: "not this one" });
  latest().tell({ type: "look", reply_to: id, card: "this one" });
  await answer;
  assert.deepEqual(seen, ["handler", "handler", "this one"]);
});

test("a refused request rejects with code and text; no error handler is called", async () => {
  const codes = [];
  const socket = new PageSocket();
  socket.on("error", ({ code }) => codes.push(code));
  latest().open();
  const answer = socket.request("solve", {});
  const refused = { type: "error", code: "busy", text: "wait", retry: true };
  latest().tell({ ...refused, reply_to: latest().sent[0].id });
  await assert.rejects(answer, (error) => {
    assert.ok(error instanceof Refusal);
    assert.deepEqual([error.code, error.message, error.retry], ["busy", "wait", true]);
    return true;
  });
  assert.deepEqual(codes, []);
  latest().tell({ ...refused, reply_to: "sent without waiting" });
  assert.deepEqual(codes, ["busy"]);
});

test("a broken connection rejects open requests; the page reconnects ever more slowly, in its session", async () => {
  const connections = [];
  const socket = new PageSocket();
  socket.onConnection((connected) => connections.push(connected));
  latest().open("abc");
  const answer = socket.request("look", {});
  latest().break();
  await assert.rejects(answer, { code: "offline", retry: true });
  await assert.rejects(socket.request("look", {}), { code: "offline" });
  for (const wait of [200, 400, 800, 1600, 3200, 5000, 5000]) {
    assert.equal(expire(), wait);
    latest().break();
  }
  expire();
  assert.equal(latest().address, "ws://localhost:8000/socket?session=abc");
  latest().open("abc");
  assert.deepEqual([connections[0], connections[1], connections.at(-1)], [true, false, true]);
  latest().break();
  assert.equal(expire(), 200); // quick again, once it was connected
});

test("connection handlers run before those of hello, and the session is known by then", () => {
  const seen = [];
  const socket = new PageSocket();
  socket.onConnection((connected) => seen.push(connected));
  socket.on("hello", ({ session }) => seen.push(session, socket.session));
  latest().open("xyz");
  assert.deepEqual(seen, [true, "xyz", "xyz"]);
});

test("a page of another version reloads once, then shows an error", () => {
  const texts = [];
  const socket = new PageSocket();
  socket.on("hello", () => texts.push("hello"));
  socket.on("error", ({ text }) => texts.push(text));
  latest().open("abc", 4);
  assert.equal(reloads, 1);
  assert.deepEqual(texts, []);
  latest().open("abc", 4);
  assert.equal(reloads, 1);
  assert.match(texts[0], /^This page is older than its server/);
  assert.equal(texts.length, 1);
  latest().open("abc", 3); // a later update of both
  latest().open("abc", 4);
  assert.equal(reloads, 2);
});
