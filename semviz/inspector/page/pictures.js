/* The images of a run, decoded, with the neighbours of the current frame ahead of time. */

const KEPT = 12;

export class Pictures {
  open(run) {
    this.run = run;
    this.kept = new Map();
  }

  /** The decoded image at `position`, or null where it cannot be had. */
  get(position) {
    const known = this.kept.get(position);
    if (known) {
      this.kept.delete(position); // moves it to the end: the oldest is dropped first
      this.kept.set(position, known);
      return known;
    }
    const coming = load(this.run, position);
    this.kept.set(position, coming);
    if (this.kept.size > KEPT) this.kept.delete(this.kept.keys().next().value);
    return coming;
  }

  prefetch(position) {
    for (const near of [position + 1, position - 1, position + 2]) {
      if (near >= 0 && near < this.run.frames.length) this.get(near);
    }
  }
}

async function load(run, position) {
  const query = new URLSearchParams({ run: run.name, position, made: run.created });
  const answer = await fetch(`/image?${query}`);
  if (!answer.ok) return null;
  return createImageBitmap(await answer.blob());
}
