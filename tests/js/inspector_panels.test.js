import assert from "node:assert/strict";
import { test } from "node:test";
import { SameElement } from "../../semviz/inspector/page/compare/same_element.js";
import { Scatter } from "../../semviz/inspector/page/compare/scatter_drawing.js";
import { severity } from "../../semviz/inspector/page/frames.js";
import { MatrixLayout } from "../../semviz/inspector/page/matrix/matrix_layout.js";
import { worstPerPixel } from "../../semviz/inspector/page/timeline/timeline.js";
import { TimelineAxes } from "../../semviz/inspector/page/timeline/timeline_drawing.js";
import { wanted } from "../../semviz/web/static/virtual_list.js";

// -- frames

test("worst first: overconfident, over a metre, no pose, ambiguous, then by error", () => {
  const row = (status, errorM, overconfident = false) => ({ status, error_m: errorM, overconfident });
  const worstFirst = [
    row("ok", 5, true), row("ok", 2, true), row("ambiguous", 9), row("ambiguous", 3),
    row("cannot", null), row("ambiguous", 0.4), row("ambiguous", null), row("ok", 0.3), row("ok", null),
  ];
  const values = worstFirst.map(severity);
  assert.deepEqual(values, [...values].sort((a, b) => b - a));
  assert.equal(new Set(values).size, values.length);
});

// -- timeline

test("every frame is hit where it is drawn, and errors are drawn within the panel", () => {
  const axes = new TimelineAxes(500, 80, 7, 35);
  for (let position = 0; position < 7; position += 1) assert.equal(axes.positionAt(axes.x(position)), position);
  assert.deepEqual([axes.positionAt(-10), axes.positionAt(9999)], [0, 6]);
  assert.equal(axes.topM, 100); // a whole decade
  assert.ok(axes.y(100) < axes.y(1) && axes.y(1) < axes.y(0.01));
  assert.equal(axes.y(1e-9), axes.floor);
});

test("of the frames that share a pixel the worst is drawn, and none is left out where there is room", () => {
  const frames = Array.from({ length: 1000 }, (_, at) => ({ status: at % 97 === 5 ? "cannot" : "ok", error_m: 0.001 * (at % 10), overconfident: at === 501 }));
  const drawn = worstPerPixel(frames, 0.1);
  assert.equal(drawn.length, 100);
  assert.ok(drawn.some(({ position }) => position === 501));
  for (const { row, position } of drawn) assert.equal(row, frames[position]);
  const lost = new Set(frames.flatMap(({ status }, at) => (status === "cannot" ? [Math.floor(at / 10)] : [])));
  assert.equal(drawn.filter(({ row }) => row.status === "cannot").length, lost.size - (lost.has(50) ? 1 : 0));
  assert.equal(worstPerPixel(frames, 2).length, 1000);
});

// -- a long list

test("a long list has the rows that are visible in the page, wherever it is scrolled", () => {
  assert.deepEqual(wanted(0, 500, 26, 300), [0, 300]);
  for (let top = 0; top <= 26 * 100_000 - 500; top += 9_999) {
    const [first, end] = wanted(top, 500, 26, 100_000);
    assert.ok(first <= top / 26 && end >= Math.min(100_000, (top + 500) / 26));
    assert.ok(end - first < 150 && first >= 0 && end <= 100_000);
  }
});

// -- matrix_layout

const MODEL = {
  observed: [{ class_id: 0 }, { class_id: 1 }, { class_id: 1 }],
  mapped: [{ class_id: 1 }, { class_id: 0 }, { class_id: 0 }, { class_id: 1 }],
  rows: [0, 1, 2],
  columns: [1, 2, 0, 3],
};

test("cells, dustbins, names, sums and entropies are hit where they are drawn", () => {
  const layout = new MatrixLayout(MODEL, 400, 260);
  const middleOf = (i, j) => [layout.x(j) + layout.columns.size / 2, layout.y(i) + layout.rows.size / 2];
  for (const i of MODEL.rows) {
    for (const j of MODEL.columns) assert.deepEqual(layout.find(middleOf(i, j)), { of: "cell", observed: i, mapped: j });
  }
  const [x, y] = middleOf(1, 2);
  assert.deepEqual(layout.find([layout.bin.x + 1, y]), { of: "cell", observed: 1, mapped: null });
  assert.deepEqual(layout.find([x, layout.bin.y + 1]), { of: "cell", observed: null, mapped: 2 });
  assert.deepEqual(layout.find([2, y]), { of: "row", observed: 1, measure: undefined });
  assert.deepEqual(layout.find([layout.sum.x + 1, y]), { of: "row", observed: 1, measure: "sum" });
  assert.deepEqual(layout.find([x, layout.entropy.y + 1]), { of: "column", mapped: 2, measure: "entropy" });
  assert.equal(layout.find([layout.bin.x + 1, layout.bin.y + 1]), null); // where both dustbins meet
});

test("classes are separated by a gap, and a large matrix scrolls", () => {
  const layout = new MatrixLayout(MODEL, 400, 260);
  const gap = layout.x(0) - layout.x(2) - layout.columns.size; // the first of class 1 follows the last of class 0
  assert.ok(gap > 0);
  assert.deepEqual(layout.columns.blocks.map(({ class: kind, first, count }) => [kind, first, count]), [[0, 0, 2], [1, 2, 2]]);
  const many = { ...MODEL, mapped: Array(300).fill({ class_id: 0 }), columns: Array.from({ length: 300 }, (_, j) => j) };
  const narrow = new MatrixLayout(many, 400, 260);
  assert.ok(narrow.needs.width > 400);
  narrow.scrollTo(500, 0);
  assert.ok(narrow.columns.visible(500).length < 300);
  const [first] = narrow.columns.visible(500).slice(1);
  assert.equal(narrow.find([narrow.x(first) + 1, narrow.y(0) + 1])?.mapped, first);
});

// -- compare

const compared = (change, a, b) => ({ change, a: { status: a === null ? "cannot" : "ok", error_m: a }, b: { status: b === null ? "cannot" : "ok", error_m: b } });

test("the scatter has whole decades, and a margin for frames without a pose", () => {
  const scatter = new Scatter([compared("broken", 0.02, 30), compared("same", 0.5, 0.5), compared("fixed", null, 0.1), { ...compared("same", null, null), a: { status: "ok", error_m: null } }]);
  assert.deepEqual([scatter.frames.length, scatter.low, scatter.high, scatter.lacks], [3, -2, 2, { a: true, b: false }]);
  assert.equal(scatter.frames.at(-1).change, "broken"); // on top
  const layout = scatter.layout(400, 300);
  for (const frame of scatter.frames) {
    const [x, y] = layout.at(frame);
    assert.ok(x > 0 && x < 400 && y > 0 && y < 300);
  }
  const [bad, good] = [layout.at(compared("same", 1, 10)), layout.at(compared("same", 1, 1))];
  assert.ok(bad[1] < good[1]); // a larger error in B stands higher
  assert.ok(layout.at(compared("same", null, 1))[0] > layout.right);
});

test("an element keeps its identity across runs with different numbers in their maps", () => {
  const same = new SameElement();
  same.use({ 7: 3 });
  assert.deepEqual([same.inBase(7), same.inBase(8), same.inBase(null)], [3, 8, null]);
  assert.deepEqual([same.inOther(3), same.inOther(8)], [7, 8]);
  same.chosen = { element: null, base_element: 5 }; // only A has it
  assert.equal(same.inBase(null), 5);
  const frame = { observed: [{ class_id: 1, anchor: [4, 5] }], mapped: [{ id: 3 }], pairs: [{ observed: 0, mapped: 0 }] };
  same.chosen = null;
  const seen = same.selection({ observed: 1, element: 7 }, { observed: [{ class_id: 1, anchor: [0, 0] }, { class_id: 1, anchor: [4, 5] }] }, frame);
  assert.deepEqual(seen, { observed: 0, element: 3 }); // seen at the same place
  assert.deepEqual(same.selection({ observed: null, element: 7 }, frame, frame), { observed: 0, element: 3 }); // matched with it
  assert.deepEqual(same.selection({ observed: null, element: 9 }, frame, frame), { observed: null, element: 9 });
});
