"""Move a mark to what the image shows under it: a pole's axis, a sign's middle."""

from dataclasses import dataclass, replace

import numpy as np

from semviz_annotation.assist.pole import find_axes, refine
from semviz_annotation.assist.shot import Mark, Shot, pixel
from semviz_core.classes import ElementClass

REACH_PX = 4.0
"""How far a click can be off across a pole."""


@dataclass(frozen=True)
class Snapped:
    """A mark after the image was asked."""

    mark: Mark
    moved_px: float
    """The furthest that an end moved."""
    anchor_snapped: bool
    """Whether the peak was found along the pole too; a sign's middle always is."""
    end_snapped: bool


def snap(
    shot: Shot, mark: Mark, element_class: ElementClass, reach_px: float = REACH_PX
) -> Snapped | None:
    """``mark`` on what the image shows there; None where nothing is clear.

    A pole's ends move across to its axis, by up to ``reach_px``, and known ends along it to where it
    visibly ends, where that is clear. A sign's middle is found from a click on its face.
    """
    if mark.end_px is None:
        return None
    axes = find_axes(shot, mark.ends_px, reach_px)
    if not axes:
        return None
    ends = refine(shot, axes[0]).ends_px
    moved = float(np.linalg.norm(ends - mark.ends_px, axis=1).max())
    if moved > reach_px + 1.0:
        return None
    found = replace(mark, anchor_px=pixel(ends[0]), end_px=pixel(ends[1]))
    return Snapped(found, moved, False, False)
