// @ts-check
/* Decoded images of a run; those of neighbouring frames are fetched ahead. */

const MAX_IMAGES = 24;
const DELAY_MS = 100; // decoding is slow: not while a frame is drawn, also in 3D
const RUSH_MS = 250; // after a faster step the next image is needed at once

/** @typedef {"left" | "right"} Side */
/** @typedef {{name: string, created: string, frames: unknown[]}} ImageRun the run of the images */
/** @typedef {{bitmap: ImageBitmap | null, reason: string}} LoadedImage a decoded image, or the reason why there is none */

export class ImageCache {
  constructor() {
    /** @type {ImageRun} */
    this.run = { name: "", created: "", frames: [] };
    /** @type {Map<string, Promise<LoadedImage>>} */
    this.loads = new Map();
    this.requestedAt = 0;
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    this.timer = undefined;
  }

  /** @param {ImageRun} run */
  open(run) {
    this.run = run;
    this.loads.clear();
    this.requestedAt = 0;
  }

  /** Fetches the images around `position` soon.
   *
   * @param {number} position
   * @param {Side} side
   */
  prefetch(position, side) {
    const isRush = performance.now() - this.requestedAt < RUSH_MS;
    this.requestedAt = performance.now();
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.#fetchAround(position, side), isRush ? 0 : DELAY_MS);
  }

  /**
   * @param {number} position
   * @param {Side} side
   */
  #fetchAround(position, side) {
    for (const near of [position + 1, position - 1, position + 2]) {
      if (near >= 0 && near < this.run.frames.length) this.get(near, side);
    }
  }

  /** The image of one side at a position of the run.
   *
   * @param {number} position
   * @param {Side} side
   * @returns {Promise<LoadedImage>}
   */
  get(position, side) {
    const name = `${position} ${side}`;
    const known = this.loads.get(name);
    if (known) this.loads.delete(name); // moves it to the end: the oldest is dropped first
    const loading = known ?? fetchImage(this.run, position, side);
    this.loads.set(name, loading);
    const [oldest] = this.loads.keys();
    if (this.loads.size > MAX_IMAGES) this.loads.delete(oldest);
    return loading;
  }
}

/**
 * @param {ImageRun} run
 * @param {number} position
 * @param {Side} side
 * @returns {Promise<LoadedImage>}
 */
async function fetchImage(run, position, side) {
  const query = new URLSearchParams({ run: run.name, position: String(position), side, made: run.created });
  const response = await fetch(`/image?${query}`);
  const isImage = response.headers.get("Content-Type")?.startsWith("image/");
  if (!isImage) return { bitmap: null, reason: await response.text() };
  try {
    return { bitmap: await createImageBitmap(await response.blob()), reason: "" };
  } catch {
    return { bitmap: null, reason: "The image of this frame cannot be decoded." };
  }
}
