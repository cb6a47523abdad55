// @ts-check
/* The matrix of one frame: m detections by n mapped elements, with dustbins; and texts of its cells. */

/** @typedef {import("/static/protocol").inspector.FrameView} FrameView */
/** @typedef {import("/static/protocol").inspector.MatrixView} MatrixView */
/** @typedef {import("./matrix_layout.js").MatrixPlace} MatrixPlace */

const MAX_MARKED = 3; // marked candidates of a row
const MIN_PROBABILITY = 0.005; // of a marked candidate

/** @typedef {{sum: number, entropy: number}} Measured entropy in bits */
/** @typedef {{mapped: number, place: number, isTrue: boolean, fit: boolean | undefined}} Mark */

export class MatrixModel {
  /**
   * @param {FrameView} frame
   * @param {MatrixView} matrix
   */
  constructor({ observed, mapped, pairs }, matrix) {
    this.observed = observed;
    this.mapped = mapped;
    this.probability = matrix.probability; // (m + 1) x (n + 1)
    this.rows = matrix.rows; // in the order shown
    this.columns = matrix.columns;
    this.pairOf = new Map(pairs.map((pair) => [pair.observed, pair]));
    this.marks = new Map(this.rows.map((i) => [i, this.marksOf(i)])); // by row
    this.row = this.probability.map(measured);
    this.column = this.probability[0].map((_, j) => measured(this.probability.map((values) => values[j])));
  }

  get m() {
    return this.observed.length;
  }

  get n() {
    return this.mapped.length;
  }

  /** The probability of a cell; null stands for the dustbin.
   *
   * @param {number | null} observed
   * @param {number | null} mapped
   */
  at(observed, mapped) {
    return this.probability[observed ?? this.m][mapped ?? this.n];
  }

  /**
   * @param {number} observed
   * @param {number} mapped
   */
  isTrue(observed, mapped) {
    return this.observed[observed].truth === mapped;
  }

  /** Whether a pair of the estimate is an inlier; undefined for other pairs.
   *
   * @param {number} observed
   * @param {number} mapped
   */
  fit(observed, mapped) {
    const pair = this.pairOf.get(observed);
    return pair?.mapped === mapped ? pair.inlier : undefined;
  }

  /** The marked cells of a row; `place` is 1 for the likeliest.
   *
   * @param {number} i
   * @returns {Mark[]}
   */
  marksOf(i) {
    const likeliest = this.likeliest(i);
    const marked = new Set([...likeliest, this.observed[i].truth, this.pairOf.get(i)?.mapped]);
    const known = [...marked].flatMap((j) => j ?? []);
    return known.map((j) => ({ mapped: j, place: likeliest.indexOf(j) + 1, isTrue: this.isTrue(i, j), fit: this.fit(i, j) }));
  }

  /** Columns of the likeliest mapped elements of a row, likeliest first.
   *
   * @param {number} i
   */
  likeliest(i) {
    return largest(this.columns, (j) => this.probability[i][j]);
  }

  /** Rows of the likeliest detections of a column, likeliest first.
   *
   * @param {number} j
   */
  likeliestOf(j) {
    return largest(this.rows, (i) => this.probability[i][j]);
  }

  /** The rank in its row, from 1; for the row of dustbins, in its column.
   *
   * @param {number | null} observed
   * @param {number | null} mapped
   */
  rank(observed, mapped) {
    const value = this.at(observed, mapped);
    const others = observed === null ? this.probability.map((row) => row[mapped ?? this.n]) : this.probability[observed];
    return 1 + others.filter((other) => other > value).length;
  }

  /** @param {number | null} observed */
  nameOfRow(observed) {
    return observed === null ? "not detected" : `#${observed}`;
  }

  /** @param {number | null} mapped */
  nameOfColumn(mapped) {
    return mapped === null ? "not in the map" : this.mapped[mapped].name;
  }

  /** One line about a place from `MatrixLayout.find`.
   *
   * @param {MatrixPlace} place
   */
  describe(place) {
    if (place.of === "cell") return this.describeCell(place.observed, place.mapped);
    const { measure } = place;
    const name = place.of === "row" ? this.nameOfRow(place.observed) : this.nameOfColumn(place.mapped);
    if (measure) {
      const measured = place.of === "row" ? this.row[place.observed ?? this.m] : this.column[place.mapped ?? this.n];
      return describeMeasure(measure, name, measured);
    }
    const likely = place.of === "row" ? this.candidatesOfRow(place.observed) : this.candidatesOfColumn(place.mapped);
    return `${name}: ${likely.join(", ") || `nothing above ${MIN_PROBABILITY}`}`;
  }

  /** @param {number | null} i */
  candidatesOfRow(i) {
    return this.likeliest(i ?? this.m).map((j) => `${this.nameOfColumn(j)} ${this.at(i, j).toFixed(2)}`);
  }

  /** @param {number | null} j */
  candidatesOfColumn(j) {
    return this.likeliestOf(j ?? this.n).map((i) => `${this.nameOfRow(i)} ${this.at(i, j).toFixed(2)}`);
  }

  /**
   * @param {number | null} observed
   * @param {number | null} mapped
   */
  describeCell(observed, mapped) {
    const value = this.at(observed, mapped);
    const rank = `${ordinal(this.rank(observed, mapped))} of its ${observed === null ? "column" : "row"}`;
    const parts = value < 0.0005 ? ["p < 0.001"] : [`p ${value.toFixed(3)}`, rank]; // ranks of smaller ones mean nothing
    if (observed !== null && mapped !== null) {
      const fit = this.fit(observed, mapped);
      if (this.isTrue(observed, mapped)) parts.push("true");
      if (fit !== undefined) parts.push(fit ? "inlier" : "outlier");
    }
    return `${this.nameOfRow(observed)} × ${this.nameOfColumn(mapped)}: ${parts.join(", ")}`;
  }
}

/**
 * @param {"sum" | "entropy"} measure
 * @param {string} name
 * @param {Measured} measured
 */
function describeMeasure(measure, name, { sum, entropy }) {
  if (measure === "sum") return `Sum of ${name}: ${sum.toFixed(2)}`;
  return `Entropy of ${name}: ${entropy.toFixed(2)} bits, equal to ${(2 ** entropy).toFixed(1)} equally likely candidates`;
}

/**
 * @param {number[]} indices
 * @param {(index: number) => number} valueOf
 */
function largest(indices, valueOf) {
  const likely = indices.filter((index) => valueOf(index) >= MIN_PROBABILITY);
  return likely.sort((a, b) => valueOf(b) - valueOf(a)).slice(0, MAX_MARKED);
}

/** The sum, and the entropy of the normalized values in bits.
 *
 * @param {number[]} values
 * @returns {Measured}
 */
function measured(values) {
  const sum = values.reduce((a, b) => a + b, 0);
  const entropy = values.reduce((bits, value) => (value > 0 ? bits - (value / sum) * Math.log2(value / sum) : bits), 0);
  return { sum, entropy };
}

/** @param {number} number */
function ordinal(number) {
  const teen = number % 100 > 10 && number % 100 < 14;
  return `${number}${(!teen && ["", "st", "nd", "rd"][number % 10]) || "th"}`;
}
