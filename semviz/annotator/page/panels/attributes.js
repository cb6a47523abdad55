// @ts-check
// What is known of the selected element besides its class: a line below its card, with a form.
/** @import {annotator} from "/static/protocol" */
/** @import {Child} from "/static/dom.js" */
/** @import {Page} from "../main.js" */
/** @import {State} from "../state.js" */
/** @import {ShownElement} from "../values.js" */
import { byId, el } from "/static/dom.js";
import { RenderCache } from "./widgets.js";

export class Attributes {
  /**
   * @param {State} state
   * @param {Page} page
   */
  constructor(state, page) {
    this.state = state;
    this.page = page;
    this.cache = new RenderCache(state);
    /** The attribute whose value is being written, of an element; null while none is.
     * @type {{element: string, name: string} | null} */
    this.open = null;
  }

  show() {
    const { selectedElement: element, drawing, workspace } = this.state;
    const shown = element && !drawing && !element.unsaved ? element : null;
    if (this.open?.element !== shown?.id) this.open = null;
    byId("attributes").hidden = !shown;
    if (!shown) return;
    this.cache.show("attributes", [shown.id, shown.attributes, this.open, workspace.attribute_types], () => this.#line(shown));
  }

  /**
   * @param {ShownElement} element
   * @returns {Child[]}
   */
  #line(element) {
    if (this.open) return [this.#form(element, this.open.name)];
    const chips = Object.entries(element.attributes ?? {}).map(([name, value]) =>
      el("button", { class: "chip", title: `Change ${name}`, onclick: () => this.#write(element, name) }, el("span", { class: "dim", text: `${name} ` }), value));
    return [...chips, el("button", { class: "small", title: "Sign code, material, lamp or any other", onclick: () => this.#write(element, "") }, chips.length ? "+" : "Attribute …")];
  }

  /** Opens the form for an attribute, or for one whose name is still to be chosen.
   *
   * @param {ShownElement} element
   * @param {string} name
   */
  #write({ id }, name) {
    this.open = { element: id, name };
    this.show();
    const fields = byId("attributes").querySelectorAll("input, select");
    const field = fields[name ? 1 : 0];
    if (field instanceof HTMLElement) field.focus();
  }

  #close() {
    this.open = null;
    this.show();
  }

  /**
   * @param {ShownElement} element
   * @param {string} name
   */
  #form(element, name) {
    const types = this.state.workspace.attribute_types;
    const names = el("datalist", { id: "attribute-names" }, ...types.map((type) => el("option", { value: type.name })));
    const what = el("input", { class: "small-field", "aria-label": "Attribute", placeholder: "attribute", list: "attribute-names", maxlength: 40, value: name,
      onchange: () => this.#write(element, what.value.trim()) });
    const value = this.#field(types.find((type) => type.name === name), element.attributes?.[name] ?? "");
    const set = (/** @type {string | null} */ text) => {
      const { id: element_id } = element, named = what.value.trim();
      if (named && (text === null || text.trim())) this.page.submit({ kind: "set attribute", element_id, name: named, value: text });
      this.#close();
    };
    const hasValue = name in (element.attributes ?? {});
    return el("form", {
      onsubmit: (/** @type {Event} */ event) => { event.preventDefault(); set(value.value); },
      onkeydown: (/** @type {KeyboardEvent} */ event) => { if (event.key === "Escape") { event.stopPropagation(); this.#close(); } },
    }, what, names, value, el("button", { class: "small", type: "submit" }, "Set"),
      hasValue ? el("button", { class: "small", type: "button", title: `Remove ${name}`, onclick: () => set(null) }, "✕") : null);
  }

  /** The field of a value, by its type.
   *
   * @param {annotator.AttributeType | undefined} type
   * @param {string} value
   */
  #field(type, value) {
    const choices = type?.type === "flag" ? ["yes", "no"] : type?.type === "choice" ? type.choices : null;
    if (!choices) return el("input", { class: "small-field", "aria-label": "Value", placeholder: type?.type ?? "text", inputmode: type?.type === "number" ? "decimal" : "text", maxlength: 200, value });
    return el("select", { class: "small-field", "aria-label": "Value" }, ...choices.map((choice) => el("option", { value: choice, selected: choice === value ? "" : undefined }, choice)));
  }
}
