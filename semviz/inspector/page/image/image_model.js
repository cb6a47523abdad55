// @ts-check
/* What is drawn on an image: elements, their positions, and the vectors between them. */

/** @typedef {import("/static/protocol").inspector.FrameView} FrameView */
/** @typedef {import("/static/protocol").inspector.ImageSize} ImageSize */
/** @typedef {import("/static/protocol").inspector.PairView} PairView */
/** @typedef {import("/static/protocol").inspector.RightMapped} RightMapped */
/** @typedef {import("/static/protocol").inspector.StateView} StateView */
/** @typedef {import("/static/canvas.js").Point} Point */
/** @typedef {import("../panel.js").Ends} Ends */

/** @typedef {StateView["mode"]} Mode */
/** @typedef {"known" | "cut" | "hidden"} EndState */
/** @typedef {{mapped: RightMapped[]}} RightImage */
/** An error of the map in the image, px.
 *
 * @typedef {{start: Point, end: Point, px: number, fits: boolean}} Vector
 */

/** @type {Record<Mode, {title: string, pose: "estimate" | "truth", magnification: number}>} */
const MODES = {
  estimate: { title: "map at the estimate", pose: "estimate", magnification: 8 },
  truth: { title: "map at the true pose", pose: "truth", magnification: 8 },
  pairs: { title: "pairs", pose: "truth", magnification: 1 },
  error: { title: "map from true pose to estimate", pose: "estimate", magnification: 1 },
};
const MISSING = {
  estimate: "no pose: press 2 for the true one",
  truth: "no ground truth: press 1 for the estimate",
  pairs: "no pose: no pairs",
  error: "no ground truth or no pose: no error",
};
const BORDER_PX = 2; // an unknown end this near the border is cut off there, others are hidden

/** One frame in one image and mode. Detections are of the left image; the right one shows the map
 * alone. */
export class ImageModel {
  /** `right` is null for the left image.
   *
   * @param {FrameView} frame
   * @param {Mode} mode
   * @param {ImageSize} size
   * @param {RightImage | null} [right]
   */
  constructor(frame, mode, size, right = null) {
    this.frame = frame;
    this.mode = mode;
    this.size = size;
    this.right = right;
    this.magnification = MODES[mode].magnification;
    this.observed = right || mode === "error" ? [] : frame.observed;
    this.pairOf = new Map(frame.pairs.map((pair) => [pair.observed, pair]));
    const pairs = mode === "truth" ? frame.true_pairs : frame.pairs;
    this.matched = new Set(pairs.map((pair) => pair.mapped));
    this.pose = mode === "pairs" && !frame.has_truth ? "estimate" : MODES[mode].pose;
  }

  /** Whether the poses that the mode needs are known. */
  get isPossible() {
    const { has_truth: hasTruth, status } = this.frame;
    if (this.mode === "truth") return hasTruth;
    return status !== "cannot" && (this.mode !== "error" || hasTruth);
  }

  /** The ends of row `row` of the map; null if they are not in or near the image.
   *
   * @param {number} row
   * @param {"estimate" | "truth"} [pose]
   * @returns {Ends | null}
   */
  place(row, pose = this.pose) {
    return (this.right?.mapped ?? this.frame.mapped)[row][pose];
  }

  /** Map rows that are drawn. */
  get mapped() {
    const rows = [...this.frame.mapped.keys()].filter((row) => this.place(row));
    return this.mode === "pairs" ? rows.filter((row) => this.matched.has(row)) : rows;
  }

  /** Map rows that the detector missed in this image. */
  get missedDetections() {
    if (!this.#isDetected || !this.isPossible) return [];
    return this.frame.missed_detections.filter((row) => this.place(row));
  }

  /** Rows of detections that are false positives. */
  get falsePositives() {
    return this.#isDetected ? this.frame.false_positives : [];
  }

  get #isDetected() {
    return !this.right && this.mode !== "error";
  }

  /** The right image has no detections, so it can only compare poses. */
  get hasVectors() {
    return !this.right || this.mode === "error";
  }

  /** The vectors, not magnified.
   *
   * @returns {Vector[]}
   */
  get vectors() {
    if (this.mode === "error") return this.#errors();
    if (!this.hasVectors) return [];
    return this.mode === "pairs" ? this.#correspondences() : this.#residuals();
  }

  #residuals() {
    const pairs = this.mode === "truth" ? this.frame.true_pairs : this.frame.pairs;
    return pairs.flatMap(({ start, vector, residual_px: px, inlier }) => {
      const [from, by] = [finite(start), finite(vector)];
      return from && by ? [{ start: from, end: plus(from, by), px: px ?? 0, fits: inlier }] : [];
    });
  }

  /** From each detection to the true position of the element matched with it. */
  #correspondences() {
    return this.frame.pairs.flatMap((pair) => {
      const place = this.place(pair.mapped);
      if (!place) return [];
      const start = middle(...placeOf(this.frame.observed[pair.observed]));
      const end = nearestOn(place, start);
      return [{ start, end, px: gap(start, end), fits: this.isGood(pair) }];
    });
  }

  /** From the true position of each end to its position under the estimate. */
  #errors() {
    return this.mapped.flatMap((row) => {
      const [estimated, true_] = [this.place(row) ?? [], this.place(row, "truth") ?? []];
      return [0, 1].flatMap((at) => {
        const [start, end] = [true_[at], estimated[at]];
        return start && end ? [{ start, end, px: gap(start, end), fits: true }] : [];
      });
    });
  }

  /** @param {PairView} pair */
  isGood(pair) {
    return pair.inlier && !this.isWrong(pair);
  }

  /** Whether ground truth contradicts a pair.
   *
   * @param {PairView} pair
   */
  isWrong(pair) {
    const { truth } = this.frame.observed[pair.observed];
    return truth !== null && truth !== pair.mapped;
  }

  /** The name of a detection: that of its match, or else its number.
   *
   * @param {number} row
   */
  nameOf(row) {
    const pair = this.pairOf.get(row);
    if (!pair) return `#${row}`;
    const name = this.frame.mapped[pair.mapped].name;
    const { truth } = this.frame.observed[row];
    return this.mode === "pairs" && truth !== null && this.isWrong(pair) ? `${name}, is ${this.frame.mapped[truth].name}` : name;
  }

  /** A short line that describes what is drawn, or why it is not. The pressed button names the pose. */
  get about() {
    if (!this.isPossible || !this.hasVectors) return this.details;
    const isNamed = this.mode === "estimate" || this.mode === "truth";
    const faults = this.#countFaults();
    return (isNamed && faults.length ? faults : [this.#title, ...faults]).join(", ");
  }

  /** All that there is to say about what is drawn. */
  get details() {
    if (!this.isPossible) return MISSING[this.mode];
    if (!this.hasVectors) return `detections are of the left image; ${this.#title}`;
    return [this.#title, ...this.#countFaults(), this.mode === "pairs" ? "" : this.#countInView()].filter(Boolean).join(", ");
  }

  get #title() {
    return this.mode === "pairs" ? this.#countPairs() : MODES[this.mode].title;
  }

  #countFaults() {
    const [missed, wrong] = [this.missedDetections.length, this.falsePositives.length];
    return [missed ? `${missed} missed` : "", wrong ? count(wrong, "false positive") : ""].filter(Boolean);
  }

  #countPairs() {
    const outliers = this.frame.pairs.filter((pair) => !this.isGood(pair)).length;
    return `${count(this.frame.pairs.length, "pair")}, ${count(outliers, "outlier")}`;
  }

  #countInView() {
    const inView = this.frame.mapped.filter((_, row) => this.place(row)).length;
    return inView < this.frame.mapped.length ? `${inView} of ${this.frame.mapped.length} in view` : "";
  }

  /** Why a selected map element is not in the image; empty if it is.
   *
   * @param {number} element
   */
  whyAbsent(element) {
    const row = this.frame.mapped.findIndex((mapped) => mapped.id === element);
    if (row < 0) return "the selected element is not in the submap";
    if (!this.isPossible || this.place(row)) return "";
    const { name, behind } = this.frame.mapped[row];
    return `${name} is ${behind ? "behind the camera" : "outside the image"}`;
  }
}

/** Whether an end is known, cut off by the image's border, or hidden by an object.
 *
 * @param {boolean} known
 * @param {Point} point
 * @param {ImageSize} size
 * @returns {EndState}
 */
export function endState(known, [u, v], { width, height }) {
  if (known) return "known";
  const inside = Math.min(u + 0.5, v + 0.5, width - 0.5 - u, height - 0.5 - v);
  return inside < BORDER_PX ? "cut" : "hidden";
}

/**
 * @param {{anchor: Point, end: Point | null}} element
 * @returns {Ends}
 */
export const placeOf = ({ anchor, end }) => [anchor, end];

/**
 * @param {Point} anchor
 * @param {Point | null} end
 * @returns {Point}
 */
export const middle = (anchor, end) => (end ? [(anchor[0] + end[0]) / 2, (anchor[1] + end[1]) / 2] : anchor);

/** The point of an element nearest to another point: ends of poles may be outside the image.
 *
 * @param {Ends} ends
 * @param {Point} point
 * @returns {Point}
 */
export function nearestOn([a, b], [x, y]) {
  if (!b) return a;
  const [dx, dy] = [b[0] - a[0], b[1] - a[1]];
  const share = ((x - a[0]) * dx + (y - a[1]) * dy) / (dx * dx + dy * dy || 1);
  const within = Math.min(1, Math.max(0, share));
  return [a[0] + within * dx, a[1] + within * dy];
}

/** A point, or null if a coordinate is null.
 *
 * @param {[number | null, number | null]} point
 * @returns {Point | null}
 */
const finite = ([x, y]) => (x === null || y === null ? null : [x, y]);

/** @type {(number: number, noun: string) => string} */
const count = (number, noun) => `${number} ${noun}${number === 1 ? "" : "s"}`;

/**
 * @param {Point} a
 * @param {Point} b
 * @returns {Point}
 */
const plus = ([x, y], [dx, dy]) => [x + dx, y + dy];
/**
 * @param {Point} a
 * @param {Point} b
 */
export const gap = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);
