// @ts-check
/* Tabs of a panel: a button with data-tab for each page with data-page. */

export class Tabs {
  /** `onShow` is called after a page is shown.
   *
   * @param {HTMLElement} panel
   * @param {() => void} onShow
   */
  constructor(panel, onShow) {
    /** @type {NodeListOf<HTMLElement>} */
    this.buttons = panel.querySelectorAll("[data-tab]");
    /** @type {NodeListOf<HTMLElement>} */
    this.pages = panel.querySelectorAll("[data-page]");
    this.onShow = onShow;
    this.shown = "";
    for (const button of this.buttons) button.addEventListener("click", () => this.show(button.dataset.tab ?? ""));
    this.select(this.names[0]);
  }

  get names() {
    return [...this.buttons].map((button) => button.dataset.tab ?? "");
  }

  /** @param {string} name */
  show(name) {
    if (!this.names.includes(name)) return;
    this.select(name);
    this.onShow();
  }

  next() {
    const { names } = this;
    this.show(names[(names.indexOf(this.shown) + 1) % names.length]);
  }

  /** @param {string} name */
  select(name) {
    this.shown = name;
    for (const button of this.buttons) button.setAttribute("aria-selected", String(button.dataset.tab === name));
    for (const page of this.pages) page.hidden = page.dataset.page !== name;
  }
}
