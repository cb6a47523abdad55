import assert from "node:assert/strict";
import { beforeEach, test } from "node:test";
import { Address, flag, memberOf, numberOf, oneOf, textOf, wholeNumber, yes } from "../../semviz/inspector/page/address.js";
import { ImageModel, endState, middle, nearestOn } from "../../semviz/inspector/page/image/image_model.js";
import { MatrixModel } from "../../semviz/inspector/page/matrix/matrix_model.js";

// -- image_model

const SIZE = { width: 100, height: 50 };
const observation = (anchor, end, truth) => ({ anchor, end, truth });
const element = (id, estimate, truth, more = {}) => ({ id, name: `P-${id}`, estimate, truth, behind: false, ...more });
const pair = (observed, mapped, inlier = true) => ({ observed, mapped, inlier, start: [1, 1], vector: [2, 0], residual_px: 2 });

function frame(more = {}) {
  return {
    status: "ok",
    has_truth: true,
    observed: [observation([10, 10], [10, 40], 0), observation([30, 10], [30, 40], 2)],
    mapped: [
      element(1, [[11, 10], [11, 40]], [[10, 10], [10, 40]]),
      element(2, [[50, 10], null], [[52, 10], null]),
      element(3, null, [[30, 10], [30, 40]]),
    ],
    pairs: [pair(0, 0), pair(1, 1, false)],
    true_pairs: [pair(0, 0), pair(1, 2)],
    missed_detections: [1, 2],
    false_positives: [1],
    ...more,
  };
}

test("map elements are drawn if the pose of the mode projects them into the image", () => {
  assert.deepEqual(new ImageModel(frame(), "estimate", SIZE).mapped, [0, 1]);
  assert.deepEqual(new ImageModel(frame(), "truth", SIZE).mapped, [0, 1, 2]);
  assert.deepEqual(new ImageModel(frame({ pairs: [pair(0, 0)] }), "pairs", SIZE).mapped, [0]);
});

test("a mode without its pose is not possible, and names the key to press", () => {
  const possible = (mode, more) => new ImageModel(frame(more), mode, SIZE).isPossible;
  assert.deepEqual(["estimate", "truth", "pairs", "error"].map((mode) => possible(mode, { status: "cannot" })), [false, true, false, false]);
  assert.deepEqual(["estimate", "truth", "pairs", "error"].map((mode) => possible(mode, { has_truth: false })), [true, false, true, false]);
  assert.match(new ImageModel(frame({ status: "cannot" }), "estimate", SIZE).about, /no pose: press 2/);
});

test("detections belong to the left image; the right one shows the map only", () => {
  const right = new ImageModel(frame(), "estimate", SIZE, { mapped: [{ estimate: null, truth: null }, { estimate: [[5, 5], null], truth: null }, { estimate: null, truth: null }] });
  assert.deepEqual([right.observed, right.mapped, right.vectors, right.missedDetections, right.falsePositives], [[], [1], [], [], []]);
  assert.deepEqual(new ImageModel(frame(), "estimate", SIZE).missedDetections, [1]); // of 1 and 2, the one that is in view
});

test("vectors: residuals, correspondences, and projections from ground truth to estimate", () => {
  const vectors = (mode) => new ImageModel(frame(), mode, SIZE).vectors;
  assert.deepEqual(vectors("estimate")[0], { start: [1, 1], end: [3, 1], px: 2, fits: true });
  const [first, second] = vectors("pairs");
  assert.deepEqual([first.start, first.end, first.px, first.fits], [[10, 25], [10, 25], 0, true]);
  assert.deepEqual([second.end, second.fits], [[52, 10], false]); // matched with another than it is of
  assert.deepEqual(vectors("error").map(({ px }) => px), [1, 1, 2]);
  const broken = frame({ pairs: [{ ...pair(0, 0), start: [null, 1] }] });
  assert.deepEqual(new ImageModel(broken, "estimate", SIZE).vectors, []);
});

test("a wrong correspondence has both names", () => {
  const model = new ImageModel(frame(), "pairs", SIZE);
  assert.deepEqual([model.nameOf(0), model.nameOf(1)], ["P-1", "P-2, is P-3"]);
  assert.equal(new ImageModel(frame({ pairs: [] }), "estimate", SIZE).nameOf(1), "#1");
  assert.match(model.about, /^2 pairs, 1 outlier/);
});

test("an element that is not shown has a reason", () => {
  const model = new ImageModel(frame(), "estimate", SIZE);
  assert.equal(model.whyAbsent(1), "");
  assert.match(model.whyAbsent(3), /P-3 is outside the image/);
  assert.match(model.whyAbsent(77), /not in the submap/);
});

test("an unknown end at the border is cut, elsewhere hidden", () => {
  assert.equal(endState(true, [0, 0], SIZE), "known");
  assert.equal(endState(false, [50, 49.4], SIZE), "cut");
  assert.equal(endState(false, [0.5, 20], SIZE), "cut");
  assert.equal(endState(false, [50, 25], SIZE), "hidden");
});

test("the nearest point of an element is never beyond its ends", () => {
  assert.deepEqual(nearestOn([[0, 0], [10, 0]], [4, 3]), [4, 0]);
  assert.deepEqual(nearestOn([[0, 0], [10, 0]], [40, 3]), [10, 0]);
  assert.deepEqual(nearestOn([[0, 0], [0, 0]], [4, 3]), [0, 0]);
  assert.deepEqual(nearestOn([[2, 1], null], [4, 3]), [2, 1]);
  assert.deepEqual([middle([0, 0], [4, 2]), middle([1, 1], null)], [[2, 1], [1, 1]]);
});

// -- matrix_model

const MATRIX = { probability: [[0.7, 0.2, 0.004, 0.096], [0.1, 0.1, 0.5, 0.3], [0.2, 0.7, 0.496, 0]], rows: [0, 1], columns: [0, 1, 2] };
const matrix = () => new MatrixModel(frame(), MATRIX);

test("cells and dustbins have probabilities, ranks and words", () => {
  const model = matrix();
  assert.deepEqual([model.m, model.n, model.at(0, 1), model.at(0, null), model.at(null, 2)], [2, 3, 0.2, 0.096, 0.496]);
  assert.deepEqual([model.rank(0, 0), model.rank(0, 1), model.rank(null, 1)], [1, 2, 1]);
  assert.equal(model.describe({ of: "cell", observed: 0, mapped: 0 }), "#0 × P-1: p 0.700, 1st of its row, true, inlier");
  assert.equal(model.describe({ of: "cell", observed: 1, mapped: 1 }), "#1 × P-2: p 0.100, 3rd of its row, outlier");
  assert.equal(model.describe({ of: "cell", observed: null, mapped: 1 }), "not detected × P-2: p 0.700, 1st of its column");
});

test("candidates of a row are sorted by probability; those below half a percent are left out", () => {
  assert.deepEqual(matrix().likeliest(0), [0, 1]);
  assert.deepEqual(matrix().likeliestOf(2), [1]);
  const marks = matrix().marks.get(1);
  assert.deepEqual(marks.map(({ mapped, place, isTrue, fit }) => [mapped, place, isTrue, fit]), [[2, 1, true, undefined], [0, 2, false, undefined], [1, 3, false, false]]);
});

test("entropy is given in bits, and as a number of equally likely candidates", () => {
  const model = new MatrixModel({ ...frame(), observed: [observation([0, 0], null, null)], pairs: [] }, { probability: [[0.25, 0.25, 0.25, 0.25], [1, 0, 0, 0]], rows: [0], columns: [0, 1, 2] });
  assert.ok(Math.abs(model.row[0].entropy - 2) < 1e-12);
  assert.equal(model.row[1].entropy, 0);
  assert.match(model.describe({ of: "row", observed: 0, measure: "entropy" }), /2\.00 bits, equal to 4\.0 equally likely candidates/);
});

// -- address

let written = [];

beforeEach(() => {
  written = [];
  globalThis.addEventListener = () => {};
  globalThis.setTimeout = (what) => what();
  globalThis.clearTimeout = () => {};
  globalThis.document = {};
  const write = (kind) => (_state, _title, address) => {
    globalThis.location.search = address;
    written.push([kind, address]);
  };
  globalThis.history = { pushState: write("push"), replaceState: write("replace") };
});

/** A page at an address, with one part: a mode and an element. */
function pageAt(search, { position = 0 } = {}) {
  globalThis.location = { search };
  const values = { mode: "estimate", element: null };
  const frames = [{ index: 10, position: 0 }, { index: 11, position: 1 }, { index: 15, position: 2 }];
  const store = {
    names: ["a.rrd", "b.rrd"], isOpen: true, hasFrame: true, target: position, position,
    run: { name: "a.rrd", frames }, frame: frames[position],
  };
  const page = { store, opened: [], notices: [], gone: [], open: (...asked) => page.opened.push(asked), notice: (text) => page.notices.push(text), go: (to) => page.gone.push(to) };
  const part = {
    fields: { mode: oneOf("estimate", "truth"), element: wholeNumber() },
    get: () => ({ ...values }),
    set: (found) => Object.assign(values, found),
  };
  return { page, values, address: new Address(page, [part]) };
}

test("an address opens its run and frame, then sets the rest; initial values are not written", () => {
  const { page, values, address } = pageAt("?run=a.rrd&frame=10&mode=truth&element=7");
  address.open();
  assert.deepEqual(page.opened, [["a.rrd", 10]]);
  address.apply();
  assert.deepEqual(values, { mode: "truth", element: "7" });
  assert.deepEqual(page.notices, []);
  Object.assign(values, { mode: "estimate", element: null });
  address.changed();
  assert.equal(globalThis.location.search, "?run=a.rrd&frame=10");
});

test("unknown parts of an address are ignored and named", () => {
  const { page, values, address } = pageAt("?run=none&frame=x&mode=cats&color=red");
  address.open();
  assert.deepEqual(page.opened, [[null, null]]);
  address.apply();
  assert.deepEqual(values, { mode: "estimate", element: null });
  assert.equal(page.notices.length, 1);
  for (const part of ["run=none", "frame=x", "mode=cats", "color=red"]) assert.ok(page.notices[0].includes(part), part);
});

test("nothing is written while another frame loads", () => {
  const { page, address } = pageAt("?run=a.rrd&frame=10");
  address.open();
  address.apply();
  page.store.target = 2;
  written = [];
  address.changed();
  assert.deepEqual(written, []);
});

test("back and forward go to the run and frame of the address", () => {
  const { page, address } = pageAt("?run=a.rrd&frame=10");
  globalThis.location.search = "?run=a.rrd&frame=15";
  address.restore();
  assert.deepEqual(page.gone, [2]);
  globalThis.location.search = "?run=b.rrd&frame=3";
  address.restore();
  assert.deepEqual(page.opened, [["b.rrd", 3]]);
});

test("fields check their values", () => {
  assert.deepEqual([flag().accepts("yes"), flag().accepts("true"), flag("yes").initial], [true, false, "yes"]);
  assert.deepEqual(["0", "12", "-1", "1.5", "1".repeat(16)].map((text) => wholeNumber().accepts(text)), [true, true, false, false, false]);
  assert.equal(memberOf(() => ["a"]).accepts("b"), false);
  assert.deepEqual([yes(true), yes(false), numberOf("4"), numberOf(null), textOf(4), textOf(null)], ["yes", "no", 4, null, "4", null]);
});
