import assert from "node:assert/strict";
import { test } from "node:test";
import { about, cell, decided, diffLines, listRows, nextOpen, openSure, passName } from "../../semviz/inspector/page/over_time/model.js";

const change = (kind, name, more = {}) => ({ kind, name, story: `${kind} story`, existence: 0.02, ...more });
const CHANGES = [change("vanished", "P-01"), change("vanished", "P-02"), change("new", "n-01"), change("moved", "T-03"), change("unsure", "R-04")];
const answers = (...rows) => new Map(rows.map(([name, answer]) => [name, { name, answer, author: "mara", time: "2026-05-12T08:00:00", label: answer === "label" ? "frame 21 of may" : "" }]));

test("changes are listed by kind, each kind under its title with its number", () => {
  const rows = listRows(CHANGES, null).map(({ kind, count, change: one }) => one?.name ?? `${kind} ${count}`);
  assert.deepEqual(rows, ["vanished 2", "P-01", "P-02", "new 1", "n-01", "moved 1", "T-03", "unsure 1", "R-04"]);
  assert.deepEqual(listRows(CHANGES, "moved").map(({ change: one }) => one?.name), [undefined, "T-03"]);
});

test("what is unsure is never decided with the sure ones, and what is decided is not decided again", () => {
  assert.deepEqual(openSure(CHANGES, answers(["P-02", "keep"])), ["P-01", "n-01", "T-03"]);
});

test("the next open change goes round, and there is none when all are decided", () => {
  const some = answers(["P-02", "keep"], ["n-01", "make"]);
  assert.equal(nextOpen(CHANGES, some, "P-01"), "T-03");
  assert.equal(nextOpen(CHANGES, some, "R-04"), "P-01");
  assert.equal(nextOpen(CHANGES, some, null), "P-01");
  assert.equal(nextOpen(CHANGES, answers(...CHANGES.map(({ name }) => [name, "keep"])), "P-01"), null);
});

test("words and marks say what a decision does to the map", () => {
  const all = answers(["P-01", "make"], ["n-01", "make"], ["T-03", "label"], ["R-04", "keep"]);
  assert.deepEqual(CHANGES.map((one) => decided(one, all)), ["remove", "open", "add", "wants label", "keep"]);
  assert.deepEqual(diffLines(CHANGES, all).map(({ mark }) => mark), ["-", "+", "?", "="]);
  assert.match(diffLines(CHANGES, all)[2].text, /^T-03 {2}label, frame 21 of may/);
});

test("a miss counts only where an element was in view, and none before a new one was there", () => {
  const states = (row) => row.seen.map((_, at) => cell(row, at).state);
  const seen = [0, 0, 4], chances = [0, 7, 9];
  assert.deepEqual(states({ seen, chances, kind: "vanished", since: 1 }), ["hidden", "missed", "seen"]);
  assert.deepEqual(states({ seen, chances, kind: "new", since: 2 }), ["hidden", "absent", "seen"]);
  assert.deepEqual(states({ seen, chances, kind: "moved", since: 2 }), ["hidden", "missed", "moved"]);
  assert.deepEqual(states({ seen, chances }), ["hidden", "missed", "seen"]);
});

test("a pass is called by its date, unless another one has the same", () => {
  const pass = (run, date) => ({ run, date, frames: 30, sure: 28 });
  const passes = [pass("a", "2026-03-03"), pass("b", "2026-05-12"), pass("c", "2026-05-12"), pass("d", "")];
  assert.deepEqual(passes.map((one) => passName(one, passes)), ["3 Mar", "b", "c", "d"]);
  assert.equal(about(passes.slice(0, 2), 1284), "2 passes, 3 Mar – 12 May 2026, 1,284 elements, 56 sure frames");
});
