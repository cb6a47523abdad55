// What the page knows, and what follows from it. No DOM here.

export const SIDES = ["left", "right"];
export const other = (side) => (side === "left" ? "right" : "left");

/** The page's state: server truth (`labels`), what hangs in the outbox, and what only this page has. */
export class State {
  constructor() {
    this.hello = null; // workspace, classes, image sizes: fixed for the session
    this.labels = null; // the last summary and frame from the server
    this.frame = null; // number of the frame on screen
    this.classId = 0; // for the next element
    this.selected = null; // {element, side} or null; side of the observation in hand
    this.vertex = "anchor"; // which end of the selected pole the arrows move
    this.aids = { loupe: true, guides: true, ghosts: true, bright: false, map: true };
    this.drawing = null; // {side, class, anchor, end, box}: the element under the pen
    this.dragged = null; // {observation, anchor, end}: what the pen moves
    this.look = null; // guides and card of what is in hand, from the server
    this.pending = []; // [{request, edit}] on their way, oldest first
    this.connected = false;
    this.theme = "dark";
    this.trouble = null; // why the server could not save
    this.listeners = [];
    this.shown = null; // `elements`, kept until something changes: they are asked for many times
  }

  onChange(listener) {
    this.listeners.push(listener);
  }

  /** Sets fields and tells every listener once. */
  set(fields) {
    Object.assign(this, fields, { shown: null });
    this.listeners.forEach((listener) => listener());
  }

  /** Labelled elements of the frame on screen, as they will be once the outbox is empty. */
  get elements() {
    this.shown ??= this.#elements();
    return this.shown;
  }

  #elements() {
    if (!this.labels?.frame || this.labels.frame.index !== this.frame) return [];
    const elements = withPending(this.labels.frame.elements, this.pending, this.frame);
    if (this.dragged) {
      const found = find(elements, this.dragged.observation);
      if (found) Object.assign(found.element.observations[found.side], { ...this.dragged, id: this.dragged.observation });
    }
    return elements;
  }

  /** Mapped elements that are expected in an image and not yet labelled in it, then weak ones: of
   * elements labelled in a frame nearby (`labelled_in`), with a place where there is any. */
  get ghosts() {
    if (!this.labels?.frame || this.labels.frame.index !== this.frame) return [];
    return [...this.labels.frame.ghosts, ...this.labels.frame.nearby];
  }

  /** Ghosts of elements that are not labelled in either image of this frame. */
  get expected() {
    const here = new Set(this.elements.map((one) => one.id));
    return this.ghosts.filter((ghost) => !here.has(ghost.id));
  }

  /** Numbers of all frames, in order of time. */
  get order() {
    return this.labels.frames.map((one) => one.index);
  }

  get selectedElement() {
    return this.elements.find((element) => element.id === this.selected?.element) ?? null;
  }

  get selectedGhost() {
    return this.ghosts.find((ghost) => ghost.id === this.selected?.element) ?? null;
  }

  /** The observation in hand: the selected element's on the selected side. */
  get selectedObservation() {
    return this.selectedElement?.observations[this.selected.side] ?? null;
  }

  classOf(id) {
    return this.hello.classes.find((one) => one.id === id);
  }

  /** A class's colour on panels; on images it is always `color`. */
  colorOf(one) {
    return this.theme === "light" ? one.color_light : one.color;
  }

  get hasRight() {
    return this.hello?.images.right != null;
  }
}

/** Whether `edit` leaves `elements` as they are, such as a drag that ends where it began. */
export function isIdle(elements, edit) {
  if (!(edit.kind in APPLY) || !find(elements, edit.observation_id)) return false;
  return JSON.stringify(withPending(elements, [{ edit }], null)) === JSON.stringify(elements);
}

/** `elements` with the edits of `pending` that touch `frame` applied; pure. */
export function withPending(elements, pending, frame) {
  const result = structuredClone(elements);
  for (const { edit } of pending) {
    if (edit.kind === "draw" && edit.frame_index === frame) {
      if (!find(result, edit.observation_id)) result.push(drawn(edit));
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

function find(elements, observation) {
  for (const element of elements) {
    const side = SIDES.find((one) => element.observations[one]?.id === observation);
    if (side) return { element, side };
  }
  return null;
}

function drawn(edit) {
  const observation = {
    id: edit.observation_id,
    anchor: edit.anchor_px,
    end: edit.end_px,
    anchor_known: edit.anchor_known,
    end_known: edit.end_known,
  };
  return {
    id: edit.element_id,
    name: "new",
    class: edit.class_id,
    kept: true, // not on disk yet
    observations: { [edit.side]: observation },
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
