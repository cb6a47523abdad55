// @ts-check
/* What the view "Map over time" says about changes: words, order, what is open, the lines of the diff. */

/** @typedef {import("/static/protocol").inspector.OverTimeChange} OverTimeChange */
/** @typedef {import("/static/protocol").inspector.ChangeAnswer} ChangeAnswer */
/** @typedef {import("/static/protocol").inspector.PassRow} PassRow */
/** @typedef {import("/static/protocol").inspector.PassView} PassView */
/** @typedef {OverTimeChange["kind"]} Kind */
/** @typedef {ChangeAnswer["answer"]} Answer */
/** @typedef {Map<string, ChangeAnswer>} Answers by the names of changes */

/** Of each kind: its title, and what making the change does.
 *
 * @type {Record<Kind, {title: string, make: string}>} */
export const KINDS = {
  vanished: { title: "Vanished", make: "Remove" },
  new: { title: "New", make: "Add" },
  moved: { title: "Moved", make: "Move" },
  unsure: { title: "Unsure", make: "Remove" },
};
/** @type {Kind[]} */
export const ORDER = ["vanished", "new", "moved", "unsure"];
const MONTHS = ["Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec"];

/** @typedef {{kind: Kind, count: number, change: null} | {kind: Kind, count: 0, change: OverTimeChange}} ListRow a title, or a change */

/** The rows of the list: each kind with its changes.
 *
 * @param {OverTimeChange[]} changes
 * @param {Kind | null} only
 * @returns {ListRow[]}
 */
export function listRows(changes, only) {
  return ORDER.filter((kind) => only === null || kind === only).flatMap((kind) => {
    const own = changes.filter((change) => change.kind === kind);
    if (!own.length) return [];
    return [{ kind, count: own.length, change: null }, ...own.map((change) => /** @type {ListRow} */ ({ kind, count: 0, change }))];
  });
}

/** What is decided on a change, in a word.
 *
 * @param {OverTimeChange} change
 * @param {Answers} answers
 */
export function decided({ name, kind }, answers) {
  const answer = answers.get(name)?.answer ?? "open";
  return answer === "make" ? KINDS[kind].make.toLowerCase() : answer === "label" ? "wants label" : answer;
}

/** The names of the changes that are sure and not decided.
 *
 * @param {OverTimeChange[]} changes
 * @param {Answers} answers
 */
export function openSure(changes, answers) {
  return changes.filter(({ kind, name }) => kind !== "unsure" && !answers.has(name)).map(({ name }) => name);
}

/** The next change that is not decided, after the one named; null if all are.
 *
 * @param {OverTimeChange[]} changes
 * @param {Answers} answers
 * @param {string | null} name
 */
export function nextOpen(changes, answers, name) {
  const at = changes.findIndex((change) => change.name === name);
  const after = [...changes.slice(at + 1), ...changes.slice(0, at + 1)];
  return after.find((change) => !answers.has(change.name))?.name ?? null;
}

/** The state of a cell: a pass that saw an element, should have, or could not; before a new element was
 * there, misses are no surprise.
 *
 * @param {Pick<PassRow, "seen" | "chances"> & {kind?: Kind, since?: number | null}} row
 * @param {number} at the pass
 * @returns {{state: "seen" | "moved" | "missed" | "absent" | "hidden", text: string}}
 */
export function cell({ seen, chances, kind, since = null }, at) {
  if (!chances[at]) return { state: "hidden", text: "·" };
  const isAfter = since !== null && at >= since;
  if (seen[at]) return { state: kind === "moved" && isAfter ? "moved" : "seen", text: String(seen[at]) };
  return { state: kind === "new" && !isAfter ? "absent" : "missed", text: `0/${chances[at]}` };
}

const MARKS = { vanished: "-", new: "+", moved: "~", unsure: "-" };

/** The decided changes as lines of a diff: `-` removed, `+` added, `~` moved, `?` a label is asked for, `=` kept.
 *
 * @param {OverTimeChange[]} changes
 * @param {Answers} answers
 * @returns {{mark: string, text: string}[]}
 */
export function diffLines(changes, answers) {
  return changes.flatMap((change) => {
    const found = answers.get(change.name);
    if (!found) return [];
    const mark = found.answer === "make" ? MARKS[change.kind] : found.answer === "label" ? "?" : "=";
    const what = found.answer === "label" ? `label, ${found.label}` : found.answer === "keep" ? `kept by ${found.author}` : change.story;
    return [{ mark, text: `${change.name}  ${what}  p\u00a0${change.existence.toFixed(2)}` }];
  });
}

/** `12 May`, of `2026-05-12`.
 *
 * @param {string} date
 */
export function shortDate(date) {
  const [, month, day] = date.split("-").map(Number);
  return `${day} ${MONTHS[month - 1]}`;
}

/** How a pass is called: by its date, if it is known and no other pass has it; else by its run.
 *
 * @param {PassView} pass
 * @param {PassView[]} passes
 */
export function passName({ run, date }, passes) {
  return date && passes.filter((other) => other.date === date).length === 1 ? shortDate(date) : run;
}

/** How many passes, when, and how many elements.
 *
 * @param {PassView[]} passes
 * @param {number} elements
 */
export function about(passes, elements) {
  const [first, last] = [passes[0], passes[passes.length - 1]];
  const when = first.date && last.date && first.date !== last.date ? `, ${shortDate(first.date)} – ${shortDate(last.date)} ${last.date.slice(0, 4)}` : "";
  const frames = passes.reduce((sum, pass) => sum + pass.sure, 0);
  return `${passes.length} passes${when}, ${elements.toLocaleString("en")} elements, ${frames.toLocaleString("en")} sure frames`;
}
