import assert from "node:assert/strict";
import { test } from "node:test";
import { Store } from "../../semviz/inspector/page/store.js";

const frameAt = (position) => ({ position, index: 10 + position });

function opened(count = 5) {
  const store = new Store();
  store.run = { name: "a", frames: Array.from({ length: count }, (_, position) => ({ index: 10 + position })) };
  store.receive(frameAt(0));
  return store;
}

test("a store without run or frame refuses to give them", () => {
  const store = new Store();
  assert.deepEqual([store.isOpen, store.hasFrame, store.position], [false, false, null]);
  assert.throws(() => store.run, /no run is open/);
  assert.throws(() => store.frame, /no frame is shown/);
});

test("stepping and playing end at the last frame of the run", () => {
  const store = opened();
  store.playing = true;
  store.setTarget(3, 100);
  assert.deepEqual([store.target, store.playing], [3, true]);
  store.setTarget(9, 110);
  assert.deepEqual([store.target, store.playing], [4, false]);
  store.setTarget(-2, 120);
  assert.equal(store.target, 0);
});

test("a frame that was left meanwhile is passed, and the last one stays", () => {
  const store = opened();
  store.setTarget(1, 100);
  store.waiting = true;
  store.setTarget(3, 110);
  assert.equal(store.receive(frameAt(1)), true); // on to the third
  assert.deepEqual([store.target, store.waiting, store.position], [3, false, 1]);
  assert.equal(store.receive(frameAt(3)), false);
  assert.equal(store.hasArrived, true);
  assert.equal(store.finishStep(150), 50); // since the first frame was left
  assert.equal(store.isStepping, false);
});

test("back to the frame shown while the next one is on its way: it arrives, and is left again", () => {
  const store = opened();
  store.setTarget(1, 100);
  store.waiting = true;
  store.setTarget(0, 110);
  assert.equal(store.hasArrived, false); // painting this frame ends nothing
  assert.equal(store.receive(frameAt(1)), true);
  assert.equal(store.target, 0);
  store.waiting = true;
  assert.equal(store.receive(frameAt(0)), false);
  assert.equal(store.hasArrived, true);
});

test("a key at the end of the run leaves no frame", () => {
  const store = opened();
  store.setTarget(-1, 100);
  assert.equal(store.isStepping, false);
});

test("another run opens at its own frame, whatever was stepped to before", () => {
  const store = opened();
  store.setTarget(3, 100);
  store.run = { name: "b", frames: store.run.frames };
  assert.equal(store.receive(frameAt(0)), false);
  assert.equal(store.target, 0);
});

test("the same run, sent again after a break, goes on to the frame stepped to", () => {
  const store = opened();
  store.setTarget(3, 100);
  store.run = { ...store.run };
  assert.equal(store.receive(frameAt(0)), true);
});

test("a frame chosen by the server stays", () => {
  const store = opened();
  assert.equal(store.receive(frameAt(4)), false);
  assert.deepEqual([store.target, store.position], [4, 4]);
});

test("after a refusal the page stays at its frame", () => {
  const store = opened();
  store.setTarget(3, 100);
  store.waiting = true;
  store.cancel();
  assert.deepEqual([store.target, store.waiting], [0, false]);
  assert.equal(store.receive(frameAt(1)), false); // refused was something else
  assert.equal(store.target, 1);
});
