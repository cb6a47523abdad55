// Decoded images, the last few kept, so that stepping to the next frame shows it at once.

const KEPT = 12;

export class Pictures {
  constructor() {
    this.kept = new Map(); // "frame/side" -> promise, least recently used first
  }

  /** {bitmap, message}: the decoded image, or null and why there is none. */
  get(frame, side) {
    const key = `${frame}/${side}`;
    const found = this.kept.get(key) ?? this.#load(key);
    this.kept.delete(key);
    this.kept.set(key, found);
    for (const oldest of [...this.kept.keys()].slice(0, -KEPT)) this.kept.delete(oldest);
    return found;
  }

  async #load(key) {
    try {
      const answer = await fetch(`image/${key}.png`);
      if (!answer.ok) return this.#failed(key, await answer.text());
      // colours as they are in the file: a label is made on pixels, not on a colour profile
      const options = { colorSpaceConversion: "none" };
      return { bitmap: await createImageBitmap(await answer.blob(), options), message: "" };
    } catch {
      return this.#failed(key, "No connection. The image comes when the server is back.");
    }
  }

  #failed(key, message) {
    this.kept.delete(key);
    return { bitmap: null, message };
  }
}
