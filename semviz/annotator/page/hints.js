// What each key does right now: the line under the images.

/** [{keys, text}] for the state of the page, most useful first; the first six must suffice. */
export function hints(state) {
  const { drawing, selectedElement: element, selectedGhost: ghost, selected } = state;
  if (drawing) return whileDrawing(state.classOf(drawing.class).kind, state.look?.snapped);
  const kind = state.classOf(state.classId).kind;
  const draw = kind === "line" ? hint("peak, then bottom", "Click") : hint("middle, or drag a box", "Click");
  if (state.review && !selected) return whileAsked(state.review);
  if (selected?.also) return [hint("link the two", "P"), hint("clear", "Esc")];
  const offer = state.currentOffer;
  if (offer && (!element || element.id === offer.id)) return withOffer(state, offer);
  if (element) return withElement(state, element, selected);
  if (ghost) return [hint(`${ghost.name} here`, "Click"), hint("not this one", "Esc")];
  return [
    draw, hint("class", ...state.hello.classes.slice(0, 9).map((_, place) => `${place + 1}`)), hint("zoom", "Wheel"), hint("pan", "Right drag"),
    hint("frame", ",", "."), hint("reviewed", "Enter"), hint("all keys", "?"),
  ];
}

function whileAsked({ answers }) {
  const said = answers.slice(0, 2).map(({ title }, place) => hint(title.toLowerCase(), ["Y", "Shift Y"][place]));
  return [...said, hint("zoom to it", "Z"), hint("the next", "Shift ."), hint("the one before", "Shift ,"), hint("close", "Esc")];
}

function withOffer(state, offer) {
  const sure = state.sureOffers.length;
  const other = offer.left?.runner_up || offer.right?.runner_up;
  return [
    hint(`accept ${offer.name}`, "Space"),
    ...(sure > 1 ? [hint(`accept ${sure} sure ones`, "Shift Space"), hint("and on", "Ctrl Enter")] : []),
    hint("reject", "X"), hint("next", "Tab"), ...(other ? [hint("runner-up", "K")] : []),
    hint("gone", "N"), hint("hidden", "O"), hint("draw it", "Click"),
  ];
}

function whileDrawing(kind, snapped) {
  if (kind === "point") return [hint("sets the middle", "Release"), hint("cancel", "Esc")];
  return [
    hint("bottom", "Click"), hint("cancel", "Esc"), hint(snapped?.end_known === false ? "bottom not hidden" : "bottom hidden", "O"), hint("peak cut", "C"),
    hint("zoom", "Wheel"), hint("pan", "Right drag"),
  ];
}

function withElement(state, element, { side }) {
  const here = element.observations[side];
  const isLine = state.classOf(element.class).kind === "line";
  const sure = state.sureOffers.length;
  const missing = state.hasRight && ["left", "right"].find((one) => !element.observations[one]);
  return [
    ...(sure ? [hint(`accept ${sure} sure`, "Shift Space")] : []),
    ...(missing ? [hint(`${element.name} in the ${missing} image`, "Click")] : []),
    ...(here ? [hint("0.1 px", "Arrows"), hint("delete", "Del")] : []),
    ...(here && isLine ? [hint("bottom hidden", "O"), hint("peak cut", "C"), hint("swap", "R")] : []),
    hint("draw on top", "Shift Click"), hint("zoom to it", "Z"), hint("frame", ",", "."),
  ];
}

const hint = (text, ...keys) => ({ keys, text });
