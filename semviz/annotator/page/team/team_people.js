// @ts-check
// The people of the view "Team": who has what, how far each is, and where everybody is.
/** @import {annotator} from "/static/protocol" */
/** @import {Child} from "/static/dom.js" */
/** @import {Team} from "./team.js" */
import { el, svg } from "/static/dom.js";
import { initials } from "./people.js";
import { counted, spaced } from "../values.js";
import { header } from "../panels/widgets.js";

/** A time in a narrow column. @type {Intl.DateTimeFormatOptions} */
const WHEN = { month: "numeric", day: "numeric", hour: "numeric", minute: "2-digit" };
const LEGEND = [["done", "reviewed"], ["work", "in work"], ["open", "assigned"], ["twice", "labelled twice, blind"], ["here", "is there now"]];

/** The rows of people.
 *
 * @param {Team} team
 * @param {annotator.TeamView} known
 * @returns {Child[]}
 */
export function peopleRows(team, known) {
  const { state } = team;
  const pace = known.done_on ? `; at this pace done on ${day(known.done_on)}` : "";
  const about = `${spaced(known.reviewed)} of ${counted(state.order.length, "frame")} reviewed${pace}`;
  const alone = `You label alone. In a terminal: semviz annotate ${state.workspace.name} --invite NAME makes an address to send.`;
  return [
    header("Who has what", about),
    ...known.people.map((person) => personRow(team, person)),
    known.people.length > 1 ? null : el("p", { class: "dim team-text", text: alone }),
    el("p", { class: "team-legend dim" }, ...LEGEND.map(([kind, text]) => el("span", {}, svg("svg", { class: "team-bar", width: 22, height: 10 }, part(kind, "0", "100%", 0, 10)), text))),
  ];
}

/**
 * @param {Team} team
 * @param {annotator.TeamPerson} person
 */
function personRow(team, { name, ranges, assigned, reviewed, pace, edits, last, done_on: done }) {
  const { state, page } = team;
  const present = page.people.known.find((person) => person.name === name);
  const here = present?.frames ?? [], element = present?.element ?? "";
  const isMe = name === state.workspace.author;
  const both = !isMe && element !== "" && element === state.selectedElement?.name && here.includes(state.frame ?? -1);
  const since = last ? new Date(last).toLocaleString([], WHEN) : "";
  const where = here.length ? `frame ${here.join(", ")}${element ? `, ${element}` : ""}` : ["away", since].filter(Boolean).join(", ");
  const about = here.length || !since ? where : `away, last edit ${since}`;
  return el("div", { class: isMe ? "team-person chosen" : "team-person" },
    el("span", { class: here.length ? "initials" : "initials away", text: initials(name) }),
    el("div", { class: "team-name" }, el("b", { text: isMe ? `${name}, you` : name }), both ? el("span", { title: where }, el("span", { class: "warning", text: "◆ " }), `both in ${element}`) : el("span", { class: "dim", text: where, title: about })),
    el("div", { class: "team-done" }, el("b", { text: assigned ? `${reviewed} / ${assigned}` : `${reviewed}` }), el("span", { class: "dim", text: done ? `${pace} in 8 h, done ${day(done)}` : `${counted(edits, "edit")}, ${pace} in 8 h` })),
    bar(team, ranges, here, team.shares.of(name)));
}

/** Assigned frames, how many of them are reviewed, those labelled blind, and where somebody is.
 *
 * @param {Team} team
 * @param {[number, number][]} ranges
 * @param {number[]} here
 * @param {number[]} twice frames that this person labels blind
 */
function bar({ state: { order, labels } }, ranges, here, twice) {
  const isMine = (/** @type {number} */ index) => ranges.some(([first, last]) => index >= first && index <= last);
  const blind = new Set(twice), present = new Set(here);
  const kindOf = (/** @type {annotator.FrameSummary["state"]} */ state) => (state.startsWith("reviewed") ? "done" : state === "in work" ? "work" : "open");
  const own = labels.frames.map(({ index, state }) => (isMine(index) ? kindOf(state) : ""));
  const percent = (/** @type {number} */ places) => `${(100 * places) / Math.max(order.length, 1)}%`;
  const drawn = (/** @type {string[]} */ kinds, /** @type {number} */ top, /** @type {number} */ tall) =>
    runs(kinds).map(([kind, first, count]) => part(kind, percent(first), kind === "here" ? percent(Math.max(count, order.length / 200)) : percent(count), top, tall));
  return svg("svg", { class: "team-bar" },
    part("track", "0", "100%", 11, 2),
    ...drawn(own, 4, 16),
    ...drawn(order.map((index) => (blind.has(index) ? "twice" : "")), 1, 22),
    ...drawn(order.map((index) => (present.has(index) ? "here" : "")), 0, 24));
}

/** Neighbours of one kind, as kind, first place and number; without those of none.
 *
 * @param {string[]} kinds
 * @returns {[string, number, number][]}
 */
function runs(kinds) {
  /** @type {[string, number, number][]} */
  const found = [];
  for (const [place, kind] of kinds.entries()) {
    const last = found.at(-1);
    if (last && last[0] === kind) last[2] += 1;
    else found.push([kind, place, 1]);
  }
  return found.filter(([kind]) => kind);
}

/**
 * @param {string} kind
 * @param {string} left
 * @param {string} width
 * @param {number} top
 * @param {number} tall
 */
function part(kind, left, width, top, tall) {
  const rect = svg("rect", { class: kind, x: left, y: top, width, height: tall });
  if (kind === "twice") rect.setAttribute("fill", "url(#team-hatch)");
  return rect;
}

/** A day as people say it: a weekday within a week, else a date.
 *
 * @param {string} iso
 */
function day(iso) {
  const [year, month, date] = iso.split("-").map(Number);
  const then = new Date(year, month - 1, date);
  const isSoon = then.getTime() - Date.now() < 6 * 86_400_000;
  return then.toLocaleDateString([], isSoon ? { weekday: "long" } : { day: "numeric", month: "short" });
}
