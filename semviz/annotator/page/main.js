// @ts-check
// Connects the parts of the page: server, outbox, images, tools, keys and panels.
/** @import {annotator} from "/static/protocol" */
/** @import {Edit, Entry, Side} from "./values.js" */
import { byId } from "/static/dom.js";
import { showHelp } from "/static/help.js";
import { Keys } from "/static/keys.js";
import { showPalette } from "/static/palette.js";
import { showScene } from "/static/scene.js";
import { PageSocket, Refusal } from "/static/socket.js";
import { currentTheme, startTheme } from "/static/theme.js";
import { Light } from "./aids.js";
import { Attributes } from "./attributes.js";
import { Backdrop } from "./backdrop.js";
import { commands, editing, zoomToSelection } from "./commands.js";
import { Conflict } from "./conflict.js";
import { Cursor } from "./cursor.js";
import { Sketch } from "./drafts.js";
import { Drive } from "./drive.js";
import { Effort } from "./effort.js";
import { Filmstrip } from "./filmstrip.js";
import { watchLists } from "./focus.js";
import { History } from "./history.js";
import { Images } from "./images.js";
import { Outbox } from "./outbox.js";
import { Panels } from "./panels.js";
import { Past } from "./past.js";
import { draftOf, isIdle, seen, startOf } from "./pending.js";
import { People } from "./people.js";
import { Pictures } from "./pictures.js";
import { Poses } from "./poses.js";
import { moveToRestored, overwriting, replacedLabels, samePlace } from "./questions.js";
import { Review } from "./review.js";
import { SecondChoice, inAddress, wishInAddress } from "./second.js";
import { State } from "./state.js";
import { Team } from "./team.js";
import { Tools } from "./tools.js";
import { Tour } from "./tour.js";
import { Tracks } from "./tracks.js";
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
    this.soughtName = new URLSearchParams(location.search).get("element"); // for example P-04, or the id of a track
    this.isPreviewing = false;
    this.previewAgain = false;
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
    this.#showPending();
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
    this.#showPending();
    return true;
  }

  /** Requests guides and numbers of the draft; one request at a time, the latest state wins. */
  async preview() {
    if (this.state.past) return; // guides and numbers belong to the present state
    this.previewAgain = this.isPreviewing;
    if (this.isPreviewing) return;
    this.isPreviewing = true;
    do {
      this.previewAgain = false;
      await this.#previewOnce();
    } while (this.previewAgain);
    this.isPreviewing = false;
  }

  async #previewOnce() {
    try {
      const { frame, subject } = this.state;
      const { preview } = await this.socket.request("preview_draft", { draft: draftOf(this.state) });
      this.state.set({ preview: this.state.past ? null : preview, previewed: { frame, subject } });
    } catch (refusal) {
      if (!(refusal instanceof Refusal)) throw refusal;
      if (refusal.code !== "offline") this.notify(refusal.message, "wrong");
    }
  }

  /** Shows frame `index`; the selection stays, so that the element can be continued there.
   *
   * @param {number | null} index
   */
  go(index) {
    const { state } = this;
    if (!state.isReady || index === null || !state.order.includes(index)) return;
    this.tools.cancel();
    state.set({ frame: index, preview: null });
    const { wish, view } = state;
    window.history.replaceState(null, "", `?frame=${index}${inAddress(wish)}${view === "images" ? "" : `&view=${view}`}${this.tracks.inAddress()}`);
    this.socket.send("go_to_frame", { frame: index, second: wish });
    this.sceneGate?.hold(true);
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
      state.set({ onDisk: request === null ? null : { request, operation } });
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
    socket.on("error", (event) => this.#refused(event));
  }

  /** @param {annotator.WorkspaceEvent} event */
  #begin({ workspace, labels }) {
    const { state } = this;
    const isFirst = !state.isReady;
    state.set({ known: workspace, received: { ...labels, frame: state.received?.frame ?? null } });
    const ofImages = this.views.ofImages(commands(state, this.images, this.tools, this));
    this.keys.use([...ofImages, ...this.views.commands(), ...this.conflict.commands(), ...this.people.commands(), ...this.filmstrip.commands(), ...this.tracks.commands(), ...this.poses.commands(), ...this.team.commands(), ...this.drive.commands()]);
    const outbox = (this.outbox ??= new Outbox(workspace.key, (entry) => this.#send(entry)));
    this.#showPending();
    this.panels.start();
    this.light.start();
    this.images.fit();
    const view = new URLSearchParams(location.search).get("view"); // going to a frame writes the address anew
    this.go(isFirst ? this.#firstFrame(labels.frames) : state.frame);
    if (isFirst) this.views.openNamed(view);
    if (isFirst) new Sketch(state, workspace.key).restore();
    outbox.flush();
    this.sendTheme();
    this.backdrop.start();
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
    state.set({ received: { ...state.labels, frame } });
    if (!state.knowsPanes && frame.index === state.frame) this.#showPictures(frame.index); // the second image is known now
    this.preview();
    this.#selectSought();
  }

  /** @param {annotator.EditSavedEvent} event */
  #saved({ reply_to: request, labels, frame, element, added, note }) {
    const { state, outbox } = this;
    const edit = outbox?.find(request)?.edit;
    if (request !== null) this.settle(request);
    this.#take(labels, frame, { pending: outbox?.entries ?? [], trouble: null });
    const isDrawing = edit?.kind === "draw" || edit?.kind === "accept";
    const isSelected = edit?.kind === "draw" && state.selected?.element === edit.element_id;
    if (element && (isSelected || !isDrawing)) {
      state.set({ selected: { element, side: state.selected?.side ?? "left" } });
    }
    this.effort.saved(added);
    this.notify(note);
    const isStep = edit?.kind === "undo" || edit?.kind === "redo";
    if (frame.index !== state.frame && isStep) this.go(frame.index);
    else this.preview();
  }

  /** Shows an error. An invalid edit is dropped; one that could not be saved stays in the outbox.
   *
   * @param {annotator.Events["error"]} event
   */
  #refused(event) {
    const entry = this.outbox?.find(event.reply_to) ?? null;
    if (!entry) this.notify(event.text, "wrong");
    else if ("overwritten" in event) this.state.set({ question: overwriting(entry, event, this) });
    else if ("observation_id" in event) this.state.set({ question: samePlace(entry, event, this) });
    else if (event.code === "replaced") this.#replaced(entry, event);
    else this.#refusedEdit(entry, event);
  }

  /** A backup replaced the labels that an edit is about: asks once for all edits that wait.
   *
   * @param {Entry} entry
   * @param {import("/static/protocol").ErrorEvent} event
   */
  #replaced(entry, event) {
    if (entry.place <= (this.outbox?.agreed ?? 0)) moveToRestored(entry, this);
    else this.state.set({ question: replacedLabels(entry, event, this) });
    this.#showPending();
  }

  /**
   * @param {Entry} entry
   * @param {import("/static/protocol").ErrorEvent} event
   */
  #refusedEdit(entry, { code, text, retry }) {
    const staysPending = code !== "invalid" && code !== "not_found";
    if (!staysPending) this.settle(entry.request);
    else if (retry) this.outbox?.retry();
    if (!staysPending || this.state.trouble !== text) this.notify(text, "wrong"); // once, not at every retry
    this.state.set({ trouble: staysPending ? text : null });
    this.#showPending();
    this.preview();
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

  #showPending() {
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
    for (const near of [state.order[rank + 1], state.order[rank - 1]]) {
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

startTheme(() => page.sendTheme());
const page = new Page();
Object.assign(window, { semviz: page }); // for scripts that drive the page
