"""What was clicked in a 3D scene: whatever lies nearest to the ray under the pointer.

viser tells the ray of every click. Finding what it meets here costs the browser nothing, however
many things there are: 100,000 take some 4 ms.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from semviz_core.arrays import FloatArray, IntArray

if TYPE_CHECKING:
    import viser

REACH = 0.025
"""A click may miss by this share of the pane's height: 10 px of 400."""
STEPS = 4
"""Of what lies within the same quarter of the reach, the nearest to the eye is meant."""
BEFORE_EYE_M = 0.1

Clicked = Callable[[str, int], None]


@dataclass(frozen=True, eq=False)
class Offer:
    """Things of one kind that can be clicked: segments, or points where both ends are equal."""

    number: IntArray
    """(n,) what a click on each tells."""
    low_m: FloatArray
    """(n, 3)"""
    high_m: FloatArray
    """(n, 3)"""

    @cached_property
    def balls(self) -> tuple[FloatArray, FloatArray]:
        """Middle (n, 3) and radius (n,) of a ball around each thing."""
        half_m = (self.high_m - self.low_m) / 2
        return self.low_m + half_m, np.linalg.norm(half_m, axis=1)

    def near(self, origin_m: FloatArray, direction: FloatArray, reach_rad: float) -> IntArray:
        """Rows of all that may lie within ``reach_rad`` of a ray of unit ``direction``."""
        middle_m, radius_m = self.balls
        away_m = middle_m - origin_m
        depth_m = away_m @ direction
        apart_m2 = np.einsum("ni,ni->n", away_m, away_m) - depth_m**2
        within_m = radius_m + reach_rad * np.maximum(depth_m + radius_m, BEFORE_EYE_M)
        return np.flatnonzero((apart_m2 <= within_m**2) & (depth_m + radius_m > BEFORE_EYE_M))

    def __getitem__(self, rows: IntArray) -> "Offer":
        return Offer(self.number[rows], self.low_m[rows], self.high_m[rows])


class Picker:
    """Tells kind and number of what was clicked of the things on offer, in a thread of viser's."""

    def __init__(self, server: "viser.ViserServer", on_click: Clicked) -> None:
        self._offers: dict[str, Offer] = {}
        self._on_click = on_click
        server.scene.on_click()(self._clicked)

    def offer(self, kind: str, offer: Offer) -> None:
        """Takes the place of what was on offer of that kind."""
        self._offers = {**self._offers, kind: offer}

    def _clicked(self, event: "viser.SceneClickEvent") -> None:
        origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
        reach_rad = REACH * event.client.camera.fov
        found = pick(self._offers, origin, direction, reach_rad)
        if found is not None:
            self._on_click(*found)


def pick(
    offers: dict[str, Offer], origin_m: FloatArray, direction: FloatArray, reach_rad: float
) -> tuple[str, int] | None:
    """Kind and number of what lies within ``reach_rad`` of a ray; None where nothing does."""
    best: tuple[tuple[int, float], str, int] | None = None
    ahead = direction / np.linalg.norm(direction)
    for kind, all_of_kind in offers.items():
        offer = all_of_kind[all_of_kind.near(origin_m, ahead, reach_rad)]
        apart_m, depth_m = apart(offer, origin_m, ahead)
        angle = apart_m / np.maximum(depth_m, BEFORE_EYE_M)
        rows = np.flatnonzero((angle <= reach_rad) & (depth_m > BEFORE_EYE_M))
        if not len(rows):
            continue
        step = np.floor(STEPS * angle[rows] / reach_rad).astype(np.int64)
        first = int(np.lexsort((depth_m[rows], step))[0])
        row = int(rows[first])
        rank = (int(step[first]), float(depth_m[row]))
        if best is None or rank < best[0]:
            best = rank, kind, int(offer.number[row])
    return None if best is None else best[1:]


def apart(
    offer: Offer, origin_m: FloatArray, direction: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Distance (n,) of each thing from a line of unit ``direction``, and how far along that is.

    The closest points of a line and a segment (Ericson, Real-Time Collision Detection, 5.1.9).
    """
    along, start = offer.high_m - offer.low_m, offer.low_m - origin_m
    squared, on_ray = np.einsum("ni,ni->n", along, along), along @ direction
    start_on_ray, start_along = start @ direction, np.einsum("ni,ni->n", start, along)
    spread = squared - on_ray**2  # 0 where the segment is a point, or parallel to the line
    share = (on_ray * start_on_ray - start_along) / np.where(spread > 1e-12, spread, np.inf)
    share = np.clip(share, 0.0, 1.0)
    depth = start_on_ray + share * on_ray
    gap = start + share[:, None] * along - depth[:, None] * direction
    return np.linalg.norm(gap, axis=1), depth
