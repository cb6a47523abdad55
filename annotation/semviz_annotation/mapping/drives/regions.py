"""Merge the maps of many drives in regions, each with a border that it shares with its neighbours.

Drives that are far apart tell nothing about each other: what a landmark says about the errors of
poses fades along the ways over ``CORRELATION_M``. So each square of the ground is merged by itself,
with all that lies around it, and what comes out within the square counts. Time and memory for a
drive do not grow with the city, and a drive more changes nothing but the regions that it passes.

Drives are cut at knots: an element belongs where its drive's nearest knot is. A landmark that
crosses the edge of a square is decided by the square of its first element, if both squares take the
same elements for it; otherwise each decides about its own.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np

from semviz_annotation.mapping.drives.alignment import Alignment
from semviz_annotation.mapping.drives.corrections import Knots
from semviz_annotation.mapping.drives.merge import (
    DEFAULT_OPTIONS,
    ROUNDS,
    MergeOptions,
    Merging,
    Stack,
    merge_stack,
    numbered,
)
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.progress import OnProgress, unwatched

REGION_M = 2000.0
"""Side of the square of a region; their corners lie at multiples of it in the frame of the map."""
BORDER_M = 300.0
"""Width of what is merged around it."""


@dataclass(frozen=True, eq=False)
class MapRegion:
    """A square of the ground, and its border."""

    knots: IntArray
    """Rows of the knots in both, ascending."""
    elements: IntArray
    """Rows of the elements of these knots, ascending."""
    own_knot: BoolArray
    """Which knots are in the square."""
    own_element: BoolArray


def merge_elements(
    maps: Sequence[SemanticMap],
    options: MergeOptions = DEFAULT_OPTIONS,
    on_progress: OnProgress = unwatched,
) -> Merging:
    """Return which elements of ``maps``, all of one frame, are one landmark, and where it is.

    Maps that fit into one region with its border, or of which one has no way and so moves as a
    whole, are merged at once.
    """
    stack, knots = Stack.of(maps), Knots.along(maps)
    regions = _regions(maps, stack, knots)
    rounds, done = len(regions) * len(ROUNDS), count(1)

    def on_round() -> None:
        on_progress("aligning drives", next(done), rounds)

    on_progress("aligning drives", 0, rounds)
    parts = [
        merge_stack(stack.where(one.elements), knots.where(one.knots), options, on_round)
        for one in regions
    ]
    return _joined(stack, knots, regions, parts)


def _regions(maps: Sequence[SemanticMap], stack: Stack, knots: Knots) -> list[MapRegion]:
    at_m = knots.position_m[:, :2]
    square = np.floor(at_m / REGION_M)
    fits = np.ptp(at_m, axis=0).max() <= REGION_M + 2.0 * BORDER_M
    if fits or not all(len(one.trajectory_m) for one in maps):
        square[:] = 0.0
    return list(regions_of(at_m, square, knots.nearest(stack.ends_m[:, :3], stack.drive)))


def regions_of(at_m: FloatArray, square: FloatArray, knot_of: IntArray) -> Iterator[MapRegion]:
    """Yield the region of each square (k, 2) of knots at places (k, 2), where elements belong to
    the knots ``knot_of`` (n,)."""
    from scipy.spatial import cKDTree

    squares, home = np.unique(square, axis=0, return_inverse=True)
    home, trees = home.ravel(), (cKDTree(at_m), cKDTree(at_m[knot_of]))
    reach_m = REGION_M / 2.0 + BORDER_M if len(squares) > 1 else np.inf
    for number, center_m in enumerate((squares + 0.5) * REGION_M):
        rows, elements = (
            np.array(sorted(tree.query_ball_point(center_m, reach_m, p=np.inf)), np.int64)
            for tree in trees
        )
        yield MapRegion(rows, elements, home[rows] == number, home[knot_of[elements]] == number)


def _joined(
    stack: Stack, knots: Knots, regions: Sequence[MapRegion], parts: Sequence[Merging]
) -> Merging:
    """Return what the regions found in their squares as one."""
    lead = _leads(len(stack.drive), regions, parts)
    n, size = len(stack.drive), 6
    correction = np.zeros((len(knots), 4))
    ends_m, landmark_m = np.zeros((n, size)), np.zeros((n, size))
    covariance_m2, scatter_m = np.zeros((n, size, size)), np.zeros(n)
    for number, (region, part) in enumerate(zip(regions, parts, strict=True)):
        found, own = part.alignment, region.elements[region.own_element]
        correction[region.knots[region.own_knot]] = found.correction[region.own_knot]
        ends_m[own] = found.ends_m[region.own_element]
        scatter_m[own] = part.scatter_m[region.own_element]
        decided = lead[region.elements, 0] == number
        rows, of = region.elements[decided], part.landmark[decided]
        landmark_m[rows], covariance_m2[rows] = found.landmark_m[of], found.covariance_m2[of]
    landmark = numbered(lead[:, 0] * n + lead[:, 1])
    _, first = np.unique(landmark, return_index=True)
    alignment = Alignment(correction, ends_m, landmark_m[first], covariance_m2[first])
    return Merging(stack, knots, landmark, alignment, scatter_m)


def _leads(n: int, regions: Sequence[MapRegion], parts: Sequence[Merging]) -> IntArray:
    """Return (n, 2) for each element the region that decides about it, and the first element of the
    landmark that it takes it for. The landmarks of one region are those of its own elements, and of
    others whose own region agrees."""
    home, lead = np.zeros(n, np.int64), np.zeros(n, np.int64)
    first = [_first_elements(region, part) for region, part in zip(regions, parts, strict=True)]
    for number, (region, lead_here) in enumerate(zip(regions, first, strict=True)):
        own = region.own_element
        home[region.elements[own]] = number
        lead[region.elements[own]] = lead_here[own]
    decides = home.copy()
    for number, (region, lead_here) in enumerate(zip(regions, first, strict=True)):
        agreed = (home[lead_here] == number) & (lead[region.elements] == lead_here)
        decides[region.elements[agreed]] = number
    return np.stack([decides, lead], axis=1)


def _first_elements(region: MapRegion, part: Merging) -> IntArray:
    """Return the first element of the landmark of each of a region's elements."""
    _, first = np.unique(part.landmark, return_index=True)
    return region.elements[first][part.landmark]
