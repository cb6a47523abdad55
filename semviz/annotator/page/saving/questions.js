// @ts-check
// Questions about an edit that the server refused: what they say, and what each answer does.
/** @import {annotator} from "/static/protocol" */
/** @import {Page} from "../main.js" */
/** @import {Entry, Question} from "../values.js" */
import { byId, el } from "/static/dom.js";
import { drawnAgain, find, seen, startOf } from "./pending.js";
import { differs } from "../team/two_versions.js";
import { counted, uuid7 } from "../values.js";
import { badge } from "../panels/widgets.js";

const KEYS = ["Y", "Shift Y"]; // of the first answers

/** Shows an error. An invalid edit is dropped; one that could not be saved stays in the outbox.
 *
 * @param {annotator.Events["error"]} event
 * @param {Page} page
 */
export function refused(event, page) {
  const { outbox, state } = page;
  const entry = outbox?.find(event.reply_to) ?? null;
  if (!entry) page.notify(event.text, "wrong");
  else if ("overwritten" in event) state.set({ question: overwriting(entry, event, page) });
  else if ("observation_id" in event) state.set({ question: samePlace(entry, event, page) });
  else if (event.code === "replaced") replaced(entry, event, page);
  else refusedEdit(entry, event, page);
}

/** A backup replaced the labels that an edit is about: asks once for all edits that wait.
 *
 * @param {Entry} entry
 * @param {import("/static/protocol").ErrorEvent} event
 * @param {Page} page
 */
function replaced(entry, event, page) {
  if (entry.place <= (page.outbox?.agreed ?? 0)) moveToRestored(entry, page);
  else page.state.set({ question: replacedLabels(entry, event, page) });
  page.showPending();
}

/**
 * @param {Entry} entry
 * @param {import("/static/protocol").ErrorEvent} event
 * @param {Page} page
 */
function refusedEdit(entry, { code, text, retry }, page) {
  const { outbox, state } = page;
  const staysPending = code !== "invalid" && code !== "not_found";
  const isLate = !staysPending && page.late.delete(entry.request);
  if (!staysPending) page.settle(entry.request);
  else if (retry) outbox?.retry();
  if (!staysPending || state.trouble !== text) page.notify(text, "wrong"); // once, not at every retry
  state.set({ trouble: staysPending ? text : null });
  if (isLate) state.set({ question: notMade(entry, text, state.question) });
  page.showPending();
  page.preview();
}

/** An edit that was made offline cannot be made any more: said until somebody has read it, with those before.
 *
 * @param {Entry} entry
 * @param {string} text
 * @param {Question | null} before
 * @returns {Question}
 */
function notMade(entry, text, before) {
  const texts = before?.notMade ? `${before.text}; ${text}` : `Not made, though kept while offline: ${text}`;
  return { entry, text: texts, answers: [{ title: "Read", run: () => {} }], notMade: true };
}

/** Others changed what the edit is about: whose version stays?
 *
 * @param {Entry} entry
 * @param {annotator.ConflictEvent} event
 * @param {Page} page
 * @returns {Question}
 */
function overwriting(entry, { text, overwritten, is_deleted: isDeleted, operation, author, time }, page) {
  const mine = () => {
    if (!isDeleted) {
      page.outbox?.overwrite(entry, overwritten);
      return;
    }
    const edits = editsOf(entry, page);
    const last = edits.at(-1) ?? entry; // it was made on what the others show
    for (const { request } of edits) page.settle(request);
    const again = last.shown && drawnAgain(last.edit, last.shown);
    if (again) page.outbox?.add(again, null, page.state.lastShown);
  };
  const theirs = () => (isDeleted ? page.settle(entry.request) : page.outbox?.keepTheirs(entry, overwritten));
  const ask = () => {
    const id = "observation_id" in entry.edit ? entry.edit.observation_id : "";
    const mine = find(page.state.elements, id), now = find(page.state.labels.frame?.elements ?? [], id);
    const what = mine && now ? differs(mine.observation, now.observation) : "";
    theirs();
    if (entry.edit.seen) page.submit({ kind: "note", note_id: uuid7(), element_id: entry.edit.seen.element, frame_index: entry.shown?.frame ?? null, unsure: true, text: `@${author}: ${what || "another version"}?` });
  };
  const asks = !isDeleted && entry.edit.seen && author !== page.state.workspace.author;
  const answers = [{ title: "Keep mine", run: mine }, { title: "Keep theirs", run: theirs }, ...asks ? [{ title: `Ask ${author}`, run: ask }] : []];
  return { entry, text: isDeleted ? text : `${text}. Both stay in the history.`, answers, conflict: { operation, author, time } };
}

/** The unsaved edits of the observation that `entry` edits.
 *
 * @param {Entry} entry
 * @param {Page} page
 */
function editsOf(entry, page) {
  const id = "observation_id" in entry.edit ? entry.edit.observation_id : null;
  return (page.outbox?.entries ?? []).filter(({ request, edit }) =>
    request === entry.request || (id !== null && "observation_id" in edit && edit.observation_id === id));
}

/** A drawing lies on a label of another element: are they the same?
 *
 * @param {Entry} entry
 * @param {annotator.SamePlaceEvent} event
 * @param {Page} page
 * @returns {Question}
 */
function samePlace(entry, { text, name, element_id: element, observation_id: id, anchor, end }, page) {
  const same = () => {
    page.settle(entry.request);
    page.select(element, "side" in entry.edit ? entry.edit.side : null);
    if (anchor || end) page.submit({ kind: "move", observation_id: id, anchor_px: anchor, end_px: end });
  };
  const another = () => page.outbox?.replace(entry, { .../** @type {annotator.DrawEdit} */ (entry.edit), asks_same: false });
  const discard = () => {
    page.settle(entry.request);
    page.select(element);
  };
  const answers = [
    { title: `Same: move ${name} here`, run: same }, { title: "Another element", run: another }, { title: "Discard", run: discard },
  ];
  return { entry, text, answers };
}

/** A backup replaced the labels on which edits were made while this page had no connection.
 *
 * @param {Entry} entry
 * @param {import("/static/protocol").ErrorEvent} event
 * @param {Page} page
 * @returns {Question}
 */
export function replacedLabels(entry, { text }, page) {
  const count = counted(page.outbox?.entries.length ?? 1, "edit");
  const move = () => {
    page.outbox?.agreeToRestored();
    moveToRestored(entry, page);
  };
  const answers = [
    { title: "Make them on the restored labels", run: move },
    { title: "Discard this one", run: () => page.settle(entry.request) },
  ];
  return { entry, text: `Not saved: ${text}. ${count} kept in this page.`, answers };
}

/** Makes an edit of replaced labels on the restored ones. It overwrites what looks there as it did when the
 * edit was made; of anything else it has seen nothing, so the server asks.
 *
 * @param {Entry} entry
 * @param {Pick<Page, "state" | "outbox">} page
 */
export function moveToRestored(entry, { state, outbox }) {
  const now = startOf(state.received?.frame?.elements ?? [], entry.edit);
  const looksTheSame = now && entry.edit.seen && JSON.stringify(seen(now)) === JSON.stringify(entry.edit.seen);
  outbox?.moveToRestored(entry, looksTheSame ? state.lastShown : { operation: 0 });
}

/** The bar below the images that asks; conflict.js asks where two versions are. */
export class QuestionBar {
  /** @param {Pick<Page, "state" | "keys" | "answer">} page */
  constructor(page) {
    this.page = page;
    /** @type {Question | null} */
    this.shown = null;
  }

  show() {
    const { question } = this.page.state;
    if (question === this.shown) return;
    this.shown = question;
    const bar = byId("question");
    bar.hidden = question === null || Boolean(question.conflict);
    if (!question) return;
    bar.replaceChildren(el("span", { class: "fill", text: question.text }), ...question.answers.map(({ title }, index) => {
      const key = KEYS[index];
      return el("button", { class: "small", onclick: () => this.page.answer(index) }, title, key ? badge(this.page.keys, key) : "");
    }));
  }
}
