// The whole page by keys: from panel to panel, and up and down in a list.

const PANELS = ".topbar, .panel, .frames";
const INSIDE = "canvas.marks, .row.chosen, .tile.current, button, input, select";
const STEPS = { ArrowDown: 1, ArrowRight: 1, ArrowUp: -1, ArrowLeft: -1 };

/** Puts the focus into the next panel in sight that has something to focus. */
export function nextPanel(by) {
  const panels = [...document.querySelectorAll(PANELS)].filter((panel) => first(panel));
  const place = panels.findIndex((panel) => panel.contains(document.activeElement));
  first(panels[(place + by + panels.length + (place < 0 && by < 0 ? 1 : 0)) % panels.length]).focus();
}

/** Puts the focus back to the images. Returns whether it was in a panel. */
export function backToImages() {
  if (!document.activeElement.matches("button, input, select")) return false;
  document.querySelector("canvas.marks").focus({ preventScroll: true });
  return true;
}

/** Arrows move the focus within a list; Ctrl Enter is the click with Ctrl. */
export function watchLists() {
  window.addEventListener("keydown", (event) => {
    const list = event.target.closest?.(".list, .strip");
    if (!list || !event.target.matches("button") || event.defaultPrevented) return;
    if (event.key === "Enter" && event.ctrlKey) {
      event.preventDefault();
      event.target.dispatchEvent(new MouseEvent("click", { bubbles: true, ctrlKey: true }));
      return;
    }
    const by = STEPS[event.key];
    if (!by) return;
    event.preventDefault();
    const rows = [...list.querySelectorAll("button")].filter(isShown);
    rows[rows.indexOf(event.target) + by]?.focus();
  });
}

function first(panel) {
  const inside = [...panel.querySelectorAll(INSIDE)].filter((one) => isShown(one) && !one.disabled);
  return inside.find((one) => one.matches(".chosen, .current")) ?? inside[0];
}

const isShown = (one) => one.getClientRects().length > 0;
