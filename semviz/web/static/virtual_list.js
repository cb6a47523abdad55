// @ts-check
/* A list of rows of one height, of which only those near the visible part are in the page. */

const ALL = 300; // a list up to this length is in the page as a whole
const AROUND = 30; // rows above and below the visible ones

export class VirtualList {
  /** `make` returns the row at an index.
   *
   * @param {HTMLElement} box scrolls
   * @param {number} rowPx
   * @param {(index: number) => HTMLElement} make
   */
  constructor(box, rowPx, make) {
    this.box = box;
    this.rowPx = rowPx;
    this.make = make;
    this.count = 0;
    this.current = -1;
    this.scrolledTo = -1;
    this.first = 0;
    this.end = 0;
    box.addEventListener("scroll", () => this.update());
    new ResizeObserver(() => this.update()).observe(box);
  }

  /** Shows `count` rows made anew, scrolled as far as the ones before.
   *
   * @param {number} count
   */
  show(count) {
    this.count = count;
    this.first = this.end = -1; // no rows of before stand for new ones; an emptied box would scroll to its top
    this.update();
  }

  /** Marks a row; -1 marks none. Scrolls to another row than before if it is not visible; who scrolled
   * away from the marked row is not brought back by a redraw.
   *
   * @param {number} index
   */
  mark(index) {
    this.row(this.current)?.setAttribute("aria-current", "false");
    this.current = index;
    this.#scrollTo(index);
    this.update();
    this.row(index)?.setAttribute("aria-current", "true");
  }

  /** @param {number} index */
  #scrollTo(index) {
    const { box, rowPx } = this;
    if (index === this.scrolledTo || !box.clientHeight) return; // a hidden box scrolls once it is shown
    this.scrolledTo = index;
    if (index < 0) return;
    const top = index * rowPx;
    if (top < box.scrollTop) box.scrollTop = top;
    else if (top + rowPx > box.scrollTop + box.clientHeight) box.scrollTop = top + rowPx - box.clientHeight;
  }

  /** The row at an index, if it is in the page.
   *
   * @param {number} index
   */
  row(index) {
    return index >= this.first && index < this.end ? this.box.children[index - this.first] : undefined;
  }

  /** Puts the rows near the visible part into the page. */
  update() {
    const [first, end] = wanted(this.box.scrollTop, this.box.clientHeight, this.rowPx, this.count);
    if (first === this.first && end === this.end) return;
    this.first = first;
    this.end = end;
    const rows = Array.from({ length: end - first }, (_, at) => this.make(first + at));
    this.box.replaceChildren(...rows);
    this.row(this.current)?.setAttribute("aria-current", "true");
    if (!rows.length) return;
    rows[0].style.marginTop = `${first * this.rowPx}px`; // padding of the box would make the box itself as tall
    rows[rows.length - 1].style.marginBottom = `${(this.count - end) * this.rowPx}px`;
  }
}

/** The rows that should be in the page: from the first one to before the end. They change in steps, so that
 * not every scrolled pixel makes rows.
 *
 * @param {number} topPx
 * @param {number} heightPx
 * @param {number} rowPx
 * @param {number} count
 * @returns {[number, number]}
 */
export function wanted(topPx, heightPx, rowPx, count) {
  if (count <= ALL) return [0, count];
  const lowestPx = Math.max(0, count * rowPx - heightPx); // a longer list was scrolled further
  const step = Math.floor(Math.min(topPx, lowestPx) / rowPx / AROUND) * AROUND;
  const visible = Math.ceil(heightPx / rowPx);
  return [Math.max(0, Math.min(step - AROUND, count)), Math.min(count, step + visible + 2 * AROUND)];
}
