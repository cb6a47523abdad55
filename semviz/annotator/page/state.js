// What the page knows, and what follows from it. No DOM here.

export const SIDES = ["left", "right"];
export const other = (side) => (side === "left" ? "right" : "left");

/** What `bright` does unless a person wants it otherwise. */
export const PLAIN_LIGHT = { brightness: 1.7, contrast: 1.15 };

/** The page's state: server truth (`labels`), what hangs in the outbox, and what only this page has. */
export class State {
  constructor() {
    this.hello = null; // workspace, classes, image sizes: fixed for the session
    this.labels = null; // the last summary and frame from the server
    this.frame = null; // number of the frame on screen
    this.classId = 0; // for the next element
    this.selected = null; // {element, side} or null; side of the observation in hand
    this.vertex = "anchor"; // which end of the selected pole the arrows move
    this.aids = { snap: true, loupe: true, guides: true, ghosts: true, bright: false, map: true };
    this.light = { ...PLAIN_LIGHT }; // of the images, while the aid `bright` is on
    this.past = null; // {operation, done, frame}: the earlier state that the images show
    this.cursor = null; // {side, pixel}: where the keys would set a point
    this.drawing = null; // {side, class, anchor, end, box}: the element under the pen
    this.dragged = null; // {observation, anchor, end}: what the pen moves
    this.look = null; // guides, snapped drawing and card of what is in hand, from the server
    this.pointed = null; // the element whose offer is under the pointer
    this.swapped = new Set(); // ids of offers whose runner-up is taken for the best
    this.jump = "unreviewed"; // the list that the jump keys go through; see jumps.js
    this.review = null; // the decision of the last map, or the finding in it, that is open; see review.js
    this.conflict = null; // {edit, theirs, text}: somebody changed what an edit starts from
    this.pending = []; // [{request, edit}] on their way, oldest first
    this.onDisk = null; // {request, operation}: the last edit that was saved; its labels may still be on their way
    this.connected = false;
    this.theme = "dark";
    this.changedKeys = {}; // as `Keys.changed`: badges are drawn again
    this.trouble = null; // why the server could not save
    this.ordered = {}; // `order`, of these frames
    this.listeners = [];
    this.shown = null; // `elements` and `offers`, kept until something changes: they are asked
    this.offered = null; // for many times
  }

  onChange(listener) {
    this.listeners.push(listener);
  }

  /** Sets fields and tells every listener once. */
  set(fields) {
    Object.assign(this, fields, { shown: null, offered: null });
    this.listeners.forEach((listener) => listener());
  }

  /** The labels of the frame on screen, now or as they were; null until they have come. */
  get shownFrame() {
    const frame = this.past?.frame ?? this.labels?.frame;
    return frame?.index === this.frame ? frame : null;
  }

  /** Labelled elements of the frame on screen, as they will be once the outbox is empty. */
  get elements() {
    this.shown ??= this.#elements();
    return this.shown;
  }

  #elements() {
    if (!this.shownFrame) return [];
    const { elements: saved, offers } = this.shownFrame;
    if (this.past) return saved;
    const elements = withPending(saved, this.pending, this.frame, offers);
    if (this.dragged) {
      const found = find(elements, this.dragged.observation);
      if (found) Object.assign(found.element.observations[found.side], { ...this.dragged, id: this.dragged.observation });
    }
    return elements;
  }

  /** What is proposed in the images of the frame on screen, by element: `{id, name, class, score,
   * sure, left, right}`. `left` and `right` are marks, there where something is proposed. */
  get offers() {
    this.offered ??= this.#offers();
    return this.offered;
  }

  #offers() {
    if (!this.shownFrame) return [];
    const observed = new Map(this.elements.map((one) => [one.id, one.observations]));
    return this.shownFrame.offers.map((offer) => {
      const shown = { ...offer };
      for (const side of SIDES) {
        if (!offer[side]) continue;
        if (observed.get(offer.id)?.[side] || isSettled(this.pending, offer[side].id)) delete shown[side];
        else if (this.swapped.has(offer[side].id)) shown[side] = swapped(offer[side]);
      }
      return shown;
    }).filter((offer) => SIDES.some((side) => offer[side]));
  }

  /** Whether an element is one that an open decision or finding is about. */
  isReviewed(id) {
    return Boolean(this.review?.elements.some((one) => one.id === id));
  }

  /** Elements to continue of which nobody knows where they are: `{id, name, class, labelled_in}`. */
  get nearby() {
    if (!this.shownFrame) return [];
    const here = new Set([...this.elements, ...this.offers].map((one) => one.id));
    return this.shownFrame.nearby.filter((one) => !here.has(one.id));
  }

  /** Offers of elements that are not labelled in either image of this frame. */
  get expected() {
    const here = new Set(this.elements.map((one) => one.id));
    return this.offers.filter((offer) => !here.has(offer.id));
  }

  /** What the proposal keys act on: the offer under the pointer, or else the selected element's, or
   * else the first of all. */
  get currentOffer() {
    const { offers, selected, pointed } = this;
    if (!this.aids.ghosts || this.drawing) return null;
    const named = (id) => id && offers.find((offer) => offer.id === id);
    return named(pointed) || named(selected?.element) || offers[0] || null;
  }

  /** Offers of which every mark is sure. */
  get sureOffers() {
    return this.aids.ghosts ? this.offers.filter((offer) => offer.sure) : [];
  }

  /** Numbers of all frames, in order of time. */
  get order() {
    const { frames } = this.labels;
    if (this.ordered.frames !== frames) this.ordered = { frames, order: frames.map((one) => one.index) };
    return this.ordered.order;
  }

  get selectedElement() {
    return this.elements.find((element) => element.id === this.selected?.element) ?? null;
  }

  /** A selected element that is not labelled here: proposed or only known from nearby. */
  get selectedGhost() {
    const id = this.selected?.element;
    return this.offers.find((one) => one.id === id) ?? this.nearby.find((one) => one.id === id) ?? null;
  }

  /** The observation in hand: the selected element's on the selected side. */
  get selectedObservation() {
    return this.selectedElement?.observations[this.selected.side] ?? null;
  }

  /** The CSS filter of the images and the loupe. */
  get filter() {
    return this.aids.bright ? `brightness(${this.light.brightness}) contrast(${this.light.contrast})` : "none";
  }

  /** The images on the page: `{left: {frame, side}, right}`; with one camera, right is another
   * frame's left image, or missing. */
  get panes() {
    const known = this.labels?.frame?.index === this.frame ? this.labels.frame.panes : null;
    const left = { frame: this.frame, side: "left" };
    return known ?? (this.hasRight ? { left, right: { frame: this.frame, side: "right" } } : { left });
  }

  classOf(id) {
    return this.hello.classes.find((one) => one.id === id);
  }

  /** A class's colour on panels; on images it is always `color`. */
  colorOf(one) {
    return this.theme === "light" ? one.color_light : one.color;
  }

  get hasRight() {
    return this.hello?.has_right;
  }
}

/** What `edit` starts from, `{element, side, observation}`, as it is shown; null where from nothing, or
 * from what is not on disk yet and so nobody else can have changed. */
export function startOf(elements, edit) {
  const found = edit.observation_id ? find(elements, edit.observation_id) : null;
  const observation = found?.element.observations[found.side];
  return observation?.frame === undefined ? null : { ...found, observation };
}

/** What the server compares with what is there now: has somebody else changed it meanwhile? */
export function seen({ element, observation }) {
  const { anchor, end, anchor_known, end_known, frame, side } = observation;
  return { element: element.id, frame, side, anchor, end, anchor_known, end_known };
}

/** An edit of an observation that somebody has deleted, as a drawing of what it would have made;
 * null where it would have deleted it too. `shown` is {frame, side, class}. */
export function drawnAgain(edit, { frame, side, class: id }) {
  const observations = { [side]: { ...edit.seen } };
  APPLY[edit.kind]?.(observations, side, edit);
  const mark = observations[side];
  return mark ? {
    kind: "draw",
    observation_id: uuid7(),
    element_id: uuid7(),
    frame_index: frame,
    side,
    class_id: id,
    anchor_px: mark.anchor,
    end_px: mark.end,
    anchor_known: mark.anchor_known,
    end_known: mark.end_known,
    selected_id: edit.seen.element,
    snap: false,
  } : null;
}

/** Whether `edit` leaves `elements` as they are, such as a drag that ends where it began. */
export function isIdle(elements, edit) {
  if (!(edit.kind in APPLY) || !find(elements, edit.observation_id)) return false;
  return JSON.stringify(withPending(elements, [{ edit }], null)) === JSON.stringify(elements);
}

/** `elements` with the edits of `pending` that touch `frame` applied; pure. `offers` names what is
 * accepted of them. */
export function withPending(elements, pending, frame, offers = []) {
  const result = structuredClone(elements);
  for (const { edit } of pending) {
    const marks = edit.kind === "draw" ? [edit] : edit.kind === "accept" ? edit.marks : null;
    if (marks) {
      for (const mark of marks) if (mark.frame_index === frame) add(result, mark, offers);
      continue;
    }
    const found = edit.observation_id && find(result, edit.observation_id);
    if (found) APPLY[edit.kind]?.(found.element.observations, found.side, edit);
  }
  return result.filter((one) => SIDES.some((side) => one.observations[side]));
}

const APPLY = {
  move(observations, side, { anchor_px, end_px }) {
    Object.assign(observations[side], { anchor: anchor_px, end: end_px });
  },
  "set known"(observations, side, { anchor_known, end_known }) {
    const now = observations[side];
    now.anchor_known = anchor_known ?? now.anchor_known;
    now.end_known = end_known ?? now.end_known;
  },
  "swap ends"(observations, side) {
    const { anchor, end, anchor_known, end_known } = observations[side];
    Object.assign(observations[side], {
      anchor: end, end: anchor, anchor_known: end_known, end_known: anchor_known,
    });
  },
  delete(observations, side) {
    delete observations[side];
  },
};

/** Shows a mark that is on its way: of an element that is there, or of a new one. */
function add(elements, mark, offers) {
  if (find(elements, mark.observation_id)) return;
  const known = elements.find((one) => one.id === mark.element_id);
  if (known) known.observations[mark.side] ??= observed(mark);
  else elements.push(drawn(mark, offers.find((one) => one.id === mark.element_id)));
}

/** Whether an offer has been accepted or turned down by an edit that is on its way. */
function isSettled(pending, id) {
  return pending.some(({ edit }) =>
    (edit.kind === "dismiss" && edit.dismissals.some((one) => one.id === id)) ||
    (edit.kind === "accept" && edit.marks.some((one) => one.observation_id === id)));
}

/** A mark with its runner-up in its place, and the other way round. */
function swapped({ runner_up: other, ...mark }) {
  const { anchor, end, anchor_known, end_known, score } = mark;
  return { ...mark, ...other, runner_up: { anchor, end, anchor_known, end_known, score } };
}

function find(elements, observation) {
  for (const element of elements) {
    const side = SIDES.find((one) => element.observations[one]?.id === observation);
    if (side) return { element, side };
  }
  return null;
}

function observed(mark) {
  return {
    id: mark.observation_id,
    anchor: mark.anchor_px,
    end: mark.end_px,
    anchor_known: mark.anchor_known,
    end_known: mark.end_known,
  };
}

function drawn(mark, offer) {
  return {
    id: mark.element_id,
    name: offer?.name ?? "new",
    class: offer?.class ?? mark.class_id,
    kept: true, // not on disk yet
    observations: { [mark.side]: observed(mark) },
    card: null,
  };
}

/** A UUID of version 7 (RFC 9562, 5.7): sortable by the millisecond of its making. */
export function uuid7() {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  new DataView(bytes.buffer).setUint16(0, Math.floor(Date.now() / 2 ** 32));
  new DataView(bytes.buffer).setUint32(2, Date.now() % 2 ** 32);
  bytes[6] = 0x70 | (bytes[6] & 0x0f);
  bytes[8] = 0x80 | (bytes[8] & 0x3f);
  const hex = [...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join("");
  return hex.replace(/(.{8})(.{4})(.{4})(.{4})(.{12})/, "$1-$2-$3-$4-$5");
}

/** 4213 as people read it: "4 213". */
export const spaced = (number) => String(number).replace(/\B(?=(\d{3})+(?!\d))/g, " ");

/** A score as people read it, never rounded up: 0.798 is not yet the 0.80 that is sure. */
export const shownScore = (score) => (Math.floor(100 * score) / 100).toFixed(2);
