// Every command of the page with its key: the help overlay and the key handler read this one list.
import { switchTheme } from "/static/theme.js";
import { backToImages, nextPanel } from "./focus.js";
import { toggleHistory } from "./history.js";
import { jumpCommands } from "./jumps.js";
import { proposalCommands, proposing } from "./proposals.js";
import { reviewCommands } from "./review.js";
import { SIDES, other, uuid7 } from "./state.js";

/** The commands, for `Keys`. Entries without `run` are mouse gestures, listed in the help. */
export function commands(state, images, tools, actions) {
  const edit = editing(state, actions);
  const step = (by) => actions.go(neighbour(state, by));
  const toggle = (aid) => () => state.set({ aids: { ...state.aids, [aid]: !state.aids[aid] } });
  const { cursor, past, review, tour } = actions;
  const nudge = (key, du, dv) => {
    const by = (px, cursorPx) => () => {
      if (cursor.takesArrows) cursor.move(cursorPx * du, cursorPx * dv);
      else edit.nudge(px * du, px * dv);
    };
    return [
      { key, group: "Draw", title: "Nudge 0.1 px (cursor 1 px)", run: by(0.1, 1) },
      { key, shift: true, group: "Draw", title: "Nudge 1 px (cursor 10 px)", run: by(1, 10) },
      { key, ctrl: true, group: "Draw", title: "Move the cursor 0.1 px", run: () => cursor.move(0.1 * du, 0.1 * dv) },
    ];
  };
  const keyed = state.hello.classes.slice(0, 9).map((one, place) => ({ ...one, key: String(place + 1) }));
  return [
    { key: "Click", group: "Draw", title: "Pole: peak, then bottom. Sign: middle" },
    { key: "Drag", group: "Draw", title: "Sign: a box around it. Pole: in one stroke" },
    { key: "Click", shift: true, group: "Draw", title: "Draw, even on top of an element" },
    ...keyed.map(({ id, key, name }) => ({
      key, group: "Draw", title: `Class: ${name}`, row: "Class of the next element", run: () => edit.chooseClass(id),
    })),
    { key: "Escape", group: "Draw", title: "Cancel the drawing; clear the selection", run: () => {
      if (backToImages() || tools.cancel()) return;
      tour.end();
      if (!past.back() && !cursor.hide() && !review.close()) actions.select(null);
    } },

    { key: "Click element", group: "Draw", title: "Select; drag moves an end, or all of it" },
    { key: "Click element", ctrl: true, group: "Draw", title: "Select a second one, to link" },
    { key: "p", group: "Draw", title: "Link the two selected: one thing", run: edit.link },
    { key: "u", group: "Draw", title: "Unlink: this view shows another thing", run: edit.unlink },
    ...keyed.filter(({ kind }) => kind === "point").map(({ id, key, name }) => ({
      key, shift: true, group: "Draw", title: `Selected sign becomes ${name}`, row: "Class of the selected sign", run: () => edit.setClass(id),
    })),
    { key: "o", group: "Draw", title: "Bottom hidden; a proposal: all hidden", run: () => edit.hide() },
    { key: "c", group: "Draw", title: "Peak cut off, or seen again", run: () => edit.flag("anchor_known") },
    { key: "r", group: "Draw", title: "Swap peak and bottom", run: edit.swap },
    ...nudge("ArrowLeft", -1, 0), ...nudge("ArrowRight", 1, 0),
    ...nudge("ArrowUp", 0, -1), ...nudge("ArrowDown", 0, 1),
    { key: "+", group: "Draw", title: "Cursor for keys; again: a point", run: () => cursor.setPoint() },
    { key: "-", group: "Draw", title: "Cursor, or what is in hand, to the other image", run: () => {
      const { selected } = state;
      if (state.cursor || !selected) cursor.cross();
      else actions.select(selected.element, other(selected.side));
    } },
    { key: "v", group: "Draw", title: "The other end, for the arrows", run: edit.otherEnd },
    { key: "Delete", group: "Draw", title: "Delete this view of the element", run: edit.remove },
    { key: "Delete", shift: true, group: "Draw", title: "Delete the element in all frames", run: edit.removeAll },

    ...proposalCommands(state, actions, () => step(1)),

    { key: "Wheel", group: "See", title: "Zoom both images at the pointer" },
    { key: "Right drag", group: "See", title: "Pan; also middle button, or Alt" },
    { key: "z", group: "See", title: "Zoom to what is selected or asked", run: () => lookAt(state, images) },
    { key: "PageUp", group: "See", title: "Zoom in, at the cursor or the middle", run: () => images.zoomBy(1.5, state.cursor?.pixel) },
    { key: "PageDown", group: "See", title: "Zoom out", run: () => images.zoomBy(1 / 1.5, state.cursor?.pixel) },
    { key: "0", group: "See", title: "Whole image", run: () => images.fit() },
    { key: "m", group: "See", title: "Snap to edges", run: toggle("snap") },
    { key: "l", group: "See", title: "Loupe", run: toggle("loupe") },
    { key: "i", group: "See", title: "Epipolar line", run: toggle("guides") },
    { key: "g", group: "See", title: "Ghosts of mapped elements", run: toggle("ghosts") },
    { key: "b", group: "See", title: "Brightness and contrast", run: toggle("bright") },
    { key: "f", group: "See", title: "3D map; off is faster on slow machines", run: toggle("map") },

    { key: ",", group: "Frames", title: "Frame before", run: () => step(-1) },
    { key: ".", group: "Frames", title: "Frame after", run: () => step(1) },
    ...jumpCommands(state, actions),
    ...reviewCommands(review),
    { key: "Enter", group: "Frames", title: "Reviewed", run: () => edit.review("reviewed") },
    { key: "Enter", shift: true, group: "Frames", title: "Reviewed, empty", run: () => edit.review("reviewed, empty") },

    { key: "z", ctrl: true, group: "Safety", title: "Undo, also after a restart", run: () => actions.submit({ kind: "undo" }) },
    { key: "z", ctrl: true, shift: true, group: "Safety", title: "Redo", run: () => actions.submit({ kind: "redo" }) },
    { key: "h", group: "Safety", title: "History, go back to any operation", run: toggleHistory },
    { key: "b", ctrl: true, group: "Safety", title: "Name this state", run: actions.nameState },

    { key: "t", group: "Anywhere", title: "Dark or light", run: () => {
      switchTheme();
      actions.sendTheme();
    } },
    { key: "k", ctrl: true, group: "Anywhere", title: "All commands", run: actions.palette },
    { key: "?", group: "Anywhere", title: "These keys", run: actions.help },
    { key: "F1", group: "Anywhere", title: "Tour in 3 steps", run: () => tour.open() },
    { key: "F6", group: "Anywhere", title: "Next panel; Tab and arrows inside", run: () => nextPanel(1) },
    { key: "F6", shift: true, group: "Anywhere", title: "Panel before", run: () => nextPanel(-1) },
  ];
}

/** What the editing keys do with the selected observation. Each is one edit, or none. */
export function editing(state, { submit, select, look }) {
  const observation = () => state.selectedObservation;
  const kind = () => state.selectedElement && state.classOf(state.selectedElement.class).kind;
  const withPole = (run) => () => { if (observation() && kind() === "line") run(observation()); };
  return {
    chooseClass(id) {
      if (state.hello.classes.some((one) => one.id === id) && !state.drawing) state.set({ classId: id });
    },
    setClass(id) {
      const element = state.selectedElement;
      if (element && element.class !== id) submit({ kind: "set class", element_id: element.id, class_id: id });
    },
    link() {
      const { element, also } = state.selected ?? {};
      if (element && also) submit({ kind: "link", element_ids: [element, also] });
    },
    unlink() {
      if (observation()) submit({ kind: "unlink", observation_ids: [observation().id], new_element_id: uuid7() });
    },
    flag(end) {
      const { drawing } = state;
      if (drawing?.end) {
        const shown = end === "end_known" ? state.look?.snapped?.end_known : null; // what the tool says of the bottom
        const asks_bottom = drawing.asks_bottom && end !== "end_known";
        state.set({ drawing: { ...drawing, [end]: !(shown ?? drawing[end]), asks_bottom } });
        look();
      } else if (observation() && kind() === "line") {
        submit({ kind: "set known", observation_id: observation().id, [end]: !observation()[end] });
      }
    },
    hide() {
      if (state.drawing || observation()) this.flag("end_known");
      else proposing(state, { submit, select }).dismiss("occluded");
    },
    swap: withPole((one) => submit({ kind: "swap ends", observation_id: one.id })),
    otherEnd: withPole(() => state.set({ vertex: state.vertex === "anchor" ? "end" : "anchor" })),
    nudge(du, dv) {
      const one = observation();
      if (!one) return;
      const moved = { anchor: one.anchor, end: one.end };
      const [u, v] = moved[state.vertex];
      moved[state.vertex] = [u + du, v + dv];
      submit({ kind: "move", observation_id: one.id, anchor_px: moved.anchor, end_px: moved.end });
    },
    remove() {
      if (!observation()) return;
      submit({ kind: "delete", observation_id: observation().id });
      const left = SIDES.find((side) => state.selectedElement?.observations[side]);
      select(left ? state.selected.element : null);
    },
    removeAll() {
      if (!state.selectedElement) return;
      submit({ kind: "delete element", element_id: state.selectedElement.id });
      select(null);
    },
    review(verdict) {
      const now = state.labels.frames.find(({ index }) => index === state.frame).state;
      if (now !== verdict || state.pending.length) submit({ kind: "review", frame_index: state.frame, state: verdict });
    },
  };
}

/** The frame `by` places further; null at the ends. */
export function neighbour(state, by) {
  return state.order[state.order.indexOf(state.frame) + by] ?? null;
}

/** At the selection or, without one, at what an open question of the map is about. */
export function lookAt(state, images) {
  const asked = [...state.elements.map((one) => ({ ...one, ...one.observations })), ...state.offers].filter(({ id }) => state.isReviewed(id));
  const selected = state.selectedElement?.observations ?? state.selectedGhost;
  const all = selected ? [selected] : asked;
  const side = [state.selected?.side, ...SIDES].find((one) => all.some((here) => here[one]));
  const marks = all.map((here) => here[side]).filter(Boolean);
  if (marks.length) images.lookAt(marks.flatMap(({ anchor, end }) => [anchor, end]).filter(Boolean));
}
