// @ts-check
// Keyboard focus: from panel to panel, and up and down in a list.

import { find } from "/static/dom.js";

const PANELS = ".topbar, .panel, .frames";
const INSIDE = "canvas.marks, .row.chosen, .tile.current, button, input, select";
/** @type {Record<string, number>} */
const STEPS = { ArrowDown: 1, ArrowRight: 1, ArrowUp: -1, ArrowLeft: -1 };

/** Moves the focus to the next visible panel that can have it.
 *
 * @param {number} by
 */
export function nextPanel(by) {
  const panels = [...document.querySelectorAll(PANELS)].filter((panel) => first(panel));
  const index = panels.findIndex((panel) => panel.contains(document.activeElement));
  first(panels[(index + by + panels.length + (index < 0 && by < 0 ? 1 : 0)) % panels.length])?.focus();
}

/** Moves the focus back to the images. Returns whether it was in a panel. */
export function backToImages() {
  if (!document.activeElement?.matches("button, input, select")) return false;
  focusImages();
  return true;
}

/** Moves the focus to the left image. */
export function focusImages() {
  find(document, "canvas.marks").focus({ preventScroll: true });
}

/** Lets arrow keys move the focus within a list, and Ctrl Enter act as Ctrl click. */
export function watchLists() {
  window.addEventListener("keydown", (event) => {
    const { target } = event;
    const list = target instanceof HTMLButtonElement && target.closest(".list, .strip");
    if (!list || event.defaultPrevented) return;
    if (event.key === "Enter" && event.ctrlKey) {
      event.preventDefault();
      target.dispatchEvent(new MouseEvent("click", { bubbles: true, ctrlKey: true }));
      return;
    }
    const by = STEPS[event.key];
    if (!by) return;
    event.preventDefault();
    const rows = [...list.querySelectorAll("button")].filter(isShown);
    rows[rows.indexOf(target) + by]?.focus();
  });
}

/** @param {Element} panel */
function first(panel) {
  const all = /** @type {HTMLElement[]} */ ([...panel.querySelectorAll(INSIDE)]);
  const enabled = all.filter((node) => isShown(node) && !("disabled" in node && node.disabled));
  return enabled.find((node) => node.matches(".chosen, .current, canvas.marks")) ?? enabled[0];
}

/** @param {Element} node */
const isShown = (node) => node.getClientRects().length > 0;
