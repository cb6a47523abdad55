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

export function startTheme() {
  const system = matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark";
  apply(localStorage.getItem(STORED) ?? system);
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
