"""A followed mark moves to an outline only where edges and fits tell the same place."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from semviz_annotation.assist.element_search import outlined
from semviz_annotation.assist.image_search import PropagatedMark
from semviz_annotation.assist.marked_image import Mark
from semviz_core.subpixel.joint_outlines import JointOutline, OutlineView

VIEWS = [OutlineView(cast(Any, None), cast(Any, None), np.zeros(2), 1.0, 1.2)] * 3


def outline(rows_px: float, edges: float, fit: float) -> JointOutline:
    """An outline that all images have so many rows below the mark."""
    moves = np.tile([0.0, rows_px], (3, 1))
    return JointOutline(moves, np.array([9.0, 8.0]), edges, np.full(3, fit))


def moved(*outlines: JointOutline) -> float | None:
    """By how many rows the mark moves; None if no outline is clear."""
    followed = PropagatedMark(Mark((50.0, 40.0)), "followed sign", np.zeros(7))
    camera = SimpleNamespace(width=100, height=80)
    image = cast(Any, SimpleNamespace(view=SimpleNamespace(camera=camera)))
    found = outlined(followed, 0, VIEWS, outlines, image)
    return None if found is None else found.mark.anchor_px[1] - 40.0


def test_the_clearest_outline_is_taken() -> None:
    assert moved(outline(2.0, 1.2, 0.5), outline(-3.0, 1.0, -5.0)) == 2.0


def test_one_that_fits_better_elsewhere_takes_it_back() -> None:
    assert moved(outline(-4.0, 1.2, -5.5), outline(0.0, 1.0, 0.5)) is None


def test_one_that_fits_better_around_the_same_middle_does_not() -> None:
    """The border of a sign has an outline of its own."""
    assert moved(outline(-1.0, 1.2, -2.0), outline(0.0, 1.0, 0.5)) == -1.0
