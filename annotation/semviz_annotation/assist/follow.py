"""Find a mapped element in another frame: expected from its place, refined in the image."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from semviz_annotation.assist.shot import Mark, Proposed, Shot, pixel
from semviz_annotation.assist.snap import snap
from semviz_annotation.triangulate import Triangulated
from semviz_annotation.view import View
from semviz_core.classes import ElementClass

SIGMA_PX = 1.5
"""What slightly wrong poses add to an expected place."""


def expected_mark(element: Triangulated, view: View) -> Mark | None:
    """A mapped element's projection; None where it is out of the image."""
    points = (
        np.stack([element.anchor_m, element.end_m]) if element.is_line else element.anchor_m[None]
    )
    pixels = view.project(points)
    if not np.isfinite(pixels).all() or not view.camera.contains(pixels).any():
        return None
    inside = view.camera.contains(pixels)
    if not element.is_line:
        return Mark(pixel(pixels[0]), None, True, False)
    return Mark(
        pixel(pixels[0]),
        pixel(pixels[1]),
        element.anchor_known and bool(inside[0]),
        element.end_known and bool(inside[1]),
    )


def follow(
    seen: Sequence[tuple[Shot, Mark]],
    element: Triangulated,
    there: Shot,
    element_class: ElementClass,
    sigma_px: float = SIGMA_PX,
) -> Proposed | None:
    """A mapped element in an image in which it is not labelled yet; None where it is out of it.

    ``seen`` are images in which it is labelled, the nearest first; ``element`` and all views share
    the map frame. What is hidden there, or cannot be told, comes with a low score.
    """
    expected = expected_mark(element, there.view)
    if expected is None:
        return None
    snapped = snap(there, expected, element_class, 3.0 * sigma_px)
    if snapped is None:
        return Proposed(expected, 0.3)
    return Proposed(replace(snapped.mark), 0.7)
