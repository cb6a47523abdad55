import assert from "node:assert/strict";
import { webcrypto } from "node:crypto";
import { test } from "node:test";
import { editing } from "../../semviz/annotator/page/commands.js";
import { drawnAgain, isIdle, seen, standing, startOf, withPending } from "../../semviz/annotator/page/saving/pending.js";
import { acceptedTracks, proposing } from "../../semviz/annotator/page/proposals.js";
import { State } from "../../semviz/annotator/page/state.js";
import { shownScore, spaced, uuid7 } from "../../semviz/annotator/page/values.js";

globalThis.crypto ??= webcrypto;

const mark = (id, more = {}) => ({ id, anchor: [10, 20], end: [10, 90], anchor_known: true, end_known: true, ...more });
const saved = (id, side, more = {}) => mark(id, { frame: 5, side, ...more });
const pole = (observations) => ({ id: "p", name: "P-01", class_id: 0, observations, views: 1, review_decisions: [] });
const proposalMark = (id, side, more = {}) => ({ ...saved(id, side), score: 0.9, runner_up: null, ...more });
const proposal = (marks, more = {}) => ({
  id: "q", name: "P-02", class_id: 0, origin: "map", depth_m: 12, rejected_elsewhere: false, is_confident: true, score: 0.9, marks, ...more,
});

/** A state on frame 5 with what the server has calls of it. */
function stateWith({ elements = [], proposals = [], nearby = [] } = {}) {
  const state = new State();
  const panes = { left: { frame: 5, side: "left" }, right: { frame: 5, side: "right" } };
  const classes = [{ id: 0, name: "pole", kind: "line" }, { id: 3, name: "sign", kind: "point" }];
  state.set({
    known: { name: "w", key: "k", classes, images: {}, has_right: true },
    received: { frames: [{ index: 4 }, { index: 5 }, { index: 9 }], frame: { index: 5, panes, elements, proposals, nearby, is_searching: false } },
    frame: 5,
  });
  return state;
}

test("an element that was selected is drawn in its own class, until another one is chosen", () => {
  const element = { ...pole({ left: saved("o", "left") }), class_id: 0 };
  const state = stateWith({ elements: [element], proposals: [proposal({ left: proposalMark("m", "left") }, { class_id: 3 })] });
  state.set({ classId: 3, selected: { element: "p", side: "left" } });
  assert.equal(state.nextClass("right"), 3, "it only stayed selected");
  state.set({ chosen: { element: "p", frame: 5 } });
  assert.equal(state.nextClass("right"), 0);
  assert.equal(state.nextClass("left"), 3, "it is labelled there: what is drawn is another one");
  state.set({ classId: 0, selected: { element: "q", side: "left" }, chosen: { element: "q", frame: 5 } });
  assert.equal(state.nextClass("left"), 3);
  editing(state, { submit() {}, select() {}, notify() {}, preview() {} }).chooseClass(0);
  assert.equal(state.nextClass("left"), 0);
});

test("moves, flags, swaps and deletions show at once, without changing the saved labels", () => {
  const elements = [pole({ left: saved("o", "left") })];
  const before = structuredClone(elements);
  const after = (edit) => withPending(elements, [{ edit: { observation_id: "o", ...edit } }], 5)[0]?.observations.left;
  assert.deepEqual(after({ kind: "move", anchor_px: [1, 2], end_px: [3, 4] }), saved("o", "left", { anchor: [1, 2], end: [3, 4] }));
  assert.deepEqual(after({ kind: "move", anchor_px: [1, 2], end_px: null }).end, [10, 90]);
  assert.deepEqual(after({ kind: "set known", end_known: false }), saved("o", "left", { end_known: false }));
  assert.deepEqual(after({ kind: "swap ends" }), saved("o", "left", { anchor: [10, 90], end: [10, 20] }));
  assert.equal(after({ kind: "delete" }), undefined);
  assert.deepEqual(elements, before);
});

test("an element disappears with its last observation", () => {
  const both = [pole({ left: saved("o", "left"), right: saved("r", "right") })];
  const without = (...ids) => withPending(both, ids.map((id) => ({ edit: { kind: "delete", observation_id: id } })), 5);
  assert.deepEqual(Object.keys(without("o")[0].observations), ["right"]);
  assert.deepEqual(without("o", "r"), []);
});

test("a drawing shows only in its frame, once, with the name of an accepted proposal", () => {
  const draw = { kind: "draw", observation_id: "n", element_id: "q", frame_index: 5, side: "left", class_id: 0, anchor_px: [1, 2], end_px: [1, 9] };
  const [shown] = withPending([], [{ edit: draw }], 5);
  assert.deepEqual([shown.name, shown.class_id, shown.unsaved, shown.observations.left.anchor], ["new", 0, true, [1, 2]]);
  assert.deepEqual(withPending([], [{ edit: draw }], 6), []);
  assert.equal(withPending([], [{ edit: draw }, { edit: draw }], 5).length, 1);
  assert.equal(withPending([], [{ edit: draw }], 5, [proposal({})])[0].name, "P-02");
  const accept = { kind: "accept", marks: [{ ...draw, side: "right", element_id: "p" }] };
  const [known] = withPending([pole({ left: saved("o", "left") })], [{ edit: accept }], 5);
  assert.deepEqual(Object.keys(known.observations).sort(), ["left", "right"]);
});

test("an edit that changes nothing is idle", () => {
  const elements = [pole({ left: saved("o", "left") })];
  const move = { kind: "move", observation_id: "o", anchor_px: [10, 20], end_px: [10, 90] };
  assert.equal(isIdle(elements, move), true);
  assert.equal(isIdle(elements, { ...move, anchor_px: [10, 20.1] }), false);
  assert.equal(isIdle(elements, { kind: "undo" }), false);
  assert.equal(isIdle(elements, { ...move, observation_id: "another" }), false);
});

test("an edit names the observation that it changes, if that is on disk", () => {
  const elements = [pole({ left: saved("o", "left"), right: mark("n") })];
  const start = startOf(elements, { kind: "delete", observation_id: "o" });
  assert.deepEqual(seen(start), {
    element: "p", frame: 5, side: "left", anchor: [10, 20], end: [10, 90], anchor_known: true, end_known: true,
  });
  assert.equal(startOf(elements, { kind: "delete", observation_id: "n" }), null);
  assert.equal(startOf(elements, { kind: "undo" }), null);
});

test("an edit kept over a deletion is drawn again; a deletion is not", () => {
  const start = { element: "p", frame: 5, side: "left", anchor: [10, 20], end: [10, 90], anchor_known: true, end_known: true };
  const shown = { frame: 5, side: "left", class: 0 };
  const again = drawnAgain({ kind: "move", observation_id: "o", anchor_px: [1, 2], end_px: [3, 4], seen: start }, shown);
  assert.deepEqual([again.kind, again.anchor_px, again.end_px, again.class_id, again.selected_id], ["draw", [1, 2], [3, 4], 0, "p"]);
  assert.notEqual(again.observation_id, "o");
  assert.equal(drawnAgain({ kind: "delete", observation_id: "o", seen: start }, shown), null);
});

test("a proposal disappears as its marks are labelled, accepted or rejected", () => {
  const marks = { left: proposalMark("l", "left"), right: proposalMark("r", "right") };
  const sides = (state) => state.proposals.map((one) => Object.keys(one.marks));
  const state = stateWith({ proposals: [proposal(marks)] });
  assert.deepEqual(sides(state), [["left", "right"]]);
  state.set({ pending: [{ edit: { kind: "dismiss", dismissals: [{ id: "l" }] } }] });
  assert.deepEqual(sides(state), [["right"]]);
  state.set({ pending: [{ edit: { kind: "accept", marks: [{ observation_id: "r", frame_index: 7 }, { observation_id: "l", frame_index: 7 }] } }] });
  assert.deepEqual(sides(state), []);
  const labelled = { ...pole({ left: saved("o", "left") }), id: "q" };
  assert.deepEqual(sides(stateWith({ elements: [labelled], proposals: [proposal(marks)] })), [["right"]]);
});

test("a track is accepted or rejected in every image, with the corrections made so far", () => {
  const track = { frames: 9, first: 1, last: 11, residual_px: 0.8 };
  const state = stateWith({ proposals: [proposal({ left: proposalMark("a", "left"), right: proposalMark("b", "right") }, { origin: "detector", track })] });
  state.set({ corrected: new Map([["a", { track: "q", anchor: [1, 2], end: [3, 4] }], ["x", { track: "another", anchor: [0, 0], end: null }]]) });
  assert.deepEqual(state.proposals[0].marks.left.anchor, [1, 2]);
  const edit = acceptedTracks(state, ["q"]);
  assert.deepEqual(edit.corrections, [{ observation_id: "a", anchor_px: [1, 2], end_px: [3, 4] }]);
  state.set({ pending: [{ edit }] });
  assert.deepEqual(state.proposals, []);
  assert.deepEqual(state.elements[0].observations.left.anchor, [1, 2]);
  assert.deepEqual(state.elements[0].observations.right.anchor, [10, 20]);
  state.set({ pending: [{ edit: { kind: "reject tracks", track_ids: ["q"] } }] });
  assert.deepEqual([state.proposals, state.elements], [[], []]);
});

test("what is left out of maps is hidden unless it is selected", () => {
  const state = stateWith({ elements: [{ ...pole({ left: saved("o", "left") }), left_out: true }] });
  assert.equal(state.isHidden(state.elements[0]), true);
  state.set({ selected: { element: "p", side: "left" } });
  assert.equal(state.isHidden(state.elements[0]), false);
});

test("sure tracks are accepted when the key is pressed again after the question", () => {
  const state = stateWith();
  state.received.map = { tracks: 5, sure_tracks: 3 };
  const done = [];
  const press = () => proposing(state, { submit: (edit) => done.push(edit), notify: (text) => done.push(text), select() {} }).acceptSureTracks();
  press();
  press();
  assert.deepEqual(done, ["3 of 5 open tracks are sure. Press again to accept them in one operation.", { kind: "accept sure tracks", count: 3 }]);
  press();
  state.asked.until = 0;
  press();
  assert.equal(done.length, 4);
  assert.equal(typeof done[3], "string");
});

test("a mark can be swapped with its runner-up, and back", () => {
  const second = { ...mark("x"), anchor: [50, 60], score: 0.4 };
  delete second.id;
  const state = stateWith({ proposals: [proposal({ left: proposalMark("l", "left", { runner_up: second }) })] });
  state.set({ swapped: new Set(["l"]) });
  const { left } = state.proposals[0].marks;
  assert.deepEqual([left.id, left.anchor, left.score, left.runner_up.anchor, left.runner_up.score], ["l", [50, 60], 0.4, [10, 20], 0.9]);
  state.set({ swapped: new Set() });
  assert.deepEqual(state.proposals[0].marks.left.anchor, [10, 20]);
});

test("keys act on the proposal under the pointer, else on the selected one, else on the first", () => {
  const two = [proposal({ left: proposalMark("l", "left") }, { id: "a" }), proposal({ left: proposalMark("m", "left") }, { id: "b", is_confident: false })];
  const state = stateWith({ proposals: two });
  assert.equal(state.currentProposal.id, "a");
  state.set({ selected: { element: "b", side: "left" } });
  assert.equal(state.currentProposal.id, "b");
  state.set({ pointed: "a" });
  assert.equal(state.currentProposal.id, "a");
  assert.deepEqual(state.confidentProposals.map(({ id }) => id), ["a"]);
  state.set({ aids: { ...state.aids, proposals: false } });
  assert.equal(state.currentProposal, null);
  assert.deepEqual(state.confidentProposals, []);
});

test("a drag shows at once; an earlier state shows neither drags nor pending edits", () => {
  const state = stateWith({ elements: [pole({ left: saved("o", "left") })] });
  state.set({ dragged: { observation: "o", anchor: [1, 1], end: [2, 2] }, selected: { element: "p", side: "left" } });
  assert.deepEqual(state.selectedObservation.anchor, [1, 1]);
  assert.equal(state.selectedObservation.id, "o");
  const before = [pole({ left: saved("o", "left", { anchor: [7, 7] }) })];
  state.set({ past: { operation: 1, done: null, frame: { index: 5, panes: {}, elements: before, proposals: [], nearby: [], is_searching: false } } });
  assert.deepEqual(state.selectedObservation.anchor, [7, 7]);
});

test("nothing is shown of another frame's labels", () => {
  const state = stateWith({ elements: [pole({ left: saved("o", "left") })], proposals: [proposal({ left: proposalMark("l", "left") })] });
  state.set({ frame: 9 });
  assert.deepEqual([state.elements, state.proposals, state.nearby], [[], [], []]);
  assert.deepEqual(state.panes, { left: { frame: 9, side: "left", camera: "" }, right: { frame: 9, side: "right", camera: "" } });
  assert.deepEqual(state.order, [4, 5, 9]);
});

test("every change calls each listener once; labels can be read only after they arrive", () => {
  const state = new State();
  let calls = 0;
  state.onChange(() => (calls += 1));
  state.set({ frame: 1, classId: 3 });
  assert.equal(calls, 1);
  assert.equal(state.isReady, false);
  assert.throws(() => state.labels, /not arrived yet/);
  assert.deepEqual(state.elements, []);
});

test("ids sort by time of creation and have the form that the server expects", () => {
  const now = Date.now;
  try {
    const made = [0, 1, 2 ** 33, 2 ** 40].map((ms) => {
      Date.now = () => ms;
      return uuid7();
    });
    for (const id of made) assert.match(id, /^[0-9a-f]{8}-[0-9a-f]{4}-7[0-9a-f]{3}-[89ab][0-9a-f]{3}-[0-9a-f]{12}$/);
    assert.deepEqual(made.toSorted?.() ?? [...made].sort(), made);
  } finally {
    Date.now = now;
  }
});

test("numbers are formatted for people", () => {
  assert.deepEqual([0, 999, 4213, 1234567].map(spaced), ["0", "999", "4 213", "1 234 567"]);
  assert.deepEqual([0.798, 0.8, 1].map(shownScore), ["0.79", "0.80", "1.00"]);
});

test("undo and redo among unsaved edits take back the last one, or the one they name", () => {
  const entry = (request, kind, more = {}) => ({ request, edit: { kind, ...more } });
  const left = (...pending) => standing(pending).map(({ request }) => request).join("");
  const [a, b, undo, redo] = [entry("a", "draw"), entry("b", "move"), entry("u", "undo"), entry("r", "redo")];
  assert.equal(left(a, b, undo), "a");
  assert.equal(left(a, b, undo, undo, redo), "a");
  assert.equal(left(a, undo, b, redo), "b");
  assert.equal(left(undo, a), "a"); // of an edit on disk
  assert.equal(left(a, b, entry("u", "undo", { request: "a" })), "b");
});

test("edits that wait show in a frame whose labels are not known, and an earlier state shows none", () => {
  const state = stateWith();
  const edit = { kind: "draw", observation_id: "o", element_id: "e", frame_index: 9, side: "left", anchor_px: [1, 2], end_px: null, class_id: 3 };
  state.set({ frame: 9, pending: [{ edit }] });
  assert.deepEqual(state.elements.map(({ id }) => id), ["e"]);
  assert.equal(state.isUnknown, true);
  state.set({ connected: true });
  assert.equal(state.isUnknown, false);
  state.set({ past: { operation: 1, frame: { index: 5, elements: [] } } });
  assert.deepEqual(state.elements, []);
});
