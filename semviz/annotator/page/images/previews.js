// @ts-check
// Guides and numbers of what is drawn or selected, from the server; offline those that it gave before.
/** @import {annotator} from "/static/protocol" */
/** @import {Page} from "../main.js" */
/** @import {State} from "../state.js" */
import { Refusal } from "/static/socket.js";
import { draftOf } from "../saving/pending.js";

export class Previews {
  /**
   * @param {State} state
   * @param {Pick<Page, "socket" | "notify">} page
   */
  constructor(state, page) {
    this.state = state;
    this.page = page;
    this.isBusy = false;
    this.isAgain = false; // the draft has changed since it was sent
    /** @type {Map<string, annotator.DraftPreview>} */
    this.known = new Map(); // of selected elements, by draft, since the labels changed last
  }

  /** Requests the preview of the draft; one request at a time, the latest state wins. */
  async ask() {
    if (this.state.past) return; // guides and numbers belong to the present state
    this.isAgain = this.isBusy;
    if (this.isBusy) return;
    this.isBusy = true;
    do {
      this.isAgain = false;
      await this.#askOnce();
    } while (this.isAgain);
    this.isBusy = false;
  }

  /** After the labels changed: numbers from before are of other labels. */
  forget() {
    this.known.clear();
  }

  async #askOnce() {
    const draft = draftOf(this.state);
    const about = JSON.stringify({ ...draft, is_chosen: false });
    const previewed = { frame: this.state.frame, subject: this.state.subject };
    try {
      const { preview } = await this.page.socket.request("preview_draft", { draft });
      if (!draft.drawing && !this.state.dragged) this.known.set(about, preview);
      this.#show(this.state.past ? null : preview, previewed);
    } catch (refusal) {
      if (!(refusal instanceof Refusal)) throw refusal;
      if (refusal.code === "offline") this.#show(this.known.get(about) ?? null, previewed);
      else this.page.notify(refusal.message, "wrong");
    }
  }

  /** Shows a preview, unless the page has gone on or shows it already: each change draws the page anew.
   *
   * @param {annotator.DraftPreview | null} preview
   * @param {{frame: number | null, subject: string}} previewed
   */
  #show(preview, previewed) {
    const { state } = this;
    if (previewed.frame !== state.frame || previewed.subject !== state.subject) return;
    if (JSON.stringify([preview, previewed]) === JSON.stringify([state.preview, state.previewed])) return;
    state.set({ preview, previewed });
  }
}
