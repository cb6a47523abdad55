// @ts-check
// A cache of decoded images, so that the next frame shows at once.

const CACHED = 12;

/** An image; null with the reason if there is none.
 * @typedef {{bitmap: ImageBitmap | null, message: string}} Picture */

export class Pictures {
  constructor() {
    /** @type {Map<string, Promise<Picture>>} by "frame/side", least recently used first */
    this.cached = new Map();
  }

  /** The decoded image.
   *
   * @param {number} frame
   * @param {"left" | "right"} side
   */
  get(frame, side) {
    const key = `${frame}/${side}`;
    const picture = this.cached.get(key) ?? this.#load(key);
    this.cached.delete(key);
    this.cached.set(key, picture);
    for (const oldest of [...this.cached.keys()].slice(0, -CACHED)) this.cached.delete(oldest);
    return picture;
  }

  /**
   * @param {string} key
   * @returns {Promise<Picture>}
   */
  async #load(key) {
    try {
      const answer = await fetch(`image/${key}.png`);
      if (!answer.ok) return this.#failed(key, await answer.text());
      // without colour profile: labels refer to the pixels of the file
      const bitmap = await createImageBitmap(await answer.blob(), { colorSpaceConversion: "none" });
      return { bitmap, message: "" };
    } catch {
      return this.#failed(key, "No connection. The image loads when the server is back.");
    }
  }

  /**
   * @param {string} key
   * @param {string} message
   */
  #failed(key, message) {
    this.cached.delete(key);
    return { bitmap: null, message };
  }
}
