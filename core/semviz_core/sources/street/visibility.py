"""Which elements of a street an image truly shows, and how much of each."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.classes import POLE
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.sources.street.brushes import fill_mask
from semviz_core.sources.street.furniture import silhouette, standing_in_order
from semviz_core.sources.street.layout import Layout
from semviz_core.sources.street.things import Car
from semviz_core.sources.street.view import View

NEAREST_M, FARTHEST_M = 3.0, 60.0
_SHORTEST_PX = 8.0
"""Less of a pole than this is not labelled."""
LABEL_SIGMA_PX = 0.5
"""What a careful person's click is off by; the labels themselves are exact."""


class _Seen(NamedTuple):
    id: int
    class_id: int
    anchor_px: FloatArray
    end_px: FloatArray
    anchor_known: bool
    end_known: bool


class Painted(NamedTuple):
    """The order in which things were painted."""

    order: NDArray[np.int32]
    """(height, width) number of what was painted last."""
    ranks: dict[int, int]
    """Each element's number, by its id."""


def visible_elements(
    painted: Painted, truth: Elements3D, view: View
) -> tuple[Elements2D, IntArray]:
    """What ``view`` shows of the elements (n,), and the ids (m,) of those it shows.

    An element's point is visible where nothing later was painted over it.
    """
    order, ranks = painted
    distance = np.linalg.norm((truth.anchor_m - view.center_m)[:, :2], axis=1)
    in_range = (distance > NEAREST_M) & (distance < FARTHEST_M)
    seen: list[_Seen] = []
    for row in np.flatnonzero(in_range):
        rank = ranks.get(int(truth.id[row]))
        if rank is None:
            continue
        one = truth[[row]]
        see = _see_pole if one.is_line[0] else _see_sign
        found = see(one, view, order, rank)
        if found is not None:
            seen.append(found)
    return _elements(seen)


def paint_ranks(layout: Layout, view: View) -> Painted:
    """In which order what ``view`` shows is painted."""
    order = np.zeros((view.camera.height, view.camera.width), np.int32)
    ranks: dict[int, int] = {}
    for rank, thing in enumerate(standing_in_order(layout, view), start=1):
        for polygon in silhouette(thing, view, layout.sun):
            fill_mask(order, polygon, rank)
        if not isinstance(thing, Car):
            ranks[thing.id] = rank
    return Painted(order, ranks)


def _see_pole(pole: Elements3D, view: View, order: NDArray[np.int32], rank: int) -> _Seen | None:
    """From the first to the last visible point of a pole's axis."""
    peak, bottom = view.project(np.concatenate([pole.anchor_m, pole.end_m]))
    count = int(np.ceil(np.linalg.norm(bottom - peak) * 2)) + 2
    points = peak + np.linspace(0.0, 1.0, count)[:, None] * (bottom - peak)
    visible = np.flatnonzero(_uncovered(points, view, order, rank))
    if not len(visible):
        return None
    first, last = visible[0], visible[-1]
    if np.linalg.norm(points[last] - points[first]) < _SHORTEST_PX:
        return None
    return _Seen(int(pole.id[0]), POLE, points[first], points[last], first == 0, last == count - 1)


def _see_sign(sign: Elements3D, view: View, order: NDArray[np.int32], rank: int) -> _Seen | None:
    """A sign whose middle is in sight."""
    middle = view.project(sign.anchor_m)[0]
    if not _uncovered(middle[None], view, order, rank)[0]:
        return None
    return _Seen(int(sign.id[0]), int(sign.class_id[0]), middle, np.full(2, np.nan), True, False)


def _uncovered(points_px: FloatArray, view: View, order: NDArray[np.int32], rank: int) -> BoolArray:
    """(n,) whether points (n, 2) lie in the image with nothing painted over them."""
    inside = view.camera.contains(points_px)
    pixels = np.round(points_px[inside]).astype(int)
    visible = np.zeros(len(points_px), dtype=bool)
    visible[inside] = order[pixels[:, 1], pixels[:, 0]] <= rank
    return visible


def _elements(seen: list[_Seen]) -> tuple[Elements2D, IntArray]:
    m = len(seen)
    elements = Elements2D(
        anchor_px=np.array([one.anchor_px for one in seen]).reshape(m, 2),
        end_px=np.array([one.end_px for one in seen]).reshape(m, 2),
        class_id=np.array([one.class_id for one in seen], dtype=np.int64),
        score=np.ones(m),
        sigma_px=np.full((m, 2), LABEL_SIGMA_PX),
        anchor_known=np.array([one.anchor_known for one in seen], dtype=bool),
        end_known=np.array([one.end_known for one in seen], dtype=bool),
    )
    return elements, np.array([one.id for one in seen], dtype=np.int64)
