"""Move a mark to what the image shows under it: a pole's axis, a sign's middle."""

from dataclasses import dataclass, replace

import numpy as np

from semviz_annotation.assist.ends import with_visible_ends
from semviz_annotation.assist.score import probability
from semviz_annotation.assist.shot import Mark, Shot, pixel
from semviz_core.arrays import FloatArray
from semviz_core.classes import ElementClass
from semviz_core.measuring.outline import find_outlines
from semviz_core.measuring.pole import find_axes, stripe, support
from semviz_core.measuring.profile import refine

REACH_PX = 4.0
"""How far a click can be off across a pole."""
CLEAR = 0.6
"""Below this probability a mark stays where it was clicked."""
_SHORTEST_PX = 8.0
_THIN_PX, _DIFFERS = 4.0, 0.35
"""A thinner line must differ from both sides in this share of its rows."""
_LARGEST_SHIFT = 0.75
"""Of a sign's half size: what is further away was not clicked."""


@dataclass(frozen=True)
class Snapped:
    """A mark after the image was asked."""

    mark: Mark
    moved_px: float
    """The furthest that an end moved."""
    anchor_snapped: bool
    """Whether the peak was found along the pole too; a sign's middle always is."""
    end_snapped: bool


@dataclass(frozen=True, eq=False)
class Snap:
    """What a mark could snap to, with what speaks for it."""

    snapped: Snapped
    evidence: FloatArray


def snap(
    shot: Shot, mark: Mark, element_class: ElementClass, reach_px: float = REACH_PX
) -> Snapped | None:
    """``mark`` on what the image shows there; None where nothing is clear.

    A pole's ends move across to its axis, by up to ``reach_px``, and known ends along it to where
    it visibly ends, where that is clear. A sign's middle is found from a click on its face; its
    class says its shape.
    """
    found = best_snap(shot, mark, element_class, reach_px)
    what = "snap pole" if mark.end_px is not None else "snap sign"
    if found is None or probability(what, found.evidence) < CLEAR:
        return None
    return found.snapped


def best_snap(
    shot: Shot, mark: Mark, element_class: ElementClass, reach_px: float = REACH_PX
) -> Snap | None:
    """As ``snap``, not judged yet."""
    if mark.end_px is not None:
        return _pole(shot, mark, reach_px)
    return _sign(shot, mark, element_class)


def _pole(shot: Shot, mark: Mark, reach_px: float) -> Snap | None:
    marked = mark.ends_px
    if np.linalg.norm(marked[1] - marked[0]) < _SHORTEST_PX:
        return None
    axes = find_axes(shot, marked, reach_px, 2)
    if not axes:
        return None
    axis = refine(shot, axes[0])
    moved = np.linalg.norm(axis.ends_px - marked, axis=1)
    if moved.max() > reach_px + 1.0:
        return None
    differs = stripe(shot, axis.ends_px, axis.width_px)
    if axis.width_px < _THIN_PX and differs < _DIFFERS:
        return None
    margin = axes[0].score - axes[1].score if len(axes) > 1 else 5.0
    drift = np.abs(axis.ends_px - axes[0].ends_px).max()
    evidence = np.array(
        [
            *support(shot, axis.ends_px, axis.width_px), differs, np.clip(margin, 0.0, 3.0),
            moved.max() / reach_px, drift, np.log(axis.width_px),
            np.log(np.linalg.norm(marked[1] - marked[0])),
        ]
    )  # fmt: skip
    across = replace(mark, anchor_px=pixel(axis.ends_px[0]), end_px=pixel(axis.ends_px[1]))
    found, peak, foot = with_visible_ends(shot, across, axis.width_px, reach_px)
    furthest = float(np.linalg.norm(found.ends_px - marked, axis=1).max())
    return Snap(Snapped(found, furthest, peak, foot), evidence)


def _sign(shot: Shot, mark: Mark, element_class: ElementClass) -> Snap | None:
    found = find_outlines(shot, mark.ends_px[0], element_class.shape)
    if not found:
        return None
    best = found[0]
    shift = best.middle_px - mark.ends_px[0]
    if np.abs(shift / best.half_px).max() > _LARGEST_SHIFT:
        return None
    others = [
        best.score - one.score
        for one in found[1:]
        if np.linalg.norm(one.middle_px - best.middle_px) > 1.0
    ]
    evidence = np.array(
        [*best.evidence[1:], best.score, min([5.0, *others]), np.abs(shift / best.half_px).max()]
    )
    moved = replace(mark, anchor_px=pixel(best.middle_px))
    return Snap(Snapped(moved, float(np.linalg.norm(shift)), True, False), evidence)
