/* The bar at the top: run, frame, status, error. */

import { byId, el, fixed } from "/static/dom.js";
import { statusMark } from "/static/glyphs.js";

const STATUS = { ok: "Ok", ambiguous: "Ambiguous", cannot: "Cannot" };

export class Bar {
  constructor(page) {
    this.page = page;
    byId("run").addEventListener("change", (event) => {
      page.open(event.target.value, page.frame?.index ?? null);
      event.target.blur();
    });
    byId("previous").addEventListener("click", () => page.step(-1));
    byId("next").addEventListener("click", () => page.step(1));
    byId("play").addEventListener("click", () => page.play());
    byId("theme").addEventListener("click", () => page.switchTheme());
    byId("help").addEventListener("click", () => page.help());
    byId("copy-link").addEventListener("click", () => this.copyLink());
  }

  showRuns(names) {
    byId("run").replaceChildren(...names.map((name) => el("option", { text: name, value: name })));
  }

  showRun(run) {
    byId("run").value = run.name;
    byId("method").textContent = `${run.method} in ${run.map}`;
  }

  /** What was asked for did not come; the bar says what is shown all the same. */
  showRefusal() {
    if (this.page.run) byId("run").value = this.page.run.name;
  }

  showFrame(frame) {
    this.pointAt(frame.position);
    byId("status").replaceChildren(statusMark(frame.status), STATUS[frame.status]);
    byId("status").title = frame.reason;
    const missing = frame.status === "cannot" ? "no pose" : "no truth";
    const error = frame.errorM === null
      ? missing
      : `${fixed(frame.errorM, 2)} m · ${fixed(frame.errorDeg, 2)}°`;
    byId("numbers").textContent = frame.ms ? `${error} · ${fixed(frame.ms, 1)} ms` : error;
  }

  pointAt(position) {
    const { frames } = this.page.run;
    byId("frame-number").textContent = `Frame ${frames[position].index} of ${frames.at(-1).index}`;
  }

  async copyLink() {
    await navigator.clipboard.writeText(location.href);
    byId("copy-link").textContent = "Copied";
    setTimeout(() => { byId("copy-link").textContent = "Copy link"; }, 1200);
  }
}
