"""Which element a new drawing belongs to: the selected one, an expected one, or none yet."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from semviz.annotator.fit import misfit_px
from semviz.annotator.offers import Offer
from semviz.annotator.places import Places
from semviz_annotation.assist.shot import Mark
from semviz_annotation.labels import Labels, Observation
from semviz_core.classes import ClassSet

CONSISTENT_PX = 3.0
"""Largest reprojection error (rms over the views) for a drawing to join the selected element."""
NEAR_EXPECTED_PX = 12.0
"""Largest distance of a drawing's ends from those expected of an element for it to join it."""
NEAR_SURE_PX = 3.0
"""The same where the element was found in the image and is sure: what is beside it is another."""


@dataclass(frozen=True)
class Partner:
    """The element to which a drawing is added; None starts a new one. ``note`` tells people."""

    element_id: str | None
    note: str = ""


def partner_of(
    drawing: Observation,
    class_id: int,
    selected_id: str | None,
    offers: Iterable[Offer],
    labels: Labels,
    places: Places,
    classes: ClassSet,
) -> Partner:
    """The selected element if it is free in this image and the rays agree; else one expected here.

    ``offers`` are those for the image of the drawing.
    """
    note = ""
    if selected_id is not None and _is_free(selected_id, drawing, class_id, labels):
        misfit = _misfit_px([*labels.of_element(selected_id), drawing], places)
        if misfit <= CONSISTENT_PX:
            return Partner(selected_id)
        element = labels.element(selected_id)
        name = classes.element_name(element.class_id, element.number)
        note = f"{_off(misfit)} {name}, so this is a new element. Ctrl click both and P to link."
    near = [
        (_distance_px(one.mark, drawing), one.element_id)
        for one in offers
        if one.mark is not None and not one.is_detected and one.class_id == class_id
        if _distance_px(one.mark, drawing) <= (NEAR_SURE_PX if one.sure else NEAR_EXPECTED_PX)
    ]
    return Partner(min(near)[1]) if near else Partner(None, note)


def _misfit_px(observations: Sequence[Observation], places: Places) -> float:
    """Of a drawing (the last one) with what else there is of its element; infinite for nothing."""
    drawing = observations[-1]
    if not places.posed([drawing]):
        observations = [one for one in observations if one.frame_index == drawing.frame_index]
    else:
        observations = places.posed(observations)
    if len(observations) < 2:
        return float("inf")
    return misfit_px([places.view(one) for one in observations], observations)


def _is_free(element_id: str, drawing: Observation, class_id: int, labels: Labels) -> bool:
    element = labels.elements.get(element_id)
    return (
        element is not None
        and element.class_id == class_id
        and labels.find(element_id, drawing.frame_index, drawing.side) is None
    )


def _distance_px(expected: Mark, drawing: Observation) -> float:
    """Between signs' middles. Poles: across the expected line, and along it at the better end.

    Either end of a pole may be hidden in one of the frames, so one end that agrees is enough.
    """
    gaps = [np.subtract(drawing.anchor_px, expected.anchor_px)]
    if expected.end_px is None or drawing.end_px is None:
        return float(np.hypot(*gaps[0]))
    gaps.append(np.subtract(drawing.end_px, expected.end_px))
    u, v = np.subtract(expected.end_px, expected.anchor_px)
    along = np.array([u, v]) / max(np.hypot(u, v), 1e-9)
    across = np.array([-along[1], along[0]])
    return float(max(*(abs(gap @ across) for gap in gaps), min(abs(gap @ along) for gap in gaps)))


def _off(misfit: float) -> str:
    return f"{misfit:.1f} px off" if np.isfinite(misfit) else "Does not fit"
