/* The tab "Solver": stages with their time, poses the search found, pairs, and the way to the optimum. */

import { cssColor } from "/static/canvas.js";
import { byId, el, fixed } from "/static/dom.js";
import { classGlyph, residualColor } from "/static/glyphs.js";
import { currentTheme } from "/static/theme.js";
import { table, tableRow } from "./solver_table.js";
import { traceTable } from "./solver_trace.js";

export class SolverCard {
  constructor(page) {
    this.page = page;
    this.shown = null; // what the server said of the frame
    this.asked = null; // position of the frame that was asked for
  }

  showRun(run) {
    this.run = run;
    this.asked = null;
  }

  showFrame() {
    this.ask();
  }

  showTabs() {
    this.ask();
  }

  showTheme() {
    this.fill();
  }

  showState({ observed, element }) {
    this.selected = { observed, element };
    this.mark();
  }

  /** Only while it is seen, and once for each frame. */
  ask() {
    const { frame, right, socket } = this.page;
    if (right.shown !== "solver" || !frame || this.asked === frame.position) return;
    this.asked = frame.position;
    socket.send({ verb: "solver" });
  }

  showSolver(solver) {
    this.shown = solver;
    this.fill();
  }

  fill() {
    if (!this.shown) return;
    const { stages, search, pairs, trace, notes } = this.shown;
    const parts = [part("Time", stages.length ? stageBars(stages) : el("p", { class: "dim", text: "No stage was reached." }))];
    for (const note of notes) parts.push(el("p", { class: "note dim", text: note }));
    if (search) parts.push(part("Poses of the search", el("p", { class: "dim", text: funnel(search) }), this.poses(search.poses)));
    if (pairs) parts.push(part(pairCount(pairs), this.pairs(pairs)));
    if (trace) parts.push(part("Refinement", ...traceTable(trace)));
    byId("solver-body").replaceChildren(...parts);
    this.mark();
  }

  /** A click shows a pose in 3D, and takes it away again. */
  poses(poses) {
    const withTruth = poses.some((one) => one.fromTruth);
    const head = ["", "nats behind", "share", "pairs", withTruth ? "from truth" : "from answer"];
    const rows = poses.map((one, row) => tableRow([
      one.letter,
      row ? `−${fixed(one.behind, 1)}` : "best",
      `${fixed(100 * one.share, one.share < 0.995 ? 1 : 0)} %`,
      one.pairs ?? "—",
      apart(withTruth ? one.fromTruth : one.fromAnswer),
    ], {
      "aria-current": this.shown.shown === row,
      data: { row },
      title: `Log-likelihood ${fixed(one.score, 1)} nats. Click: show it in 3D`,
      onclick: () => this.page.socket.send({ verb: "hypothesis", row: this.shown.shown === row ? null : row }),
    }));
    return table("poses", head, rows);
  }

  pairs(pairs) {
    const truths = pairs.some((one) => one.true !== null);
    const head = ["element", "#", "off, px", "χ²", "speaks for it", ...(truths ? ["true"] : [])];
    const rows = pairs.map((one) => tableRow([
      this.name(one),
      one.observed,
      offPx(one),
      fixed(one.chi2, 1),
      one.supportNats === null ? "—" : `${fixed(one.supportNats, 1)} nats`,
      ...(truths ? [one.true ? "yes" : "no"] : []),
    ], {
      class: one.inlier ? "" : "outlier",
      data: { observed: one.observed, element: one.element },
      title: pairTitle(one),
      onclick: () => this.page.select({ observed: one.observed, element: one.element }),
    }));
    return table("pairs", head, rows);
  }

  name({ name, class: id }) {
    const one = this.run.classes.find((other) => other.id === id);
    return el("span", { class: "name" }, classGlyph(one, currentTheme() === "light" ? one.colorLight : one.color), name);
  }

  /** Accent on the pair that is selected. */
  mark() {
    for (const row of byId("solver-body").querySelectorAll("[data-observed]")) {
      const { observed, element } = this.selected ?? {};
      row.setAttribute("aria-current", Number(row.dataset.observed) === observed && Number(row.dataset.element) === element);
    }
  }
}

function part(title, ...children) {
  return el("section", {}, el("h4", { text: title }), ...children);
}

function stageBars(stages) {
  const total = stages.reduce((sum, [, ms]) => sum + ms, 0);
  const line = ([stage, ms]) => {
    const bar = el("i", {});
    bar.style.width = `${(100 * ms) / Math.max(total, 1e-9)}%`;
    return [el("dt", { text: stage }), el("dd", { class: "bar" }, bar), el("dd", { text: `${fixed(ms, ms < 10 ? 2 : 1)} ms` })];
  };
  return el("dl", { class: "stages" }, ...stages.flatMap(line), el("dt", { text: "all" }), el("dd"), el("dd", { text: `${fixed(total, 1)} ms` }));
}

function funnel({ tried, passed, poses }) {
  const agreed = passed === null ? "" : ` ${passed.toLocaleString("en")} agree with the prior,`;
  return `${tried.toLocaleString("en")} tried,${agreed} ${poses.length} distinct ${poses.length === 1 ? "one is" : "ones are"} left.`;
}

function pairCount(pairs) {
  const fit = pairs.filter((one) => one.inlier).length;
  return fit === pairs.length ? `${fit} pairs, all fit` : `${pairs.length} pairs, ${fit} fit`;
}

function apart(from) {
  return from === null ? "—" : `${fixed(from.m, 2)} m · ${fixed(from.deg, 1)}°`;
}

/** In its colour of residuals, and crossed where it is no inlier. */
function offPx({ residualPx, inlier }) {
  const swatch = el("i", { class: "swatch" });
  swatch.style.background = residualPx === null ? "none" : residualColor(residualPx, [0, 1, 2, 3, 4].map((level) => cssColor(`--residual-${level}`)));
  return el("span", { class: "off" }, swatch, `${fixed(residualPx, 1)}${inlier ? "" : " ✕"}`);
}

function pairTitle({ inlier, openM, true: isTrue }) {
  const said = [inlier ? "Fits: the answer rests on it." : "Does not fit: it counts for little."];
  if (openM !== null) said.push(`Without it the camera's place moves, or is uncertain, by ${fixed(openM, 2)} m.`);
  if (isTrue === false) said.push("Truly the detection is something else.");
  return said.join(" ");
}
