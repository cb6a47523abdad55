/* The matrix of one frame: m seen by n mapped, with dustbins, and what is to be said of its cells. */

const TOP = 3; // so many of a row are marked
const LEAST = 0.005; // if they are likelier than this

export class MatrixModel {
  constructor({ observed, mapped, matrix, pairs }) {
    this.observed = observed;
    this.mapped = mapped;
    this.probability = matrix.probability; // (m + 1) x (n + 1)
    this.rows = matrix.rows; // in the order in which they are shown
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

  /** Of a cell; null stands for the dustbin. */
  at(observed, mapped) {
    return this.probability[observed ?? this.m][mapped ?? this.n];
  }

  isTrue(observed, mapped) {
    return this.observed[observed].truth === mapped;
  }

  /** Whether a pair of the answer fits; undefined where it is none. */
  fit(observed, mapped) {
    const pair = this.pairOf.get(observed);
    return pair?.mapped === mapped ? pair.inlier : undefined;
  }

  /** The cells of a row that are marked, with `place` 1 for the likeliest. */
  marksOf(i) {
    const likeliest = this.likeliest(i);
    const marked = new Set([...likeliest, this.observed[i].truth, this.pairOf.get(i)?.mapped]);
    const known = [...marked].filter((j) => j !== null && j !== undefined);
    return known.map((j) => ({ mapped: j, place: likeliest.indexOf(j) + 1, isTrue: this.isTrue(i, j), fit: this.fit(i, j) }));
  }

  /** Columns of the `TOP` likeliest mapped elements of a row, likeliest first. */
  likeliest(i) {
    return largest(this.columns, (j) => this.probability[i][j]);
  }

  /** Rows of those of a column. */
  likeliestOf(j) {
    return largest(this.rows, (i) => this.probability[i][j]);
  }

  /** 1 for the likeliest of its row; in the row of dustbins, of its column. */
  rank(observed, mapped) {
    const value = this.at(observed, mapped);
    const others = observed === null ? this.probability.map((row) => row[mapped]) : this.probability[observed];
    return 1 + others.filter((other) => other > value).length;
  }

  nameOfRow(observed) {
    return observed === null ? "not seen" : `#${observed}`;
  }

  nameOfColumn(mapped) {
    return mapped === null ? "not in the map" : this.mapped[mapped].name;
  }

  /** One line about a place that `MatrixLayout.find` gave. */
  say({ of, observed, mapped, measure }) {
    if (of === "cell") return this.sayCell(observed, mapped);
    const isRow = of === "row";
    const name = isRow ? this.nameOfRow(observed) : this.nameOfColumn(mapped);
    if (measure) return sayMeasure(measure, name, isRow ? this.row[observed ?? this.m] : this.column[mapped ?? this.n]);
    const likely = isRow ? this.likeliest(observed).map((j) => [observed, j]) : this.likeliestOf(mapped).map((i) => [i, mapped]);
    const named = likely.map(([i, j]) => `${isRow ? this.nameOfColumn(j) : this.nameOfRow(i)} ${this.at(i, j).toFixed(2)}`);
    return `${name}: ${named.join(", ") || `nothing above ${LEAST}`}`;
  }

  sayCell(observed, mapped) {
    const value = this.at(observed, mapped);
    const rank = `${ordinal(this.rank(observed, mapped))} of its ${observed === null ? "column" : "row"}`;
    const said = value < 0.0005 ? ["p < 0.001"] : [`p ${value.toFixed(3)}`, rank]; // too small ones are all alike
    if (observed !== null && mapped !== null) {
      const fit = this.fit(observed, mapped);
      if (this.isTrue(observed, mapped)) said.push("true");
      if (fit !== undefined) said.push(fit ? "fits" : "outlier");
    }
    return `${this.nameOfRow(observed)} × ${this.nameOfColumn(mapped)}: ${said.join(", ")}`;
  }
}

function sayMeasure(measure, name, { sum, entropy }) {
  if (measure === "sum") return `Sum of ${name}: ${sum.toFixed(2)}`;
  return `Entropy of ${name}: ${entropy.toFixed(2)} bits, as between ${(2 ** entropy).toFixed(1)} equal ones`;
}

function largest(indices, valueOf) {
  const likely = indices.filter((one) => valueOf(one) >= LEAST);
  return likely.sort((a, b) => valueOf(b) - valueOf(a)).slice(0, TOP);
}

/** Sum, and entropy in bits of the values as shares of it. */
function measured(values) {
  const sum = values.reduce((a, b) => a + b, 0);
  const entropy = values.reduce((bits, value) => (value > 0 ? bits - (value / sum) * Math.log2(value / sum) : bits), 0);
  return { sum, entropy };
}

function ordinal(number) {
  const teen = number % 100 > 10 && number % 100 < 14;
  return `${number}${(!teen && { 1: "st", 2: "nd", 3: "rd" }[number % 10]) || "th"}`;
}
