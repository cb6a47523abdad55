/* The 3D pane: viser in an iframe, without its own panels, with the page's keys. */

const LOOK = `canvas { cursor: crosshair !important; }
  html { color-scheme: normal !important; }
  html, body, div:has(canvas) { background: none !important; }
  [data-floating-window], .mantine-Notifications-root,
  :has([data-dock-root]) ~ .mantine-Paper-root { display: none !important; }`; // the last: in narrow panes

/** Shows `session`'s scene in `frame` (an iframe) and hands `keys` its key presses. The frame gets
 * the class "ready" when viser's own panels are out of sight. */
export function showScene(frame, session, keys) {
  frame.addEventListener("load", () => {
    const inside = frame.contentDocument;
    if (!inside) return; // the browser's own error page
    const style = inside.createElement("style");
    style.textContent = LOOK;
    inside.head.append(style);
    keys.listen(frame.contentWindow, true);
    quicken(frame.contentWindow);
    frame.classList.add("ready");
  }, { once: true });
  Object.assign(frame.style, { background: "var(--scene)", colorScheme: "normal" }); // of either theme
  frame.src = `view/${encodeURIComponent(session)}/`;
}

/** Saves pictures that nobody needs, each of which takes long where the processor draws. */
function quicken(view) {
  // viser applies what arrives when it draws and shows it in the picture after that; at once, so
  // that the next picture has it, only where nobody looks
  Object.defineProperty(view.document, "hidden", { get: () => true });
  hideBackground(view, 100);
}

/** The ground is the page's; viser fills every picture with one of its own, even without a colour. */
function hideBackground(view, tries) {
  const background = view.__viserMutable?.backgroundMaterial;
  if (background) background.visible = false;
  else if (tries) setTimeout(() => hideBackground(view, tries - 1), 100);
}
