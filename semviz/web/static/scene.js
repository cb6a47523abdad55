/* The 3D pane: viser in an iframe, without its own panels, with the page's keys. */

const LOOK = `canvas { cursor: crosshair !important; }
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
    frame.classList.add("ready");
  }, { once: true });
  frame.src = `view/${encodeURIComponent(session)}/`;
}
