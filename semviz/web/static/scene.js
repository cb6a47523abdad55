/* The 3D pane: viser in an iframe, without its own panels, with the page's keys. */

const LOOK = `canvas { cursor: crosshair !important; }
  html { color-scheme: normal !important; }
  html, body, div:has(canvas) { background: none !important; }
  [data-floating-window], .mantine-Notifications-root,
  :has([data-dock-root]) ~ .mantine-Paper-root { display: none !important; }`; // the last: in narrow panes

const LONGEST_MS = 300; // so long pictures are held at most

/** Shows `session`'s scene in `frame` (an iframe) and hands `keys` its key presses. The frame gets
 * the class "ready" when viser's own panels are out of sight. Gives the pane's `Pictures`. */
export function showScene(frame, session, keys) {
  const pictures = new Pictures();
  frame.addEventListener("load", () => {
    const inside = frame.contentDocument;
    if (!inside) return; // the browser's own error page
    const style = inside.createElement("style");
    style.textContent = LOOK;
    inside.head.append(style);
    keys.listen(frame.contentWindow, true);
    quicken(frame.contentWindow, pictures);
    frame.classList.add("ready");
  }, { once: true });
  Object.assign(frame.style, { background: "var(--scene)", colorScheme: "normal" }); // of either theme
  frame.src = `view/${encodeURIComponent(session)}/`;
  return pictures;
}

/** When the pane draws. A picture holds the whole page up where the processor draws, and viser makes
 * one a second unasked. And a scene comes in two pieces, its cameras first. */
class Pictures {
  #awaited = new Set();
  #waiting = [];
  #timer = 0;

  /** None is drawn until `release` and, where `comes`, until another scene has come, too. */
  hold(comes) {
    this.#awaited.add("release");
    if (comes) this.#awaited.add("scene");
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#came("scene", "release"), LONGEST_MS);
  }

  release() {
    this.#came("release");
  }

  /** Looks at what viser draws and gets from now on. */
  watch(view) {
    const { messageQueue } = view.__viserMutable;
    if (!messageQueue) return; // another viser
    const request = view.requestAnimationFrame.bind(view);
    const draw = (callback) => request((time) => {
      if (this.#awaited.size) this.#waiting.push(() => draw(callback));
      else callback(time);
    });
    view.requestAnimationFrame = draw;
    messageQueue.push = (...messages) => {
      if (!messages.every(({ type }) => type.startsWith("SetCamera"))) this.#came("scene");
      return Array.prototype.push.apply(messageQueue, messages);
    };
  }

  #came(...what) {
    for (const one of what) this.#awaited.delete(one);
    if (!this.#awaited.size) for (const go of this.#waiting.splice(0)) go();
  }
}

/** Saves pictures that nobody needs, each of which takes long where the processor draws. */
function quicken(view, pictures) {
  // viser applies what arrives when it draws and shows it in the picture after that; at once, so
  // that the next picture has it, only where nobody looks
  Object.defineProperty(view.document, "hidden", { get: () => true });
  whenDrawn(view, 100, ({ backgroundMaterial }) => {
    backgroundMaterial.visible = false; // the ground is the page's; viser fills every picture with its own
    pictures.watch(view);
  });
}

/** Calls `act` with what viser shows to its own tests, as soon as it draws. */
function whenDrawn(view, tries, act) {
  if (view.__viserMutable?.backgroundMaterial) act(view.__viserMutable);
  else if (tries) setTimeout(() => whenDrawn(view, tries - 1, act), 100);
}
