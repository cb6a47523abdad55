/* What the selection, which is of run B, is in run A. */

/** Ids of map elements may differ between the runs' maps. */
export class SameElement {
  constructor() {
    this.use({});
  }

  /** `baseIds` has the ids in A's map by those in B's, where they differ. */
  use(baseIds) {
    this.toBase = new Map(Object.entries(baseIds).map(([id, base]) => [Number(id), base]));
    this.fromBase = new Map([...this.toBase].map(([id, base]) => [base, id]));
    this.chosen = null; // the change of the map that was clicked: it names what only A has
  }

  inBase(element) {
    if (this.chosen && this.chosen.element === element) return this.chosen.baseElement;
    return this.toBase.get(element) ?? element;
  }

  inOther(baseElement) {
    return this.fromBase.get(baseElement) ?? baseElement;
  }

  /** `{observed, element}` in A's `frame`, of `state` in B's `other`: what is seen at the same place,
   * or else what was matched with the same element. */
  selection(state, other, frame) {
    const element = this.inBase(state.element);
    const seen = other.observed[state.observed];
    const same = frame.observed.findIndex((one) => seen && one.class === seen.class && `${one.anchor}` === `${seen.anchor}`);
    if (same >= 0) return { observed: same, element };
    const pair = element === null ? null : frame.pairs.find(({ mapped }) => frame.mapped[mapped].id === element);
    return { observed: pair?.observed ?? null, element };
  }
}
