// @ts-check
/* The tab "Why": the diagnosis of a frame. */

import { byId, el, fixed, unbroken } from "/static/dom.js";
import { statusMark } from "/static/glyphs.js";

/** @typedef {import("/static/protocol").inspector.DiagnosisCard} DiagnosisCard */
/** @typedef {import("/static/protocol").inspector.FrameView} FrameView */
/** @typedef {import("/static/protocol").inspector.OtherPose} OtherPose */

export class WhyCard {
  /** @param {FrameView} frame */
  showFrame(frame) {
    const { title, sentence, confidence, tells_apart: tellsApart, rows, times_ms: times, poses_tried: evaluated } = frame.card;
    const costs = times.map(([stage, ms]) => `${stage} ${fixed(ms, 1)} ms`);
    if (evaluated !== null) costs.push(`${evaluated} poses evaluated`);
    const basis = frame.has_truth ? "with ground truth" : "without ground truth";
    const about = confidence === null ? basis : `${basis} · ${fixed(100 * confidence, 0)} % sure`;
    const numbers = [...rows, ...otherPoses(frame.card)];
    byId("why-body").replaceChildren(
      el("header", {},
        el("h3", {}, statusMark(frame.overconfident ? "cannot" : frame.status), title),
        el("span", { class: "about", id: "why-truth", text: about })),
      el("p", { class: "sentence" }, ...unbroken(sentence)),
      ...(tellsApart ? [el("p", { class: "tells-apart", id: "why-tells-apart", text: tellsApart })] : []),
      el("div", { class: "actions", id: "why-actions" }),
      el("dl", {}, ...numbers.map(([label, value]) => el("div", {}, el("dt", { text: label }), el("dd", { text: value })))),
      ...(costs.length ? [el("div", { class: "times" }, ...costs.map((text) => el("span", { text })))] : []));
  }
}

/** Labels and values of alternative poses; the last label counts those not listed.
 *
 * @param {DiagnosisCard} card
 */
function otherPoses({ alternatives, more_alternatives: more }) {
  const rows = alternatives.map(alternativeRow);
  return rows.map(([label, value], at) => (more && at === rows.length - 1 ? [`${label} (+${more})`, value] : [label, value]));
}

/**
 * @param {OtherPose} pose
 * @returns {[string, string]}
 */
function alternativeRow({ name, distance_m: distanceM, angle_deg: angleDeg, gap_nats: gapNats }) {
  const gap = gapNats === null ? "" : ` · −${fixed(gapNats, 1)} nats`;
  return [`Pose ${name}`, `${fixed(distanceM, 1)} m · ${fixed(angleDeg, 1)}°${gap}`];
}
