// Puts the page together: server, outbox, images, pen, keys and panels.
import { byId } from "/static/dom.js";
import { showScene } from "/static/scene.js";
import { Socket } from "/static/socket.js";
import { currentTheme, startTheme } from "/static/theme.js";
import { commands, editing, lookAt } from "./commands.js";
import { Cursor } from "./cursor.js";
import { Effort } from "./effort.js";
import { watchLists } from "./focus.js";
import { History } from "./history.js";
import { Images } from "./images.js";
import { Light } from "./light.js";
import { Outbox } from "./outbox.js";
import { Panels } from "./panels.js";
import { Past } from "./past.js";
import { Pictures } from "./pictures.js";
import { Review } from "./review.js";
import { Sketch } from "./sketch.js";
import { SIDES, State, drawnAgain, isIdle, seen, startOf, spaced } from "./state.js";
import { Tour } from "./tour.js";
import { Tools } from "./tools.js";
import { showHelp } from "/static/help.js";
import { Keys } from "/static/keys.js";
import { showPalette } from "/static/palette.js";

startTheme();
const state = new State();
const keys = new Keys("annotate");
let sought = new URLSearchParams(location.search).get("element"); // a name, such as P-04
const images = new Images(state, { left: byId("left-image"), right: byId("right-image") }, (name) => keys.shown(name));
const pictures = new Pictures();
const effort = new Effort();
const looking = { waiting: false, again: false };
let outbox = null;
let sketch = null;
let session = "";
let pictures3d = null;

/** Keeps an edit and sends it; the page shows it at once. One that changes nothing is dropped. */
function submit(edit) {
  if (!mayEdit()) return;
  if (isIdle(state.elements, edit)) return;
  pictures3d?.hold(false);
  const start = startOf(state.elements, edit);
  if (start) outbox.add({ ...edit, seen: seen(start) }, { frame: state.frame, side: start.side, class: start.element.class });
  else outbox.add(edit);
  if (edit.kind === "draw") {
    state.set({ selected: { element: edit.element_id, side: edit.side }, vertex: "anchor" });
  }
  refreshPending();
}

/** Whether labels can be changed now; says why not. */
function mayEdit() {
  if (state.past) panels.tell(`This is the state after operation ${spaced(state.past.operation)}: Esc goes back to now.`, "wrong");
  return !state.past;
}

/** The server has an edit on disk, or nobody wants it any more. */
function settle(request) {
  outbox.settle(request);
  if (state.conflict?.entry.request === request) state.set({ conflict: null });
}

/** Somebody else changed what an edit starts from: both versions are there, one is chosen. */
function resolve(isMine) {
  const { entry, theirs } = state.conflict;
  const { request, edit, shown } = entry;
  if (isMine && theirs) {
    outbox.replace(entry, { ...edit, seen: theirs });
  } else {
    settle(request);
    const again = isMine && drawnAgain(edit, shown);
    if (again) outbox.add(again);
  }
  state.set({ conflict: null });
  refreshPending();
}

function refreshPending() {
  state.set({ pending: outbox.entries });
}

/** Asks for guides and numbers of what is in hand; one question at a time, the last one counts. */
function look() {
  if (state.past) return; // guides and numbers are of now
  if (looking.waiting) {
    looking.again = true;
    return;
  }
  looking.waiting = socket.send({ type: "look", look: inHand() });
}

function inHand() {
  const { drawing, dragged, selected } = state;
  const known = selected && !state.pending.some(({ edit }) => edit.element_id === selected.element);
  return {
    frame_index: state.frame,
    selected_id: known ? selected.element : null,
    side: selected?.side ?? "left",
    drawing: drawing && {
      side: drawing.side,
      class_id: drawing.class,
      anchor_px: drawing.anchor,
      end_px: drawing.end,
      anchor_known: drawing.anchor_known,
      end_known: drawing.end_known,
      snap: state.aids.snap && !drawing.box,
      asks_bottom: state.aids.snap && drawing.asks_bottom,
    },
    moved: dragged ? { [dragged.observation]: [dragged.anchor, dragged.end] } : {},
  };
}

/** Shows frame `index`; what is selected stays so, to be continued there. */
function go(index) {
  if (!state.hello || index === null) return;
  const order = state.order;
  if (!order.includes(index)) return;
  tools.cancel();
  state.set({ frame: index, look: null });
  history.replaceState(null, "", `?frame=${index}`);
  socket.send({ type: "go", frame: index });
  pictures3d?.hold(true);
  showPictures(index);
  look();
}

/** The images of the frame on screen; the neighbours' are fetched ahead. */
async function showPictures(index) {
  await Promise.all(SIDES.map(async (side) => {
    const pane = state.panes[side];
    const { bitmap, message } = pane
      ? await pictures.get(pane.frame, pane.side)
      : { bitmap: null, message: "No right camera, and no other frame with a pose to match with." };
    if (state.frame === index) images.show(side, index, bitmap, message);
  }));
  release();
  const place = state.order.indexOf(index);
  for (const near of [state.order[place + 1], state.order[place - 1]]) {
    if (near === undefined) continue;
    pictures.get(near, "left");
    if (state.hasRight) pictures.get(near, "right");
  }
}

/** The 3D pane draws again, one picture after what the page is about to paint. */
function release() {
  requestAnimationFrame(() => requestAnimationFrame(() => pictures3d?.release()));
}

const received = {
  hello(message) {
    const first = state.hello === null;
    state.hello = message;
    keys.use(commands(state, images, tools, commanded));
    outbox ??= new Outbox(message.key, (one) => socket.send(one));
    const frames = message.state.frames;
    state.set({ labels: { ...message.state, frame: state.labels?.frame ?? null } });
    refreshPending();
    panels.start();
    light.start();
    images.fit();
    const asked = Number(new URLSearchParams(location.search).get("frame") ?? frames[0].index);
    const known = frames.some(({ index }) => index === asked);
    go(first ? (known ? asked : frames[0].index) : state.frame);
    if (first) {
      sketch = new Sketch(state, message.key);
      sketch.restore();
    }
    outbox.flush();
    sendTheme();
  },
  frame({ frame }) {
    state.set({ labels: { ...state.labels, frame } });
    if (!state.hasRight && frame.index === state.frame) showPictures(frame.index); // the companion is known now
    look();
    findSought();
  },
  facts({ frames }) {
    state.set({ labels: { ...state.labels, frames: merged(frames) } });
  },
  news(message) {
    take(message);
    look();
  },
  "on disk"({ request, operation }) {
    state.set({ onDisk: { request, operation } });
    release();
  },
  saved(message) {
    const sent = outbox.entries.find(({ request }) => request === message.request);
    settle(message.request);
    take(message, { pending: outbox.entries, trouble: null });
    const isDrawing = sent?.edit.kind === "draw" || sent?.edit.kind === "accept";
    const isInHand = isDrawing && state.selected?.element === sent.edit.element_id;
    if (message.element && (isInHand || !isDrawing)) {
      state.set({ selected: { element: message.element, side: state.selected?.side ?? "left" } });
    }
    effort.saved(message.added);
    panels.tell(message.note);
    if (message.frame.index !== state.frame && isStep(sent)) go(message.frame.index);
    else look();
  },
  conflict({ request, text, theirs }) {
    const entry = outbox.entries.find((one) => one.request === request);
    if (entry) state.set({ conflict: { entry, text, theirs } });
  },
  refused({ request, text, kept }) {
    if (kept) outbox.retry();
    else settle(request);
    if (!kept || state.trouble !== text) panels.tell(text, "wrong"); // once, not at every retry
    state.set({ trouble: kept ? text : null, pending: outbox.entries });
    look();
  },
  past(message) {
    past.received(message);
  },
  review(message) {
    review.received(message);
  },
  history(message) {
    operations.received(message);
  },
  look({ look: answer }) {
    looking.waiting = false;
    state.set({ look: state.past ? null : answer });
    if (!looking.again) return;
    looking.again = false;
    look();
  },
  scene() {
    pictures3d = showScene(byId("scene"), session, keys);
  },
  select({ element }) {
    select(element);
  },
  error({ text }) {
    looking.waiting = false;
    panels.tell(text, "wrong");
  },
};

/** Takes over what an operation changed, together with `more` fields of the state. */
function take({ state: news, frame }, more = {}) {
  const frames = merged(news.frames);
  const mine = frame.index === state.frame ? frame : state.labels.frame;
  state.set({ labels: { ...news, frames, frame: mine }, ...more });
}

/** The list of all frames with some of them anew. */
function merged(some) {
  const changed = new Map(some.map((one) => [one.index, one]));
  return state.labels.frames.map((one) => changed.get(one.index) ?? one);
}

function sendTheme() {
  state.set({ theme: currentTheme() });
  socket.send({ type: "theme", theme: state.theme });
}

const isStep = (sent) => sent?.edit.kind === "undo" || sent?.edit.kind === "redo";

/** Whoever comes from the inspector finds the element named in the address selected, and large. */
function findSought() {
  const found = sought && state.elements.find(({ name }) => name === sought);
  if (!found) return;
  sought = null;
  select(found.id);
  lookAt(state, images);
}

/** Selects an element on the side where it can be seen. */
function select(element, side = null) {
  const here = state.elements.find((one) => one.id === element)?.observations ?? {};
  const shown = side ?? (here.left || !here.right ? "left" : "right");
  state.set({ selected: element ? { element, side: shown } : null, vertex: "anchor" });
  look();
}

const actions = {
  submit, mayEdit, look, go, select, resolve,
  stepReview: (list, by) => review.step(list, by),
  sayReviewed: () => editing(state, actions).review("reviewed"),
};
const tools = new Tools(state, images, actions);
const send = (message) => socket.send(message);
const past = new Past(state, keys, { send, submit, look });
const operations = new History(state, keys, past, { go, send, submit });
const review = new Review(state, keys, { go, select, send, submit, fit: () => images.fit(), tell: (...said) => panels.tell(...said) });
const light = new Light(state);
const tour = new Tour(state, keys);
const help = () => showHelp(keys, "Keys", [{ text: "Tour in 3 steps", run: () => tour.open() }]);
const palette = () => showPalette(keys);
const panels = new Panels(state, images, keys, { ...actions, help }, [past, operations, light, review, tour]);
const commanded = { ...actions, cursor: new Cursor(state, images, tools), help, nameState: () => operations.startNaming(), palette, past, review, sendTheme, tour };
keys.onchange = () => state.set({ changedKeys: keys.changed });
keys.listen(window);
watchLists();

window.semviz = { state, looking }; // for scripts that drive the page

const socket = new Socket({
  onmessage: (message) => received[message.type]?.(message),
  onsession: (id) => {
    session = id;
  },
  onstate: (connected) => {
    looking.waiting = false;
    if (!connected) outbox?.disconnected();
    state.set({ connected, theme: currentTheme(), trouble: null });
  },
});
