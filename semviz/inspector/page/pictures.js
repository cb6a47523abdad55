/* The images of a run, decoded, with the neighbours of the current frame ahead of time. */

const KEPT = 24;
const LATER_MS = 100; // decoding takes a processor: not while a frame is drawn, in 3D too
const RUSH_MS = 250; // who goes on sooner needs the next picture more

export class Pictures {
  open(run) {
    this.run = run;
    this.kept = new Map();
    this.asked = 0;
  }

  /** Gets those around `position` soon. */
  prefetch(position, side) {
    const isRush = performance.now() - this.asked < RUSH_MS;
    this.asked = performance.now();
    clearTimeout(this.later);
    this.later = setTimeout(() => this.#getAround(position, side), isRush ? 0 : LATER_MS);
  }

  #getAround(position, side) {
    for (const near of [position + 1, position - 1, position + 2]) {
      if (near >= 0 && near < this.run.frames.length) this.get(near, side);
    }
  }

  /** The decoded image of a camera at `position` and "", or null and why it cannot be had:
   * `{picture, why}`. */
  get(position, side) {
    const name = `${position} ${side}`;
    const known = this.kept.get(name);
    if (known) this.kept.delete(name); // moves it to the end: the oldest is dropped first
    const coming = known ?? load(this.run, position, side);
    this.kept.set(name, coming);
    if (this.kept.size > KEPT) this.kept.delete(this.kept.keys().next().value);
    return coming;
  }
}

async function load(run, position, side) {
  const query = new URLSearchParams({ run: run.name, position, side, made: run.created });
  const answer = await fetch(`/image?${query}`);
  const isImage = answer.headers.get("Content-Type").startsWith("image/");
  if (!isImage) return { picture: null, why: await answer.text() };
  try {
    return { picture: await createImageBitmap(await answer.blob()), why: "" };
  } catch {
    return { picture: null, why: "The image of this frame is broken." };
  }
}
