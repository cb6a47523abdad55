// @ts-check
/* Dark or light theme: the system's, until the user chooses. */

const STORED = "semviz-theme";

/** @typedef {"dark" | "light"} Theme */

/** @returns {Theme} */
export function currentTheme() {
  return document.documentElement.dataset.theme === "light" ? "light" : "dark";
}

/** @param {string} theme */
function apply(theme) {
  document.documentElement.dataset.theme = theme;
}

/** Applies the theme; until the user chooses one, it follows the system's.
 *
 * @param {() => void} onChange called when the system's theme changed the page's
 */
export function startTheme(onChange = () => {}) {
  const system = matchMedia("(prefers-color-scheme: light)");
  const follow = () => apply(localStorage.getItem(STORED) ?? (system.matches ? "light" : "dark"));
  follow();
  system.addEventListener("change", () => {
    const before = currentTheme();
    follow();
    if (currentTheme() !== before) onChange();
  });
}

/** Switches the theme, stores it and returns it. */
export function switchTheme() {
  const theme = currentTheme() === "dark" ? "light" : "dark";
  apply(theme);
  localStorage.setItem(STORED, theme);
  return theme;
}

/** Runs `draw` in another theme; the page does not change visibly.
 *
 * @param {Theme} theme
 * @param {() => void} draw
 */
export function inTheme(theme, draw) {
  const shown = currentTheme();
  apply(theme);
  try {
    draw();
  } finally {
    apply(shown);
  }
}
