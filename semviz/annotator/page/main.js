// @ts-check
// Connects the parts of the page: server, outbox, images, tools, keys and panels.
/** @import {annotator} from "/static/protocol" */
/** @import {Edit, Entry, Side} from "./values.js" */
import { byId } from "/static/dom.js";
import { showHelp } from "/static/help.js";
import { Keys } from "/static/keys.js";
import { showPalette } from "/static/palette.js";
import { showScene } from "/static/scene.js";
import { PageSocket } from "/static/socket.js";
import { currentTheme, startTheme } from "/static/theme.js";
import { Light } from "./images/aids.js";
import { Attributes } from "./panels/attributes.js";
import { Backdrop } from "./backdrop.js";
import { commands, editing, zoomToSelection } from "./commands.js";
import { Conflict } from "./saving/conflict.js";
import { Cursor } from "./images/cursor.js";
import { Sketch } from "./images/drafts.js";
import { Drive } from "./drive/drive.js";
import { Effort } from "./effort.js";
import { Filmstrip } from "./filmstrip/filmstrip.js";
import { watchLists } from "./panels/focus.js";
import { History } from "./history/history.js";
import { Images } from "./images/images.js";
import { Outbox } from "./saving/outbox.js";
import { Panels } from "./panels/panels.js";
import { Past } from "./history/past.js";
import { isIdle, seen, startOf } from "./saving/pending.js";
import { People } from "./team/people.js";
import { Pictures } from "./images/pictures.js";
import { Poses } from "./poses/poses.js";
import { Previews } from "./images/previews.js";
import { refused } from "./saving/questions.js";
import { Remembered } from "./saving/remembered.js";
import { Review } from "./panels/review.js";
import { SecondChoice, inAddress, wishInAddress } from "./images/second.js";
import { State } from "./state.js";
import { Team } from "./team/team.js";
import { Tools } from "./images/tools.js";
import { Tour } from "./tour.js";
import { Tracks } from "./tracks/tracks.js";
import { SIDES, spaced } from "./values.js";
import { Views } from "./views.js";

export class Page {
  constructor() {
    this.state = new State();
    this.keys = new Keys("annotate");
    this.pictures = new Pictures();
    this.effort = new Effort();
    this.images = new Images(
      this.state,
      { left: byId("left-image"), right: byId("right-image") },
      (name) => this.keys.shown(name),
    );
    /** @type {Outbox | null} */
    this.outbox = null; // once the workspace is known
    /** @type {import("/static/scene.js").RenderGate | null} */
    this.sceneGate = null;
    /** @type {Set<string>} */
    this.late = new Set(); // requests that waited for the connection: their person has gone on since
    this.soughtName = new URLSearchParams(location.search).get("element"); // for example P-04, or the id of a track
    this.remembered = new Remembered(this.state);
    this.previews = new Previews(this.state, this);
    /** @type {PageSocket<annotator.Requests, annotator.Events>} */
    this.socket = new PageSocket();
    this.#listen();

    this.tools = new Tools(this.state, this.images, this);
    this.cursor = new Cursor(this.state, this.images, this.tools);
    this.past = new Past(this.state, this.keys, this);
    this.history = new History(this.state, this.keys, this.past, this);
    this.review = new Review(this.state, this.keys, this);
    this.light = new Light(this.state);
    this.backdrop = new Backdrop(this.state, this.keys, this);
    this.tour = new Tour(this.state, this.keys);
    this.state.wish = wishInAddress(location.search);
    this.second = new SecondChoice(this.state, this.keys, this);
    this.poses = new Poses(this.state, this.keys, this);
    this.drive = new Drive(this.state, this.keys, this);
    this.filmstrip = new Filmstrip(this.state, this.keys, this);
    this.tracks = new Tracks(this.state, this.keys, this);
    this.conflict = new Conflict(this);
    this.people = new People(this.state, this);
    this.team = new Team(this.state, this.keys, this);
    /** @type {Views} */
    this.views = new Views(this.state, this.keys, this, { filmstrip: this.filmstrip, tracks: this.tracks, poses: this.poses, team: this.team, drive: this.drive });
    this.panels = new Panels(this.state, this.images, this.keys, this, [new Attributes(this.state, this), this.backdrop, this.past, this.history, this.light, this.review, this.conflict, this.tour, this.second, this.people, this.views, this.filmstrip, this.tracks, this.poses, this.team, this.drive]);
    this.keys.onchange = () => this.state.set({ changedKeys: this.keys.changed });
    this.keys.listen(window);
    watchLists();
  }

  // -- called by the parts of the page

  /** Stores and sends an edit; the page shows it at once. An edit that changes nothing is dropped.
   *
   * @param {Edit} edit
   * @param {{operation: number, hash: string}} since the last operation that was shown when the edit was begun
   */
  submit(edit, since = this.state.lastShown) {
    const { state, outbox } = this;
    if (!outbox || !this.mayEdit() || isIdle(state.elements, edit)) return;
    const before = state.connected ? "" : shownLabels(state);
    this.sceneGate?.hold(false);
    const start = startOf(state.elements, edit);
    const isStored = start
      ? outbox.add({ ...edit, seen: seen(start) }, { frame: state.frame, side: start.side, second: state.second, class: start.element.class_id }, since)
      : outbox.add(edit, null, since);
    if (!isStored) {
      this.notify("Not kept: the browser has no room for more unsaved edits. Connect to the server first.", "wrong");
      return;
    }
    this.people.told(state.frame);
    if (edit.kind === "draw") {
      state.set({ selected: { element: edit.element_id, side: edit.side }, vertex: "anchor" });
    }
    this.showPending();
    if (!state.connected && shownLabels(state) === before) this.notify("Kept here: it shows when the server is back.");
  }

  /** Whether labels can be changed now; if not, a message says why. */
  mayEdit() {
    const { past, workspace } = this.state;
    if (workspace.role === "look") {
      this.notify("You may look at these labels, and not change them: who invited you can change that.", "wrong");
      return false;
    }
    if (past) this.notify(`This is the state after operation ${spaced(past.operation)}: press Esc to return.`, "wrong");
    return !past;
  }

  /** Answers the question about a refused edit. Returns whether there was one.
   *
   * @param {number} index of the answer
   */
  answer(index) {
    const { question } = this.state;
    const answer = question?.answers.at(index);
    if (!answer) return false;
    if (!this.mayEdit()) return true;
    this.state.set({ question: null });
    answer.run();
    this.showPending();
    return true;
  }

  preview() {
    this.previews.ask();
  }

  /** Sends what a person asks for; without a connection, a message says that it was not done.
   *
   * @template {keyof annotator.Requests & string} Type
   * @param {Type} type
   * @param {Omit<annotator.Requests[Type], "type" | "id">} fields
   */
  ask(type, fields) {
    const isSent = this.socket.send(type, fields);
    if (!isSent) this.notify("Offline: not done. Try again when the server is back.", "wrong");
    return isSent;
  }

  /** Shows frame `index`; the selection stays, so that the element can be continued there.
   *
   * @param {number | null} index
   */
  go(index) {
    const { state } = this;
    if (!state.isReady || index === null || !state.order.includes(index)) return;
    this.tools.cancel();
    const selected = state.isSeveral && index !== state.frame ? null : state.selected; // several are of one frame
    state.set({ frame: index, preview: null, selected });
    const { wish, view } = state;
    window.history.replaceState(null, "", `?frame=${index}${inAddress(wish)}${view === "images" ? "" : `&view=${view}`}${this.tracks.inAddress()}`);
    this.sceneGate?.hold(true);
    this.#load(index);
  }

  /** Asks for labels, images and numbers of a frame.
   *
   * @param {number} index
   */
  #load(index) {
    this.remembered.recall();
    this.socket.send("go_to_frame", { frame: index, second: this.state.wish });
    this.#showPictures(index);
    this.preview();
  }

  /** Selects an element; without `side`, on a side where it is labelled.
   *
   * @param {string | null} element
   * @param {Side | null} side
   */
  select(element, side = null) {
    /** @type {import("./values.js").Observations} */
    const here = this.state.elements.find(({ id }) => id === element)?.observations ?? {};
    const shown = side ?? (here.left || !here.right ? "left" : "right");
    const chosen = { element: element ?? "", frame: this.state.frame ?? -1 };
    this.state.set({ selected: element ? { element, side: shown } : null, vertex: "anchor", chosen });
    this.preview();
  }

  /** Shows a message below the images for a few seconds.
   *
   * @param {string} text
   * @param {string} [kind]
   */
  notify(text, kind) {
    this.panels.notify(text, kind);
  }

  /**
   * @param {annotator.ReviewEntry["list_name"]} list
   * @param {-1 | 0 | 1} by
   */
  stepReview(list, by) {
    this.review.step(list, by);
  }

  markReviewed() {
    editing(this.state, this).review("reviewed");
  }

  nameState() {
    this.history.startNaming();
  }

  help() {
    showHelp(this.keys, "Keys", [{ text: "Tour in 3 steps", run: () => this.tour.open() }]);
  }

  palette() {
    showPalette(this.keys);
  }

  sendTheme() {
    const theme = currentTheme();
    this.state.set({ theme });
    this.socket.send("set_theme", { theme });
  }

  // -- events of the server

  #listen() {
    const { socket, state } = this;
    socket.onConnection((connected) => {
      if (!connected) this.outbox?.disconnected();
      state.set({ connected, theme: currentTheme(), trouble: null });
      this.remembered.recall(); // the labels of this frame may have been on their way
    });
    socket.on("workspace", (event) => this.#begin(event));
    socket.on("label_file", ({ state: file, text }) => state.set({ labelFile: { state: file, text } }));
    socket.on("frame", ({ frame }) => this.#showFrame(frame));
    socket.on("frame_list", ({ frames }) => {
      if (state.isReady) state.set({ received: { ...state.labels, frames: this.#merged(frames) } });
    });
    socket.on("update", ({ labels, frame }) => {
      if (!state.isReady) return; // it was sent before the workspace, which brings all
      this.#take(labels, frame);
      this.preview();
      this.#selectSought(); // its map may have been read only now
    });
    socket.on("saved_operation", ({ reply_to: request, operation }) => {
      if (request !== null) this.outbox?.saw(request, operation);
      state.onDisk = request === null ? null : { request, operation };
      if (state.isReady) this.panels.topBar.showSaved(); // nothing else: its labels follow, and drawing them takes longer
      this.#release();
    });
    socket.on("edit_saved", (event) => this.#saved(event));
    socket.on("past_frame", ({ past }) => this.past.received(past));
    socket.on("operations", ({ operations }) => this.history.received(operations));
    socket.on("named_states", ({ states }) => this.history.receivedNames(states));
    socket.on("review", ({ review }) => this.review.received(review));
    socket.on("scene", () => {
      this.sceneGate = showScene(byId("scene", HTMLIFrameElement), socket.session, this.keys);
    });
    socket.on("element_clicked", ({ element, is_track: isTrack }) => {
      if (isTrack) this.review.open("tracks", element);
      else this.select(element);
    });
    socket.on("error", (event) => refused(event, this));
  }

  /** @param {annotator.WorkspaceEvent} event */
  #begin({ workspace, labels }) {
    const { state } = this;
    const isFirst = !state.isReady;
    state.set({ known: workspace, received: { ...labels, frame: state.received?.frame ?? null } });
    const ofImages = this.views.ofImages(commands(state, this.images, this.tools, this));
    this.keys.use([...ofImages, ...this.views.commands(), ...this.conflict.commands(), ...this.people.commands(), ...this.filmstrip.commands(), ...this.tracks.commands(), ...this.poses.commands(), ...this.team.commands(), ...this.drive.commands()]);
    const outbox = (this.outbox ??= new Outbox(workspace.key, (entry) => this.#send(entry)));
    this.showPending();
    this.panels.start();
    this.light.start();
    if (isFirst) this.#open(labels.frames);
    else if (state.frame !== null) this.#load(state.frame); // connected again: zoom, selection and drawing stay
    if (!isFirst) this.late = new Set(outbox.entries.map(({ request }) => request));
    outbox.flush();
    this.sendTheme();
    this.backdrop.start();
  }

  /** Shows what the address names.
   *
   * @param {annotator.FrameSummary[]} frames
   */
  #open(frames) {
    this.images.fit();
    const view = new URLSearchParams(location.search).get("view"); // going to a frame writes the address anew
    this.go(this.#firstFrame(frames));
    this.views.openNamed(view);
    new Sketch(this.state, this.state.workspace.key).restore();
  }

  /** The frame named in the address, if it exists; else the first.
   *
   * @param {annotator.FrameSummary[]} frames
   */
  #firstFrame(frames) {
    const requested = Number(new URLSearchParams(location.search).get("frame") ?? frames[0].index);
    return frames.some(({ index }) => index === requested) ? requested : frames[0].index;
  }

  /** @param {annotator.LabelledFrameView} frame */
  #showFrame(frame) {
    const { state } = this;
    if (frame.index !== state.frame) return; // somebody has gone on, and may have come back to what is shown
    state.set({ received: { ...state.labels, frame } });
    if (!state.knowsPanes) this.#showPictures(frame.index); // the second image is known now
    this.preview();
    this.#selectSought();
  }

  /** @param {annotator.EditSavedEvent} event */
  #saved({ reply_to: request, labels, frame, element, added, note }) {
    const { state, outbox } = this;
    const edit = outbox?.find(request)?.edit;
    const isLate = request !== null && this.late.delete(request);
    if (request !== null) this.settle(request);
    this.#take(labels, frame, { pending: outbox?.entries ?? [], trouble: null });
    const isDrawing = edit?.kind === "draw" || edit?.kind === "accept";
    const isSelected = edit?.kind === "draw" && state.selected?.element === edit.element_id;
    if (element && (isSelected || (!isDrawing && !isLate))) {
      state.set({ selected: { element, side: state.selected?.side ?? "left" } });
    }
    this.effort.saved(added);
    this.notify(note);
    const isStep = edit?.kind === "undo" || edit?.kind === "redo";
    if (frame.index !== state.frame && isStep && !isLate) this.go(frame.index);
    else this.preview();
  }

  // -- pending edits

  /** @param {Entry} entry */
  #send({ request, edit: { seen: start, ...edit }, base }) {
    const unknown = start ? { operation: 0, known: [] } : null; // kept by an earlier version of the page
    return this.socket.send("apply_edit", { edit, base: base ?? unknown }, request);
  }

  /** Removes an edit that is on disk or was given up.
   *
   * @param {string} request
   */
  settle(request) {
    this.outbox?.settle(request);
    if (this.state.question?.entry.request === request) this.state.set({ question: null });
  }

  /** Shows the edits that wait. */
  showPending() {
    this.state.set({ pending: this.outbox?.entries ?? [] });
  }

  // -- contents of the page

  /** Takes over the changes of an operation, together with `more` fields of the state.
   *
   * @param {annotator.LabelsView} labels
   * @param {annotator.LabelledFrameView | null} frame null: as it was
   * @param {Partial<State>} more
   */
  #take(labels, frame, more = {}) {
    this.previews.forget();
    const shown = frame && frame.index === this.state.frame ? frame : this.state.labels.frame;
    this.state.set({ received: { ...labels, frames: this.#merged(labels.frames), frame: shown }, ...more });
  }

  /** The list of all frames with `some` of them replaced.
   *
   * @param {annotator.FrameSummary[]} some
   */
  #merged(some) {
    const changed = new Map(some.map((frame) => [frame.index, frame]));
    return this.state.labels.frames.map((frame) => changed.get(frame.index) ?? frame);
  }

  /** Shows the images of a frame, then loads those of its neighbours.
   *
   * @param {number} index
   */
  async #showPictures(index) {
    const { state, pictures } = this;
    await Promise.all(SIDES.map(async (side) => {
      const pane = state.panes[side];
      const { bitmap, message } = pane
        ? await pictures.get(pane.frame, pane.side)
        : { bitmap: null, message: "No right camera, and no other frame with a pose." };
      if (state.frame === index) this.images.show(side, index, bitmap, message);
    }));
    this.#release();
    const rank = state.order.indexOf(index);
    for (const near of [1, -1, 2].map((by) => state.order[rank + by])) {
      if (near === undefined) continue;
      pictures.get(near, "left");
      if (state.knowsPanes) pictures.get(near, "right");
    }
  }

  /** Lets the 3D pane draw again, one frame after the page has painted. */
  #release() {
    requestAnimationFrame(() => requestAnimationFrame(() => this.sceneGate?.release()));
  }

  /** Selects the element named in the address and zooms to it: the inspector links to it. */
  #selectSought() {
    const shown = [...this.state.elements, ...this.state.proposals];
    const element = this.soughtName && shown.find(({ id, name }) => name === this.soughtName || id === this.soughtName);
    if (!element) return;
    this.soughtName = null;
    this.select(element.id);
    zoomToSelection(this.state, this.images);
  }
}

/** What the images show, to see whether an edit shows.
 *
 * @param {State} state
 */
const shownLabels = ({ elements, proposals }) => JSON.stringify([elements, proposals]);

startTheme(() => page.sendTheme());
const page = new Page();
Object.assign(window, { semviz: page }); // for scripts that drive the page
