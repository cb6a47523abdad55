"""Proposals and marks as the page gets them: plain JSON values."""

from collections.abc import Iterable, Mapping

import numpy as np

from semviz.annotator.hand import Drawing
from semviz.annotator.offers import Offer, inside
from semviz.annotator.panes import Pane
from semviz.annotator.views import Json, element_json
from semviz_annotation.assist.shot import Mark
from semviz_annotation.labels import Labels
from semviz_annotation.view import camera_of
from semviz_core.camera import Rig
from semviz_core.classes import ClassSet
from semviz_core.sources.source import Side


def offers_json(
    offers: Iterable[Offer],
    panes: Mapping[Side, Pane],
    labels: Labels,
    rig: Rig,
    classes: ClassSet,
) -> list[Json]:
    """Proposals by element with their marks in each image: first what needs a look, then by depth.

    ``score`` is null before the images were looked at; ``sure`` where all marks are.
    """
    shown_as = {pane: side for side, pane in panes.items()}
    found: dict[str, Json] = {}
    for one in offers:
        mark = None if one.mark is None else inside(one.mark, camera_of(rig, one.pane.side)[0])
        if mark is None or one.pane not in shown_as:
            continue
        entry = found.setdefault(one.element_id, _offered_json(one, labels, classes))
        entry[shown_as[one.pane]] = _offer_json(one, mark)
        entry["sure"] = one.sure and entry.get("sure", True)
    for entry in found.values():
        scores = [entry[side]["score"] for side in shown_as.values() if side in entry]
        entry["score"] = None if None in scores else min(scores)
    return sorted(found.values(), key=lambda one: (one["sure"], one["depth_m"] or 0.0))


def _offered_json(offer: Offer, labels: Labels, classes: ClassSet) -> Json:
    """What is offered, without its marks."""
    depth_m = offer.depth_m if np.isfinite(offer.depth_m or np.inf) else None
    entry: Json = {"id": offer.element_id, "origin": offer.origin, "depth_m": depth_m}
    entry["refused"] = offer.refused
    if not offer.is_detected:
        return element_json(labels.element(offer.element_id), classes) | entry
    return entry | {"name": f"new {classes[offer.class_id].name}", "class": offer.class_id}


def _offer_json(offer: Offer, mark: Mark) -> Json:
    runner_up = offer.runner_up
    return mark_json(mark) | {
        "id": offer.id,
        "frame": offer.pane.frame_index,
        "side": offer.pane.side,
        "score": offer.score,
        "runner_up": None
        if runner_up is None
        else mark_json(runner_up.mark) | {"score": runner_up.score},
    }


def mark_json(mark: Mark) -> Json:
    """A mark as the page keeps it."""
    return {
        "anchor": mark.anchor_px,
        "end": mark.end_px,
        "anchor_known": mark.anchor_known,
        "end_known": mark.end_known,
    }


def snapped_json(before: Drawing, after: Drawing) -> Json:
    """Where a drawing will be, and by how many pixels its ends move at most."""
    moves = [np.subtract(after.anchor_px, before.anchor_px)]
    if before.end_px is not None and after.end_px is not None:
        moves.append(np.subtract(after.end_px, before.end_px))
    return mark_json(after.mark) | {"by_px": max(float(np.hypot(*move)) for move in moves)}
