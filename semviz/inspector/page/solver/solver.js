// @ts-check
/* The tab "Solver": times of the stages, candidate poses, pairs, iterations of the refinement. */

import { cssColor } from "/static/canvas.js";
import { byId, el, fixed } from "/static/dom.js";
import { classGlyph, residualColor } from "/static/glyphs.js";
import { currentTheme } from "/static/theme.js";
import { table, tableRow } from "./solver_table.js";
import { traceTable } from "./solver_trace.js";

/** @typedef {import("/static/protocol").inspector.PoseDifference} PoseDifference */
/** @typedef {import("/static/protocol").inspector.SearchPoseView} SearchPoseView */
/** @typedef {import("/static/protocol").inspector.SearchView} SearchView */
/** @typedef {import("/static/protocol").inspector.SolvedPair} SolvedPair */
/** @typedef {import("/static/protocol").inspector.SolverEvent} SolverEvent */
/** @typedef {import("../main.js").Page} Page */

export class SolverCard {
  /** @param {Page} page */
  constructor(page) {
    this.page = page;
    /** @type {SolverEvent | null} */
    this.shown = null;
    /** @type {number | null} */
    this.requested = null; // position of the requested frame
    page.socket.on("solver", (event) => this.showSolver(event));
  }

  showRun() {
    this.requested = null;
  }

  showFrame() {
    this.requestSolver();
  }

  showTabs() {
    this.requestSolver();
  }

  showTheme() {
    this.fill();
  }

  showState() {
    this.mark();
  }

  /** Only while the tab is shown, once a frame. */
  requestSolver() {
    const { store, right, socket } = this.page;
    if (right.shown !== "solver" || !store.hasFrame || this.requested === store.position) return;
    this.requested = store.position;
    socket.send("get_solver");
  }

  /** @param {SolverEvent} solver */
  showSolver(solver) {
    this.shown = solver;
    this.fill();
  }

  fill() {
    if (!this.shown) return;
    const { stages, search, pairs, trace, notes, shown } = this.shown;
    const parts = [part("Time", stages.length ? stageBars(stages) : el("p", { class: "dim", text: "No stages recorded." }))];
    for (const note of notes) parts.push(el("p", { class: "note dim", text: note }));
    if (search) parts.push(part("Poses of the search", el("p", { class: "dim", text: funnel(search) }), this.poses(search.poses, shown)));
    if (pairs) parts.push(part(pairCount(pairs), this.pairs(pairs)));
    if (trace) parts.push(part("Refinement", ...traceTable(trace)));
    byId("solver-body").replaceChildren(...parts);
    this.mark();
  }

  /** A click shows a pose in 3D, or hides it.
   *
   * @param {SearchPoseView[]} poses
   * @param {number | null} shown
   */
  poses(poses, shown) {
    const withTruth = poses.some((pose) => pose.from_truth);
    const head = ["", "nats behind", "share", "pairs", withTruth ? "from truth" : "from estimate"];
    const rows = poses.map((pose, row) => tableRow([
      pose.letter,
      row ? `−${fixed(pose.behind, 1)}` : "best",
      `${fixed(100 * pose.share, pose.share < 0.995 ? 1 : 0)} %`,
      pose.pairs ?? "—",
      differenceText(withTruth ? pose.from_truth : pose.from_answer),
    ], {
      "aria-current": shown === row,
      data: { row },
      title: `Log-likelihood ${fixed(pose.score, 1)} nats. Click to show it in 3D`,
      onclick: () => this.page.socket.send("show_search_pose", { row: shown === row ? null : row }),
    }));
    return table("poses", head, rows);
  }

  /** @param {SolvedPair[]} pairs */
  pairs(pairs) {
    const hasTruth = pairs.some((pair) => pair.is_true !== null);
    const head = ["element", "#", "px", "χ²", "support", ...(hasTruth ? ["true"] : [])];
    const rows = pairs.map((pair) => tableRow([
      this.name(pair),
      pair.observed,
      residualCell(pair),
      fixed(pair.chi2, 1),
      pair.support_nats === null ? "—" : `${fixed(pair.support_nats, 1)} nats`,
      ...(hasTruth ? [pair.is_true ? "yes" : "no"] : []),
    ], {
      class: pair.inlier ? "" : "outlier",
      data: { observed: pair.observed, element: pair.element },
      title: pairTitle(pair),
      onclick: () => this.page.select({ observed: pair.observed, element: pair.element }),
    }));
    return table("pairs", head, rows);
  }

  /** @param {SolvedPair} pair */
  name({ name, class_id: id }) {
    const kind = this.page.store.run.classes.find((other) => other.id === id);
    const glyph = kind ? classGlyph(kind, currentTheme() === "light" ? kind.color_light : kind.color) : null;
    return el("span", { class: "name" }, glyph, name);
  }

  /** Highlights the selected pair. */
  mark() {
    const { observed, element } = this.page.store.state;
    /** @type {NodeListOf<HTMLElement>} */
    const rows = byId("solver-body").querySelectorAll("[data-observed]");
    for (const row of rows) {
      const isCurrent = Number(row.dataset.observed) === observed && Number(row.dataset.element) === element;
      row.setAttribute("aria-current", String(isCurrent));
    }
  }
}

/**
 * @param {string} title
 * @param {...Node} children
 */
function part(title, ...children) {
  return el("section", {}, el("h4", { text: title }), ...children);
}

/** @param {[string, number][]} stages */
function stageBars(stages) {
  const total = stages.reduce((sum, [, ms]) => sum + ms, 0);
  /** @param {[string, number]} stage */
  const line = ([stage, ms]) => {
    const bar = el("i", {});
    bar.style.width = `${(100 * ms) / Math.max(total, 1e-9)}%`;
    return [el("dt", { text: stage }), el("dd", { class: "bar" }, bar), el("dd", { text: `${fixed(ms, ms < 10 ? 2 : 1)} ms` })];
  };
  return el("dl", { class: "stages" }, ...stages.flatMap(line), el("dt", { text: "all" }), el("dd"), el("dd", { text: `${fixed(total, 1)} ms` }));
}

/** @param {SearchView} search */
function funnel({ tried, passed, poses }) {
  const consistent = passed === null ? "" : ` ${passed.toLocaleString("en")} consistent with the prior,`;
  return `${tried.toLocaleString("en")} evaluated,${consistent} ${poses.length} distinct ${poses.length === 1 ? "pose" : "poses"} left.`;
}

/** @param {SolvedPair[]} pairs */
function pairCount(pairs) {
  const inliers = pairs.filter((pair) => pair.inlier).length;
  return inliers === pairs.length ? `${inliers} pairs, all inliers` : `${pairs.length} pairs, ${inliers} inliers`;
}

/** @param {PoseDifference | null} from */
function differenceText(from) {
  return from === null ? "—" : `${fixed(from.m, 2)} m · ${fixed(from.deg, 1)}°`;
}

/** The residual with its colour, and a cross for outliers.
 *
 * @param {SolvedPair} pair
 */
function residualCell({ residual_px: residualPx, inlier }) {
  const swatch = el("i", { class: "swatch" });
  swatch.style.background = residualPx === null ? "none" : residualColor(residualPx, [0, 1, 2, 3, 4].map((level) => cssColor(`--residual-${level}`)));
  return el("span", { class: "off" }, swatch, `${fixed(residualPx, 1)}${inlier ? "" : " ✕"}`);
}

/** @param {SolvedPair} pair */
function pairTitle({ inlier, open_m: openM, is_true: isTrue }) {
  const sentences = [inlier ? "Inlier: the estimate uses it." : "Outlier: it has little weight."];
  if (openM !== null) sentences.push(`Without it, the camera position shifts by, or is uncertain to, ${fixed(openM, 2)} m.`);
  if (isTrue === false) sentences.push("Wrong by ground truth.");
  return sentences.join(" ");
}
