"""Compare the labels of two people in one frame: what both saw, how far apart, and the mean.

Nothing depends on who is first: exchanged people get the same pairs and distances. Elements are
paired one to one, of one kind, within ``MATCH_PX``; as many as possible, then the nearest.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.rows import LabelElement, Observation, Pixel
from semviz_core.base.frame import Side
from semviz_core.common.arrays import FloatArray, unit_vectors

MATCH_PX = 20.0
"""Labels farther apart are of two elements."""
_NEVER = 1e6


class Distance(NamedTuple):
    """How far two labels of one element are apart."""

    px: float
    """Poles: between the lines, at the middle of what both show. Signs: between the middles."""
    angle_rad: float
    """Between the lines of poles; 0 for signs."""


@dataclass(frozen=True)
class ViewPair:
    """What two people labelled of one element in one image; one of them may have nothing."""

    side: Side
    first: Observation | None
    second: Observation | None

    @property
    def distance(self) -> Distance | None:
        """None if only one labelled it."""
        if self.first is None or self.second is None:
            return None
        return distance(self.first, self.second)

    @property
    def same_ends(self) -> bool:
        """Whether both say the same of which ends are hidden, if both labelled it."""
        first, second = self.first, self.second
        return first is None or second is None or _known(first) == _known(second)


@dataclass(frozen=True)
class ElementPair:
    """One element of a frame as two people labelled it; None for who did not."""

    first: LabelElement | None
    second: LabelElement | None
    views: tuple[ViewPair, ...]
    """By image, left first."""

    @property
    def worst_px(self) -> float:
        """The largest distance of the labels; 0 if no image has both."""
        return max((found.px for view in self.views if (found := view.distance)), default=0.0)

    @property
    def same_class(self) -> bool:
        first, second = self.first, self.second
        return first is None or second is None or first.class_id == second.class_id


def pairs_in(frame_index: int, first: Labels, second: Labels) -> list[ElementPair]:
    """Return the elements that either labelled in a frame, those of both first.

    Elements that are left out of maps do not count.
    """
    rows, others = _by_element(frame_index, first), _by_element(frame_index, second)
    ids, other_ids = list(rows), list(others)
    costs = np.array(
        [[_cost(rows[id_], others[other]) for other in other_ids] for id_ in ids], dtype=float
    ).reshape(len(ids), len(other_ids))
    paired = dict(_assigned(costs))
    pairs = [
        _pair(first.element(ids[row]), second.element(other_ids[column]), rows, others)
        for row, column in paired.items()
    ]
    alone = [first.element(id_) for row, id_ in enumerate(ids) if row not in paired]
    pairs += [_pair(element, None, rows, others) for element in alone]
    taken = set(paired.values())
    alone = [second.element(id_) for column, id_ in enumerate(other_ids) if column not in taken]
    return [*pairs, *(_pair(None, element, rows, others) for element in alone)]


def changed_in(frame_index: int, before: Labels, now: Labels) -> list[ElementPair]:
    """Return the elements of a frame that differ between two states of one log."""
    rows, others = _by_element(frame_index, before), _by_element(frame_index, now)
    return [
        _pair(
            before.element(id_) if id_ in rows else None,
            now.element(id_) if id_ in others else None,
            rows,
            others,
        )
        for id_ in dict.fromkeys([*rows, *others])
        if rows.get(id_) != others.get(id_) or before.element(id_) != now.element(id_)
    ]


_Rows = dict[str, dict[Side, Observation]]


def _by_element(frame_index: int, labels: Labels) -> _Rows:
    rows: _Rows = {}
    for row in labels.in_frame(frame_index):
        if not labels.is_left_out(row.element_id):
            rows.setdefault(row.element_id, {})[row.side] = row
    return rows


def _pair(
    first: LabelElement | None, second: LabelElement | None, rows: _Rows, others: _Rows
) -> ElementPair:
    mine = rows[first.id] if first else {}
    theirs = others[second.id] if second else {}
    sides: tuple[Side, ...] = ("left", "right")
    views = [ViewPair(side, mine.get(side), theirs.get(side)) for side in sides]
    return ElementPair(first, second, tuple(view for view in views if view.first or view.second))


def _cost(mine: dict[Side, Observation], theirs: dict[Side, Observation]) -> float:
    """The mean distance in the images that both labelled; ``_NEVER`` if they are not the same."""
    common = [side for side in mine if side in theirs]
    if not common or any(
        (mine[side].end_px is None) != (theirs[side].end_px is None) for side in common
    ):
        return _NEVER
    mean_px = float(np.mean([distance(mine[side], theirs[side]).px for side in common]))
    return mean_px if mean_px <= MATCH_PX else _NEVER


def _assigned(costs: FloatArray) -> list[tuple[int, int]]:
    from scipy.optimize import linear_sum_assignment

    pairs = zip(*linear_sum_assignment(costs), strict=True)
    return [(int(row), int(column)) for row, column in pairs if costs[row, column] < _NEVER]


def distance(first: Observation, second: Observation) -> Distance:
    """Return how far two labels of one kind are apart; poles that share no height: infinitely."""
    if first.end_px is None or second.end_px is None:
        return Distance(float(np.hypot(*np.subtract(first.anchor_px, second.anchor_px))), 0.0)
    along, ends, others = _axis(first, second)
    here, there = np.sort(ends @ along), np.sort(others @ along)
    low, high = max(here[0], there[0]), min(here[1], there[1])
    angle = _angle_rad(ends[1] - ends[0], others[1] - others[0])
    if low > high:
        return Distance(float("inf"), angle)
    middle = 0.5 * (low + high)
    gap = _at(ends, along, middle) - _at(others, along, middle)
    return Distance(float(np.hypot(*gap)), angle)


def mean_label(first: Observation, second: Observation) -> Observation:
    """Return the mean of two labels that agree on which ends are hidden, with the first's id.

    An end that both know is the mean of both. Hidden ends are points of the lines: the mean line's,
    half-way between.
    """
    if first.end_px is None or second.end_px is None:
        return replace(first, anchor_px=_mean(first.anchor_px, second.anchor_px))
    along, ends, others = _axis(first, second)
    points = []
    for row, known in enumerate((first.anchor_known, first.end_known)):
        end, other = ends[row], others[row]
        if not known:
            half_way = 0.5 * float((end + other) @ along)
            end, other = _at(ends, along, half_way), _at(others, along, half_way)
        points.append(_mean(end, other))
    return replace(first, anchor_px=points[0], end_px=points[1])


def _axis(first: Observation, second: Observation) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the mean direction (2,) of two poles, and their ends (2, 2), peaks first."""
    ends = np.array([first.anchor_px, first.end_px], dtype=float)
    others = np.array([second.anchor_px, second.end_px], dtype=float)
    along = unit_vectors(ends[1] - ends[0])
    across = unit_vectors(others[1] - others[0])
    mean = along + (across if along @ across >= 0.0 else -across)
    return unit_vectors(mean), ends, others


def _angle_rad(first: FloatArray, second: FloatArray) -> float:
    """The angle between two lines, at most a right one."""
    cross = abs(first[0] * second[1] - first[1] * second[0])
    return float(np.arctan2(cross, abs(first @ second)))


def _at(ends: FloatArray, along: FloatArray, coordinate: float) -> FloatArray:
    """Return the point (2,) of the line through ``ends`` at a coordinate along an axis."""
    step = ends[1] - ends[0]
    return np.asarray(ends[0] + step * (coordinate - ends[0] @ along) / (step @ along))


def _mean(first: Pixel | FloatArray, second: Pixel | FloatArray) -> Pixel:
    u, v = 0.5 * (np.asarray(first) + np.asarray(second))
    return float(u), float(v)


def _known(row: Observation) -> tuple[bool, bool]:
    return row.anchor_known, row.end_known


@dataclass(frozen=True)
class LabelAgreement:
    """The labels of two people in several frames."""

    frames: int
    pairs: tuple[ElementPair, ...]

    @property
    def both(self) -> tuple[ElementPair, ...]:
        """Elements that both labelled."""
        return tuple(pair for pair in self.pairs if pair.first and pair.second)

    @property
    def missed(self) -> tuple[int, int]:
        """How many elements of the other the first, and the second, did not label."""
        firsts = sum(pair.first is None for pair in self.pairs)
        return firsts, sum(pair.second is None for pair in self.pairs)

    @property
    def class_disagreements(self) -> int:
        return sum(not pair.same_class for pair in self.both)

    @property
    def views(self) -> tuple[ViewPair, ...]:
        """Labels of both in one image."""
        return tuple(view for pair in self.both for view in pair.views if view.distance)

    def distances(self, is_line: bool) -> FloatArray:
        """Return (n, 2) of poles or of signs: px, and radians between lines."""
        found = [
            view.distance
            for view in self.views
            if view.first and (view.first.end_px is not None) == is_line
        ]
        return np.array(found, dtype=float).reshape(-1, 2)


def agreement_in(frames: Sequence[int], first: Labels, second: Labels) -> LabelAgreement:
    """Return how two people labelled these frames."""
    pairs = (pair for frame in frames for pair in pairs_in(frame, first, second))
    return LabelAgreement(len(frames), tuple(pairs))
