// @ts-check
/* Builds elements without markup, so that text from data never becomes HTML. */

/** @typedef {Node | string | number | null | undefined | false} Child */
/** @typedef {MouseEvent & {currentTarget: HTMLElement}} Click */
/** @typedef {{[name: string]: any, onclick?: (event: Click) => void, oninput?: (event: InputEvent) => void}} Properties */

/** Creates an element. `text` sets its text, `class` its class, `data` its data-* attributes, names
 * starting with "on" add listeners, anything else sets an attribute.
 *
 * @template {keyof HTMLElementTagNameMap} Tag
 * @param {Tag} tag
 * @param {Properties} [properties]
 * @param {...Child} children
 */
export function el(tag, properties = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === undefined || value === null) continue;
    if (name === "text") node.textContent = value;
    else if (name === "class") node.className = value;
    else if (name === "data") Object.assign(node.dataset, value);
    else if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else node.setAttribute(name, value);
  }
  append(node, children);
  return node;
}

/** Replaces the children of `node`.
 *
 * @param {Element} node
 * @param {Child[]} children
 */
export function fill(node, children) {
  node.replaceChildren();
  append(node, children);
}

/**
 * @param {Element} node
 * @param {Child[]} children
 */
function append(node, children) {
  for (const child of children) {
    if (child !== null && child !== undefined && child !== false) node.append(/** @type {Node | string} */ (child));
  }
}

/** Creates an SVG element; listeners are not supported.
 *
 * @template {keyof SVGElementTagNameMap} Tag
 * @param {Tag} tag
 * @param {{[name: string]: string | number}} [attributes]
 * @param {...Node} children
 */
export function svg(tag, attributes = {}, ...children) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, String(value));
  node.append(...children);
  return node;
}

/** The element with an id, of class `kind`. Throws if there is none.
 *
 * @template {HTMLElement} [Kind=HTMLElement]
 * @param {string} id
 * @param {new () => Kind} [kind]
 */
export function byId(id, kind) {
  return checked(document.getElementById(id), `#${id}`, kind);
}

/** The first match of a selector in `root`, of class `kind`. Throws if there is none.
 *
 * @template {HTMLElement} [Kind=HTMLElement]
 * @param {ParentNode} root
 * @param {string} selector
 * @param {new () => Kind} [kind]
 */
export function find(root, selector, kind) {
  return checked(root.querySelector(selector), selector, kind);
}

/**
 * @template {HTMLElement} Kind
 * @param {Element | null} node
 * @param {string} name
 * @param {new () => Kind} [kind]
 */
function checked(node, name, kind) {
  if (!node || (kind && !(node instanceof kind))) throw new Error(`the page has no ${kind?.name ?? "element"} ${name}`);
  return /** @type {Kind} */ (node);
}

/** A number with fixed decimals; an em dash for null.
 *
 * @param {number | null | undefined} value
 * @param {number} decimals
 */
export function fixed(value, decimals) {
  return value === null || value === undefined ? "—" : value.toFixed(decimals);
}

/** A text whose element names, for example P-29, do not break across lines.
 *
 * @param {string} text
 */
export function unbroken(text) {
  return text.split(/([A-Z]-\d+)/).map((part, place) => (place % 2 ? el("span", { class: "unbroken", text: part }) : part));
}
