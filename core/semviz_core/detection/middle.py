"""Where a sign's middle could be, and its shape: as the model sees it, and by its outline."""

from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.classes import DEFAULT_CLASSES, RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.detection.region import Region
from semviz_core.detection.sigma import SHAPE, sigma_px
from semviz_core.measuring.outline import Outline, fit_outlines
from semviz_core.measuring.picture import Picture

SHAPES = (TRIANGULAR, RECTANGULAR, ROUNDED)
"""Told apart where the model does not."""
STRAY_PX, STRAY_SHARE = 2.6, 0.02
"""An outline whose middle is further from the model's than this and this share of the sign's size
is another one: its border's inner edge, or the sign's picture."""
_FILLED = {TRIANGULAR: 0.5, RECTANGULAR: 1.0, ROUNDED: np.pi / 4.0}
"""Share of its box that each covers."""


@dataclass(frozen=True, eq=False)
class Middle:
    """A candidate for a sign's middle."""

    kind: str
    """What it was made of; ``sigma`` knows how good each kind is."""
    middle_px: FloatArray
    """(2,)"""
    half_px: FloatArray
    """(2,) half its width and height."""
    evidence: FloatArray
    """(k,) of its kind."""

    @property
    def sigma_px(self) -> float:
        """Of one coordinate."""
        return sigma_px(self.kind, self.evidence)


def best_middle(picture: Picture, region: Region) -> tuple[int, Middle]:
    """A sign's class and the middle with the least sigma."""
    first = first_middle(region)
    if region.class_id is not None and region.class_id not in DEFAULT_CLASSES:
        return region.class_id, first  # nobody told its shape
    classes = SHAPES if region.class_id is None else (region.class_id,)
    found = {one: middles_by_outline(picture, first, one) for one in classes}
    told = [shape_evidence(region, one, found[one] or [first]) @ SHAPE for one in classes]
    class_id = classes[int(np.argmax(told))]
    return class_id, min([first, *found[class_id]], key=lambda one: one.sigma_px)


def first_middle(region: Region) -> Middle:
    """What the model says: the middle of its box, or of what its mask covers."""
    found = [_between("middle by box", region.box_px[:2], region.box_px[2:], 0.0)]
    if region.mask is not None and region.mask.any():
        rows = np.flatnonzero(region.mask.any(axis=1))
        columns = np.flatnonzero(region.mask.any(axis=0))
        low = region.corner_px + np.array([columns[0], rows[0]], dtype=np.float64)
        high = region.corner_px + np.array([columns[-1], rows[-1]], dtype=np.float64)
        found.append(_between("middle by mask", low, high, 1.0 - _filled(region)))
    return min(found, key=lambda one: one.sigma_px)


def _between(kind: str, low_px: FloatArray, high_px: FloatArray, bare: float) -> Middle:
    """In the middle of two corners; ``bare`` is the share of it that no mask covers."""
    half = np.asarray((high_px - low_px + 1.0) / 2.0)
    evidence = np.array([np.log(half.mean()), abs(np.log(half[0] / half[1])), bare])
    return Middle(kind, np.asarray((low_px + high_px) / 2.0), half, evidence)


def middles_by_outline(picture: Picture, first: Middle, class_id: int) -> list[Middle]:
    """Middles of outlines of a class's shape, near and about as large as what the model says."""
    shape = DEFAULT_CLASSES[class_id].shape
    fitted = fit_outlines(picture, first.middle_px, first.half_px, shape)
    stray = STRAY_PX + STRAY_SHARE * 2.0 * first.half_px.mean()
    found = [one for one in fitted if np.linalg.norm(one.middle_px - first.middle_px) <= stray]
    return [_by_outline(one, first, found) for one in found]


def _by_outline(one: Outline, first: Middle, all_found: list[Outline]) -> Middle:
    grown = np.abs(np.log(one.half_px / first.half_px))
    moved = np.abs(one.middle_px - first.middle_px).max() / first.sigma_px
    others = [
        one.score - other.score
        for other in all_found
        if np.linalg.norm(other.middle_px - one.middle_px) > 1.0
    ]
    evidence = np.array(
        [
            *one.evidence[1:], min([5.0, *others]), grown.mean(), grown.max(),
            np.log(moved + 0.5), np.log(first.sigma_px),
        ]
    )  # fmt: skip
    return Middle("middle by outline", one.middle_px, one.half_px, evidence)


def shape_evidence(region: Region, class_id: int, middles: list[Middle]) -> FloatArray:
    """(k,) of a sign being of a class: the class, how well its outline fits, the mask's filling."""
    best = min(middles, key=lambda one: one.sigma_px)
    off = 0.0
    if region.mask is not None and region.mask.any():
        off = abs(_filled(region) - _FILLED.get(class_id, np.pi / 4.0))
    which = np.array([class_id == one for one in SHAPES], dtype=np.float64)
    return np.array([*which, np.log(best.sigma_px), best.evidence[0], best.evidence[1], off])


def class_by_mask(region: Region) -> int:
    """The shape that covers about as much of its box; rectangular without a mask."""
    if region.mask is None or not region.mask.any():
        return RECTANGULAR
    filled = _filled(region)
    return min(SHAPES, key=lambda one: abs(filled - _FILLED[one]))


def _filled(region: Region) -> float:
    """Share that a mask covers of its extent."""
    assert region.mask is not None
    rows, columns = region.mask.any(axis=1), region.mask.any(axis=0)
    return float(region.mask[rows][:, columns].mean())
