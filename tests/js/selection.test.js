import assert from "node:assert/strict";
import { test } from "node:test";
import { all, severalEdits, toggled, touched, touches } from "../../semviz/annotator/page/selection.js";
import { State } from "../../semviz/annotator/page/state.js";

const mark = (id, anchor, end = null, more = {}) => ({ id, anchor, end, anchor_known: true, end_known: end !== null, frame: 5, side: "left", ...more });
const element = (id, classId, left, right) => ({ id, name: id, class_id: classId, observations: { ...(left && { left }), ...(right && { right }) } });
const proposal = (id, left) => ({ id, name: id, class_id: 0, origin: "map", is_confident: true, score: 0.9, marks: { left } });

/** Frame 5 with two poles, two signs and a proposal, and the edits that are sent. */
function page() {
  const elements = [
    element("a", 0, mark("a1", [10, 10], [10, 90]), mark("a2", [5, 10], [5, 90])),
    element("b", 0, mark("b1", [50, 10], [50, 90], { end_known: false })),
    element("s", 2, mark("s1", [30, 20])),
    element("t", 3, mark("t1", [200, 20])),
  ];
  const state = new State();
  const classes = [{ id: 0, kind: "line" }, { id: 2, kind: "point" }, { id: 3, kind: "point" }];
  state.set({
    known: { classes, images: {}, has_right: true },
    received: { frames: [{ index: 5 }], frame: { index: 5, panes: {}, elements, proposals: [proposal("q", mark("q1", [60, 10], [60, 90]))], nearby: [] } },
    frame: 5,
  });
  const edits = [], said = [];
  const actions = { submit: (edit) => edits.push(edit), notify: (text) => said.push(text), select: () => state.set({ selected: null }) };
  return { state, edits, said, several: severalEdits(state, actions) };
}

test("a segment touches a rectangle where one of its points lies inside", () => {
  let seed = 7;
  const random = () => (seed = (seed * 16807) % 2147483647) / 2147483647;
  const point = () => [Math.round(8 * random()), Math.round(8 * random())];
  for (let trial = 0; trial < 500; trial += 1) {
    const [start, end, from, to] = [point(), point(), point(), point()];
    const along = (/** @type {number} */ share) => [0, 1].map((axis) => start[axis] + share * (end[axis] - start[axis]));
    const isIn = (at) => [0, 1].every((axis) => (at[axis] - from[axis]) * (at[axis] - to[axis]) <= 1e-9);
    const steps = 840; // a multiple of all differences: corners are hit exactly
    const expected = Array.from({ length: steps + 1 }, (_, step) => along(step / steps)).some(isIn);
    if (expected) assert.ok(touches(start, end, from, to));
    assert.equal(touches(start, end, from, to), touches(end, start, to, from));
    if (!touches(start, end, from, to)) assert.ok(!expected);
  }
  assert.ok(!touches([0, 0], [4, 4], [3, 0], [4, 2.5]), "a diagonal beside a corner");
});

test("a rectangle selects what it touches in its image, a click adds one or takes it out", () => {
  const { state } = page();
  const selected = touched(state, { side: "left", from: [70, 40], to: [5, 15] });
  assert.deepEqual(selected, { element: "a", side: "left", also: ["b", "s", "q"] });
  state.set({ selected });
  assert.deepEqual(toggled(state, "b", "left"), { element: "a", side: "left", also: ["s", "q"] });
  assert.deepEqual(toggled(state, "t", "left"), { element: "t", side: "left", also: ["a", "b", "s", "q"] });
  assert.equal(touched(state, { side: "left", from: [100, 0], to: [110, 5] }), null);
  assert.deepEqual(all(state, "right"), { element: "a", side: "right", also: [] });
});

test("keys change all that they can, in one edit", () => {
  const { state, edits, said, several } = page();
  state.set({ selected: all(state, "left") });
  several.setClass(3);
  several.flag("end_known");
  several.remove();
  assert.deepEqual(edits, [
    { kind: "set class of many", element_ids: ["s"], class_id: 3 },
    { kind: "set known of many", observation_ids: ["a1"], end_known: false },
    { kind: "delete many", observation_ids: ["a1", "b1", "s1", "t1"] },
  ]);
  assert.match(said[0], /^2 of 4 stay as they are/);
  assert.deepEqual(state.selectedProposals.map(({ id }) => id), []);
});

test("hidden ends are seen again if all are hidden", () => {
  const { state, edits, several } = page();
  state.set({ selected: { element: "a", side: "left", also: ["b"] }, pending: [{ edit: { kind: "set known of many", observation_ids: ["a1"], end_known: false } }] });
  assert.ok(state.selectedObservations.every(({ observation }) => !observation.end_known), "shown at once");
  several.flag("end_known");
  assert.deepEqual(edits, [{ kind: "set known of many", observation_ids: ["a1", "b1"], end_known: true }]);
  state.set({ selected: { element: "a", side: "left" } });
  assert.equal(several.flag("end_known"), false);
  assert.equal(several.remove(), false);
  assert.equal(several.setClass(2), false);
});
