// @ts-check
// The filter of the view "Tracks": words that all must hold, as text. No DOM here.
/** @import {ElementClass} from "../values.js" */
/** @import {Row, TrackTable} from "./track_table.js" */

/** A condition on a row. `frames` is the range of places that the filter names, or all.
 * @typedef {(row: Row, table: TrackTable, frames: [number, number]) => boolean} Condition */
/** @typedef {{conditions: Condition[], frames: [number, number] | null, fault: string}} Filter */

/** What `flag:` can ask for, also as a word of its own.
 * @type {Record<string, Condition>} */
export const FLAGS = {
  unsure: (row) => row.notes.some(({ unsure }) => unsure),
  noted: (row) => row.notes.some(({ text }) => text),
  gaps: (row, table, [first, last]) => table.gaps(row).some((place) => place >= first && place <= last),
  proposed: (row, table) => table.proposed(row) > 0,
  open: (row) => row.number < 0,
  "look-first": (row) => row.doubt !== "",
  "left-out": (row) => row.left_out,
};

/** @type {Record<string, (row: Row, table: TrackTable, frames: [number, number]) => number | null>} */
const NUMBERS = {
  residual: (row, table, [first, last]) => (row.number < 0 ? row.worst_px : table.worst(row, first, last)),
  score: (row) => row.score,
  views: (row) => row.views,
};

/** Reads a filter. A word that is not understood is its `fault`; the others count.
 *
 * @param {string} text
 * @param {ElementClass[]} classes
 * @param {Map<number, number>} places of frames by index
 * @returns {Filter}
 */
export function parseFilter(text, classes, places) {
  /** @type {Filter} */
  const filter = { conditions: [], frames: null, fault: "" };
  for (const word of text.trim().split(/\s+/).filter(Boolean)) {
    const compared = word.match(/^(residual|score|views)([<>])(\d+(?:\.\d+)?)$/i);
    const named = word.match(/^(class|attr|note|flag|frames?):(.*)$/i);
    if (compared) filter.conditions.push(comparison(compared[1].toLowerCase(), compared[2], Number(compared[3])));
    else if (named) filter.fault ||= readNamed(named[1].toLowerCase(), named[2].toLowerCase(), filter, classes, places);
    else if (FLAGS[word.toLowerCase()]) filter.conditions.push(FLAGS[word.toLowerCase()]);
    else if (/[:<>]/.test(word)) filter.fault ||= `“${word}” is not understood: class: attr: note: flag: frames: residual> score< views<`;
    else filter.conditions.push((row) => row.name.toLowerCase().includes(word.toLowerCase()));
  }
  return filter;
}

/**
 * @param {string} name
 * @param {string} sign
 * @param {number} limit
 * @returns {Condition}
 */
function comparison(name, sign, limit) {
  return (row, table, frames) => {
    const value = NUMBERS[name](row, table, frames);
    return value !== null && (sign === "<" ? value < limit : value > limit);
  };
}

/** A name or value as filters write it, without spaces.
 *
 * @param {string} text
 */
const plain = (text) => text.toLowerCase().replaceAll(/[\s-]+/g, "_");

/** The shortest word by which a filter finds a class alone: its first, or all of its name.
 *
 * @param {ElementClass} kind
 * @param {ElementClass[]} classes
 */
export function classWord(kind, classes) {
  const [first] = plain(kind.name).split("_");
  return classes.filter(({ name }) => plain(name).startsWith(first)).length > 1 ? plain(kind.name) : first;
}

/** Adds a `name:value` to the filter; returns what is wrong with it.
 *
 * @param {string} name
 * @param {string} value
 * @param {Filter} filter
 * @param {ElementClass[]} classes
 * @param {Map<number, number>} places
 */
function readNamed(name, value, filter, classes, places) {
  if (name === "note") {
    filter.conditions.push((row) => row.notes.some(({ text, author }) => text && `${text} ${author}`.toLowerCase().includes(value)));
  } else if (name === "class") {
    const ids = classes.filter((kind) => plain(kind.name).startsWith(plain(value))).map(({ id }) => id);
    if (!ids.length) return `There is no class “${value}”: ${classes.map((kind) => kind.name).join(", ")}`;
    filter.conditions.push((row) => ids.includes(row.class_id));
  } else if (name === "attr") {
    const [key, sought] = value.split("=");
    if (!key) return "Write attr:material=steel, or attr:lamp for any value";
    filter.conditions.push((row) => Object.entries(row.attributes).some(([has, is]) =>
      plain(has) === plain(key) && (sought === undefined || plain(is).startsWith(plain(sought)))));
  } else if (name === "flag") {
    if (!FLAGS[value]) return `There is no flag “${value}”: ${Object.keys(FLAGS).join(", ")}`;
    filter.conditions.push(FLAGS[value]);
  } else {
    const range = value.match(/^(\d+)(?:-(\d+))?$/);
    const inside = range ? [...places].filter(([index]) => index >= Number(range[1]) && index <= Number(range[2] ?? range[1])).map(([, place]) => place) : [];
    if (!inside.length) return `There are no frames ${value}`;
    filter.frames = [Math.min(...inside), Math.max(...inside)];
  }
  return "";
}

/** @typedef {"first seen" | "worst" | "views" | "name"} Order */
/** @type {Record<Order, (table: TrackTable) => (a: Row, b: Row) => number>} */
const ORDERS = {
  "first seen": (table) => (a, b) => table.span(a)[0] - table.span(b)[0] || a.number - b.number,
  worst: () => (a, b) => (b.worst_px ?? -1) - (a.worst_px ?? -1) || a.number - b.number,
  views: () => (a, b) => a.views - b.views || a.number - b.number,
  name: () => (a, b) => a.class_id - b.class_id || a.number - b.number,
};
/** @type {Order[]} */
export const ORDER_NAMES = ["first seen", "worst", "views", "name"];

/** The rows that a filter leaves, in order.
 *
 * @param {TrackTable} table
 * @param {Filter} filter
 * @param {Order} order
 * @param {number} frames in the drive
 */
export function filtered(table, filter, order, frames) {
  const range = filter.frames ?? /** @type {[number, number]} */ ([0, frames - 1]);
  const isIn = (/** @type {Row} */ row) => !filter.frames || table.isIn(row, ...range);
  const rows = [...table.rows.values()].filter((row) => isIn(row) && filter.conditions.every((holds) => holds(row, table, range)));
  return rows.sort(ORDERS[order](table));
}

/** What to say if a filter leaves nothing.
 *
 * @param {string} text
 * @param {TrackTable} table
 * @param {Filter} filter
 * @param {number} frames
 */
export function noHit(text, table, filter, frames) {
  const words = text.trim().split(/\s+/).filter((word) => !/^frames?:/i.test(word)).join(" ");
  if (!filter.frames) return `No element has ${words}.`;
  const elsewhere = filtered(table, { ...filter, frames: null }, "name", frames).length;
  const range = text.match(/frames?:(\S+)/i)?.[1].replace("-", "–");
  return `No element has ${words || "anything"} in frames ${range}. ${elsewhere} ${elsewhere === 1 ? "has" : "have"} elsewhere.`;
}
