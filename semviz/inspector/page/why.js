/* The card that says why a frame came out as it did. */

import { byId, el, fixed } from "/static/dom.js";
import { statusMark } from "/static/glyphs.js";

export class WhyCard {
  showFrame(frame) {
    const { title, sentence, sure, rows, alternatives, alternativesLeft, times, hypotheses } = frame.why;
    const numbers = [...rows, ...alternatives.map(alternativeRow)];
    if (alternativesLeft) numbers.at(-1)[0] += `, ${alternativesLeft} more`;
    const costs = times.map(([stage, ms]) => `${stage} ${fixed(ms, 1)} ms`);
    if (hypotheses !== null) costs.push(`${hypotheses} poses tried`);
    const told = frame.hasTruth ? "with truth" : "without truth";
    const surely = sure === null ? told : `${told} · ${fixed(100 * sure, 0)} % sure`;
    byId("why-body").replaceChildren(
      el("header", {},
        el("h3", {}, statusMark(frame.sureAndWrong ? "cannot" : frame.status), title),
        el("span", { class: "about", id: "why-truth", text: surely })),
      el("p", { class: "sentence" }, ...unbroken(sentence)),
      el("dl", {}, ...numbers.flatMap(([label, value]) => [el("dt", { text: label }), el("dd", { text: value })])),
      el("div", { class: "actions", id: "why-actions" }),
      ...(costs.length ? [el("div", { class: "times" }, ...costs.map((text) => el("span", { text })))] : []));
  }
}

/** With names of elements, such as P-29, each in one line. */
function unbroken(sentence) {
  return sentence.split(/([A-Z]-\d+)/).map((part, place) => (place % 2 ? el("span", { text: part }) : part));
}

function alternativeRow({ name, distanceM, angleDeg, gapNats }) {
  const gap = gapNats === null ? "" : ` · −${fixed(gapNats, 1)} nats`;
  return [`Pose ${name}`, `${fixed(distanceM, 1)} m · ${fixed(angleDeg, 1)}°${gap}`];
}
