/* Dark or light: as the system says, until the user chooses. */

const STORED = "semviz-theme";

export function currentTheme() {
  return document.documentElement.dataset.theme ?? "dark";
}

function apply(theme) {
  document.documentElement.dataset.theme = theme;
}

export function startTheme() {
  const system = matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark";
  apply(localStorage.getItem(STORED) ?? system);
}

/** Switches, remembers, and returns the new theme. */
export function switchTheme() {
  const theme = currentTheme() === "dark" ? "light" : "dark";
  apply(theme);
  localStorage.setItem(STORED, theme);
  return theme;
}

/** Runs `draw` as if the page had another theme; nothing of it is shown. */
export function inTheme(theme, draw) {
  const shown = currentTheme();
  apply(theme);
  try {
    draw();
  } finally {
    apply(shown);
  }
}
