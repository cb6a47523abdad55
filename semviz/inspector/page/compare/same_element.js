// @ts-check
/* Finds the selection of run B in run A. */

/** @typedef {import("/static/protocol").inspector.FrameView} FrameView */
/** @typedef {import("/static/protocol").inspector.MapChangeView} MapChangeView */
/** @typedef {import("/static/protocol").inspector.StateView} StateView */

/** Ids of map elements may differ between the maps of the runs. */
export class SameElement {
  /** @type {Map<number, number>} */
  toBase = new Map();
  /** @type {Map<number, number>} */
  fromBase = new Map();
  /** The clicked map change, which may name an element that only A has.
   *
   * @type {MapChangeView | null} */
  chosen = null;

  /** `baseIds` holds the ids in A's map by those in B's, if they differ.
   *
   * @param {{[id: string]: number}} baseIds
   */
  use(baseIds) {
    this.toBase = new Map(Object.entries(baseIds).map(([id, base]) => [Number(id), base]));
    this.fromBase = new Map([...this.toBase].map(([id, base]) => [base, id]));
    this.chosen = null;
  }

  /** @param {number | null} element */
  inBase(element) {
    if (this.chosen && this.chosen.element === element) return this.chosen.base_element;
    return element === null ? null : this.toBase.get(element) ?? element;
  }

  /** @param {number} baseElement */
  inOther(baseElement) {
    return this.fromBase.get(baseElement) ?? baseElement;
  }

  /** The selection of `state`, which is of B's frame `other`, in A's `frame`: the detection at the same
   * position, or else the one matched with the same element.
   *
   * @param {StateView} state
   * @param {FrameView} other
   * @param {FrameView} frame
   */
  selection(state, other, frame) {
    const element = this.inBase(state.element);
    const seen = state.observed === null ? undefined : other.observed[state.observed];
    const same = frame.observed.findIndex((detection) => seen && detection.class_id === seen.class_id && `${detection.anchor}` === `${seen.anchor}`);
    if (same >= 0) return { observed: same, element };
    const pair = element === null ? null : frame.pairs.find(({ mapped }) => frame.mapped[mapped].id === element);
    return { observed: pair?.observed ?? null, element };
  }
}
