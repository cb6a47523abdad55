/* What there is to draw on an image: which elements, where, and what joins them. No drawing here. */

const MODES = {
  estimate: { title: "map projected with the estimate", pose: "estimate", magnification: 8 },
  truth: { title: "map projected with the truth", pose: "truth", magnification: 8 },
  pairs: { pose: "truth", magnification: 1 },
  error: { title: "map from truth to estimate", pose: "estimate", magnification: 1 },
};
const MISSING = {
  estimate: "no pose: no map here; 2 shows it with the truth",
  truth: "no truth: no map here; 1 shows it with the estimate",
  pairs: "no pose: no pairs",
  error: "no truth or no pose: no error",
};
const BORDER_PX = 2; // an unknown end this near the border is cut off there, others are hidden

/** One frame as one camera has it in one mode. Places are `[anchor, end]` in pixels, `end` null for
 * signs. In the right image nothing is detected: only the map is in it. */
export class Sight {
  /** `frame` and `right` come from the server; `right` is null for the left image. */
  constructor(frame, mode, size, right = null) {
    this.frame = frame;
    this.mode = mode;
    this.size = size;
    this.right = right;
    this.magnification = MODES[mode].magnification;
    this.observed = right || mode === "error" ? [] : frame.observed;
    this.pairOf = new Map(frame.pairs.map((pair) => [pair.observed, pair]));
    const pairs = mode === "truth" ? frame.truePairs : frame.pairs;
    this.matched = new Set(pairs.map((pair) => pair.mapped));
    this.pose = mode === "pairs" && !frame.hasTruth ? "estimate" : MODES[mode].pose;
  }

  /** Whether the poses that the mode needs are known. */
  get isPossible() {
    const { hasTruth, status } = this.frame;
    if (this.mode === "truth") return hasTruth;
    return status !== "cannot" && (this.mode !== "error" || hasTruth);
  }

  /** Where row `row` of the map is, null where it is not in or near the image. */
  place(row, pose = this.pose) {
    return (this.right?.mapped ?? this.frame.mapped)[row][pose];
  }

  /** Map rows that are drawn. */
  get mapped() {
    const rows = [...this.frame.mapped.keys()].filter((row) => this.place(row));
    return this.mode === "pairs" ? rows.filter((row) => this.matched.has(row)) : rows;
  }

  /** Map rows that a detector should have found in this image and did not. */
  get missed() {
    return this.#isDetected ? this.frame.missed.filter((row) => this.isPossible && this.place(row)) : [];
  }

  /** Observed rows that are nothing real. */
  get false() {
    return this.#isDetected ? this.frame.false : [];
  }

  get #isDetected() {
    return !this.right && this.mode !== "error";
  }

  /** In the right image only poses can be compared. */
  get hasVectors() {
    return !this.right || this.mode === "error";
  }

  /** How far the map is off, each as `{start, end, px, fits}`; pixels, and not magnified yet. */
  get vectors() {
    if (this.mode === "error") return this.#errors();
    if (!this.hasVectors) return [];
    return this.mode === "pairs" ? this.#correspondences() : this.#residuals();
  }

  #residuals() {
    const pairs = this.mode === "truth" ? this.frame.truePairs : this.frame.pairs;
    const whole = pairs.filter(({ start, vector }) => ![...start, ...vector].includes(null));
    return whole.map(({ start, vector, residualPx, inlier }) =>
      ({ start, end: plus(start, vector), px: residualPx, fits: inlier }));
  }

  /** From what is seen to what it was matched with, wherever that truly is. */
  #correspondences() {
    const placed = this.frame.pairs.filter((pair) => this.place(pair.mapped));
    return placed.map((pair) => {
      const start = middle(...placeOf(this.frame.observed[pair.observed]));
      const end = nearestOn(this.place(pair.mapped), start);
      return { start, end, px: gap(start, end), fits: this.isFitting(pair) };
    });
  }

  /** From where each end of an element is in truth to where the estimate has it. */
  #errors() {
    return this.mapped.filter((row) => this.place(row, "truth")).flatMap((row) => {
      const [estimated, true_] = [this.place(row), this.place(row, "truth")];
      const ends = [0, 1].filter((end) => estimated[end] && true_[end]);
      return ends.map((end) => ({ start: true_[end], end: estimated[end], px: gap(true_[end], estimated[end]), fits: true }));
    });
  }

  isFitting(pair) {
    return pair.inlier && !this.isWrong(pair);
  }

  /** Whether a pair joins two things that are known to differ. */
  isWrong(pair) {
    const { truth } = this.frame.observed[pair.observed];
    return truth !== null && truth !== pair.mapped;
  }

  /** What an observed row is called: as its match, or by its number. */
  nameOf(row) {
    const pair = this.pairOf.get(row);
    if (!pair) return `#${row}`;
    const name = this.frame.mapped[pair.mapped].name;
    const { truth } = this.frame.observed[row];
    return this.mode === "pairs" && this.isWrong(pair) ? `${name}, is ${this.frame.mapped[truth].name}` : name;
  }

  /** One line on what is drawn or why it is not. */
  get about() {
    if (!this.isPossible) return MISSING[this.mode];
    const title = this.mode === "pairs" ? this.#countPairs() : `${MODES[this.mode].title}, ${this.#countInView()}`;
    const failed = [[this.missed, "missed"], [this.false, "false"]].filter(([rows]) => rows.length);
    const counts = failed.map(([rows, what]) => `${rows.length} ${what}`);
    return this.hasVectors ? [title, ...counts].join(", ") : `detections are of the left image; ${title}`;
  }

  #countPairs() {
    const outliers = this.frame.pairs.filter((pair) => !this.isFitting(pair)).length;
    return `${this.frame.pairs.length} pairs, ${outliers} outliers`;
  }

  #countInView() {
    const inView = this.frame.mapped.filter((_, row) => this.place(row)).length;
    return `${inView} of ${this.frame.mapped.length} in view`;
  }

  /** Why a selected map element is not in the image; empty where it is. */
  whyAbsent(element) {
    const row = this.frame.mapped.findIndex((one) => one.id === element);
    if (row < 0) return "the selected element is not near the prior";
    if (!this.isPossible || this.place(row)) return "";
    const { name, behind } = this.frame.mapped[row];
    return `${name} is ${behind ? "behind the camera" : "outside the image"}`;
  }
}

/** Whether an end is known, or else "cut" off by the image's border or "hidden" by something. */
export function endState(known, [u, v], { width, height }) {
  if (known) return "known";
  const inside = Math.min(u + 0.5, v + 0.5, width - 0.5 - u, height - 0.5 - v);
  return inside < BORDER_PX ? "cut" : "hidden";
}

export const placeOf = ({ anchor, end }) => [anchor, end];

export const middle = (anchor, end) => (end ? [(anchor[0] + end[0]) / 2, (anchor[1] + end[1]) / 2] : anchor);

/** The point of an element that is nearest to another point: ends of poles may be out of sight. */
export function nearestOn([a, b], [x, y]) {
  if (!b) return a;
  const [dx, dy] = [b[0] - a[0], b[1] - a[1]];
  const share = ((x - a[0]) * dx + (y - a[1]) * dy) / (dx * dx + dy * dy || 1);
  const within = Math.min(1, Math.max(0, share));
  return [a[0] + within * dx, a[1] + within * dy];
}

const plus = ([x, y], [dx, dy]) => [x + dx, y + dy];
export const gap = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);
