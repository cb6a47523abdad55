import assert from "node:assert/strict";
import { test } from "node:test";
import { TrackActions } from "../../semviz/annotator/page/tracks/track_actions.js";
import { classWord, parseFilter } from "../../semviz/annotator/page/tracks/track_filter.js";

const classes = ["pole", "rectangular sign", "rectangular box", "light gantry"].map((name, id) => ({ id, name }));
const row = (class_id, attributes = {}) => ({ class_id, attributes, name: "P-01", notes: [] });

/** Which of the rows a filter leaves. */
function left(text, rows) {
  const filter = parseFilter(text, classes, new Map());
  assert.equal(filter.fault, "");
  return rows.map((each) => filter.conditions.every((holds) => holds(each, null, [0, 0])));
}

test("a class is found by its name with underscores, and by the word of its chip alone", () => {
  const rows = classes.map(({ id }) => row(id));
  assert.deepEqual(left("class:light_gantry", rows), [false, false, false, true]);
  assert.deepEqual(left("class:rect", rows), [false, true, true, false]);
  for (const kind of classes) {
    assert.deepEqual(left(`class:${classWord(kind, classes)}`, rows), classes.map(({ id }) => id === kind.id));
  }
});

test("an attribute is found by name and value", () => {
  const rows = [row(0, { "sign code": "de205" }), row(0, { "sign code": "de206", lamp: "yes" }), row(0)];
  assert.deepEqual(left("attr:sign_code=de205", rows), [true, false, false]);
  assert.deepEqual(left("attr:sign_code=DE", rows), [true, true, false]);
  assert.deepEqual(left("attr:lamp", rows), [false, true, false]);
  assert.match(parseFilter("attr:", classes, new Map()).fault, /attr:material=steel/);
});

test("tracks of a detector to look at first are found, and all that the filter leaves are rejected after a preview", () => {
  const open = (number, doubt) => ({ ...row(0), id: `track ${number}`, number, doubt });
  const rows = [open(-1, ""), open(-2, "2.8 px off"), open(-3, "2 frames only"), { ...row(0), number: 7, doubt: "" }];
  assert.deepEqual(left("look-first", rows), [false, true, true, false]);
  const said = [], sent = [];
  const tracks = {
    row: rows[1], shown: rows, range: null, filterText: "", places: 9, details: null,
    table: { isIn: () => true },
    state: { set() {}, lastShown: 0 },
    page: { notify: (text) => said.push(text), submit: (edit) => sent.push(edit) },
  };
  const actions = new TrackActions(tracks);
  actions.toggleUnsure(); // Shift X without a filter would reject the whole drive
  assert.match(said[0], /reject all 3 open tracks: filter first/);
  Object.assign(tracks, { filterText: "look-first", shown: rows.slice(1) });
  actions.toggleUnsure();
  assert.equal(actions.pending.text, "Reject 2 tracks: no map will have them.");
  assert.deepEqual(sent, []);
  actions.apply();
  assert.deepEqual(sent, [{ kind: "reject tracks", track_ids: ["track -2", "track -3"] }]);
});
