/* Tabs of a panel: a button with data-tab for each of its pages with data-page. */

export class Tabs {
  /** `onshow` is called after another page is shown. */
  constructor(panel, onshow) {
    this.buttons = [...panel.querySelectorAll("[data-tab]")];
    this.pages = [...panel.querySelectorAll("[data-page]")];
    this.onshow = onshow;
    for (const button of this.buttons) button.addEventListener("click", () => this.show(button.dataset.tab));
    this.turn(this.names[0]);
  }

  get names() {
    return this.buttons.map((button) => button.dataset.tab);
  }

  show(name) {
    if (!this.names.includes(name)) return;
    this.turn(name);
    this.onshow();
  }

  next() {
    const { names } = this;
    this.show(names[(names.indexOf(this.shown) + 1) % names.length]);
  }

  turn(name) {
    this.shown = name;
    for (const button of this.buttons) button.setAttribute("aria-selected", button.dataset.tab === name);
    for (const page of this.pages) page.hidden = page.dataset.page !== name;
  }
}
