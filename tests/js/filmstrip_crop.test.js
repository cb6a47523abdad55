import assert from "node:assert/strict";
import { test } from "node:test";
import { cropOf, dragged, inCrop } from "../../semviz/annotator/page/filmstrip/filmstrip_crop.js";

const POLE = { anchor: [100, 20], end: [104, 220], anchor_known: true, end_known: true };
const SIGN = { anchor: [300, 50], end: null, anchor_known: true, end_known: false };
const SIZE = [180, 100];

test("a whole pole is in its crop, and 2 px across it are 6 on the screen", () => {
  const crop = cropOf(POLE, 10, 1241, SIZE);
  for (const end of [POLE.anchor, POLE.end]) {
    const [x, y] = inCrop(crop, end);
    assert.ok(x > 0 && x < SIZE[0] && y > 0 && y < SIZE[1]);
  }
  assert.ok(crop.zoom[0] >= 3);
});

test("a leaning pole is in its crop, too", () => {
  const crop = cropOf({ ...POLE, end: [250, 220] }, 10, 1241, SIZE);
  assert.ok(inCrop(crop, [250, 220])[0] < SIZE[0]);
});

test("a far sign is enlarged more than a near one, and lies in the middle", () => {
  const [far, near] = [60, 5].map((depth) => cropOf(SIGN, depth, 1241, SIZE));
  assert.ok(far.zoom[0] > near.zoom[0]);
  assert.deepEqual(inCrop(far, SIGN.anchor), [90, 50]);
});

test("a drag near an end of a pole moves that end, elsewhere all of it; by pixels of the image", () => {
  const crop = cropOf(POLE, 10, 1241, SIZE);
  const [top, bottom] = [inCrop(crop, POLE.anchor), inCrop(crop, POLE.end)];
  const by = ([x, y]) => [x + 2 * crop.zoom[0], y];
  assert.deepEqual(dragged(crop, POLE, top, by(top)), { ...POLE, anchor: [102, 20] });
  assert.deepEqual(dragged(crop, POLE, bottom, by(bottom)), { ...POLE, end: [106, 220] });
  const middle = [90, 50];
  assert.deepEqual(dragged(crop, POLE, middle, by(middle)), { ...POLE, anchor: [102, 20], end: [106, 220] });
  assert.deepEqual(dragged(cropOf(SIGN, 60, 1241, SIZE), SIGN, [0, 0], [0, 0]), SIGN);
});
