"""Several triangulations of one thing into one, each weighted by its covariance."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semviz_annotation.labels import LabelElement, Observation
from semviz_annotation.mapping.motion import covariance_m2, outermost
from semviz_annotation.triangulate import Triangulated
from semviz_annotation.view import View
from semviz_core.arrays import BoolArray, FloatArray

_UNSEEN_SIGMA_M = 100.0
"""Added along a pole to an end that a sighting did not show: it does not say where that is."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """One label element from one stereo pair, or from all its views together; in the map frame."""

    element: LabelElement
    views: tuple[View, ...]
    observations: tuple[Observation, ...]
    result: Triangulated

    @property
    def by_motion(self) -> bool:
        """Whether it took more than one frame to see where it is."""
        return len({row.frame_index for row in self.observations}) > 1


@dataclass(frozen=True, eq=False)
class Thing:
    """One or more label elements taken for one thing, in the map frame; as ``Elements3D``."""

    sightings: tuple[Sighting, ...]
    anchor_m: FloatArray
    end_m: FloatArray
    covariance_m2: FloatArray
    anchor_known: bool
    end_known: bool

    @property
    def elements(self) -> tuple[LabelElement, ...]:
        """The label elements in it, by number."""
        return tuple(
            sorted({one.element for one in self.sightings}, key=lambda element: element.number)
        )

    @property
    def observations(self) -> tuple[Observation, ...]:
        """All that it was triangulated from."""
        return tuple(row for one in self.sightings for row in one.observations)


def fuse(sightings: Sequence[Sighting], sigma_px: float) -> Thing:
    """The weighted mean of ``sightings`` of one thing (one or more, all poles or all signs).

    Done twice: a far view that by chance came out too near claims too much certainty, so
    the second time all covariances are taken at the first mean.
    """
    results = [one.result for one in sightings]
    size = 6 if results[0].is_line else 3
    values = np.array([np.concatenate([one.anchor_m, one.end_m])[:size] for one in results])
    anchor_known = np.array([one.anchor_known for one in results])
    end_known = np.array([one.end_known for one in results])
    covariances = np.array([one.covariance_m2[:size, :size] for one in results])
    for _ in range(2):
        unseen = _unseen(values, anchor_known, end_known) if size == 6 else 0.0
        information = np.linalg.inv(covariances + unseen)
        covariance = np.linalg.inv(information.sum(axis=0))
        mean = covariance @ (information @ values[:, :, None]).sum(axis=0)[:, 0]
        anchor, end = mean[:3], mean[3:] if size == 6 else np.full(3, np.nan)
        covariances = np.array(
            [
                covariance_m2(one.views, one.observations, anchor, end, sigma_px)[:size, :size]
                for one in sightings
            ]
        )
    if size == 6:
        anchor, end = _stretched(anchor, end, values, anchor_known, end_known)
    full = np.zeros((6, 6))
    full[:size, :size] = covariance
    return Thing(
        sightings=tuple(sightings),
        anchor_m=anchor,
        end_m=end,
        covariance_m2=full,
        anchor_known=bool(anchor_known.any()),
        end_known=bool(end_known.any()),
    )


def _unseen(values: FloatArray, anchor_known: BoolArray, end_known: BoolArray) -> FloatArray:
    """(k, 6, 6) m2 to add to the covariances, so that only views that show an end place it."""
    direction = values[:, 3:] - values[:, :3]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    along = _UNSEEN_SIGMA_M**2 * direction[:, :, None] * direction[:, None, :]
    added = np.zeros((len(values), 6, 6))
    for known, block in ((anchor_known, slice(0, 3)), (end_known, slice(3, 6))):
        if known.any():
            added[~known, block, block] = along[~known]
    return added


def _stretched(
    anchor: FloatArray,
    end: FloatArray,
    values: FloatArray,
    anchor_known: BoolArray,
    end_known: BoolArray,
) -> tuple[FloatArray, FloatArray]:
    """An end that nobody saw is put at the furthest point of the line that anybody saw."""
    direction = (end - anchor) / np.linalg.norm(end - anchor)
    first, last = anchor, end
    if not anchor_known.any():
        places = (values[:, :3] - anchor) @ direction
        first = anchor + outermost(places, anchor_known, "first") * direction
    if not end_known.any():
        places = (values[:, 3:] - anchor) @ direction
        last = anchor + outermost(places, end_known, "last") * direction
    return first, last
