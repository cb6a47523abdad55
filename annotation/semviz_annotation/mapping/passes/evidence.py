"""Where the frames of a pass should see the elements of a map, and where they do."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from semviz_annotation.mapping.passes.existence import PassCounts
from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.frame import Frame
from semviz_core.base.localization import Localization
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.diagnosis.reference import FrameReference
from semviz_core.localization.association import all_gains

_SCALE_RANGE = (0.3, 1.5)
UNCLEAR_NATS = 3.0
"""A detection says nothing of two elements that explain it up to this log-likelihood ratio."""


@dataclass(frozen=True, eq=False)
class Pass:
    """One drive through the map, localized in it."""

    name: str
    frames: tuple[Frame, ...]
    localizations: tuple[Localization, ...]
    """One for each frame."""
    detector: DetectorModel
    start_s: float | None = None
    """When it began, seconds since 1970; None: not known."""

    @cached_property
    def sure(self) -> list[int]:
        """The positions of frames whose estimated pose is sure; no true pose is used."""
        return [
            position
            for position, result in enumerate(self.localizations)
            if result.status == "ok" and result.T_camera_map is not None
        ]


class Evidence(NamedTuple):
    """What p passes saw of n elements, and where."""

    counts: PassCounts
    nearest_seen: IntArray
    """(n, p) position of the nearest frame of the pass that detects it; -1: none does."""
    nearest_missed: IntArray
    """(n, p) position of the nearest frame that has it in view without detecting it; or -1."""


def evidence_of(passes: Sequence[Pass], semantic_map: SemanticMap, candidates: int = 0) -> Evidence:
    """Return what the passes saw of the elements of the map (n), of which the last are candidates.

    A detection that an element and a candidate explain about equally well tells of neither: from
    far away, an element that moved along the view looks as if it still stood.

    Detections that are expected follow from each detector's rates, scaled to how often the pass
    detects the elements that it sees at all.
    """
    n, p = len(semantic_map), len(passes)
    row_of = {int(id_): row for row, id_ in enumerate(semantic_map.elements.id)}
    chances, seen = np.zeros((n, p), np.int64), np.zeros((n, p), np.int64)
    expected = np.zeros((n, p))
    nearest = _Nearest((n, p)), _Nearest((n, p))
    for column, one in enumerate(passes):
        for position in one.sure:
            case = FrameReference.of(one.localizations[position], semantic_map, None, one.detector)
            rows = np.array([row_of[int(id_)] for id_ in case.nearby.id], np.int64)
            detected = np.zeros(len(rows), np.bool_)
            detected[case.same_class[:, 1]] = True
            clear = ~_unclear(case, rows >= n - candidates)
            detected &= clear
            shown, away_m = (case.in_view & clear) | detected, _away_m(case)
            chances[rows, column] += shown
            seen[rows, column] += detected
            expected[rows, column] += np.where(shown, one.detector.recall_at(away_m), 0.0)
            for kept, of in zip(nearest, (detected, shown & ~detected), strict=True):
                kept.add(rows[of], column, away_m[of], position)
        met = seen[:, column] > 0
        if met.any():
            scale = seen[met, column].sum() / expected[met, column].sum()
            expected[:, column] *= np.clip(scale, *_SCALE_RANGE)
    return Evidence(PassCounts(chances, expected, seen), *(kept.position for kept in nearest))


class _Nearest:
    """The nearest frames of elements in passes."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self._away_m = np.full(shape, np.inf)
        self.position = np.full(shape, -1)

    def add(self, rows: IntArray, column: int, away_m: FloatArray, position: int) -> None:
        """Add a frame of the pass ``column`` that is ``away_m`` (k,) from the elements ``rows``."""
        nearer = away_m < self._away_m[rows, column]
        self._away_m[rows[nearer], column] = away_m[nearer]
        self.position[rows[nearer], column] = position


def unexplained(result: Localization, semantic_map: SemanticMap, model: DetectorModel) -> IntArray:
    """Return the rows of the detections of a sure frame that no element of the map explains."""
    case = FrameReference.of(result, semantic_map, None, model)
    return np.setdiff1d(np.arange(len(result.observed)), case.same_class[:, 0])


def _unclear(case: FrameReference, is_candidate: BoolArray) -> BoolArray:
    """Return which nearby elements (n,) share a detection with one of the other kind."""
    unclear = np.zeros(len(is_candidate), np.bool_)
    if not is_candidate.any():
        return unclear
    assert case.reference is not None
    gain = all_gains(case.problem, *case.reference.writable())
    free = np.ones(len(is_candidate), np.bool_)
    free[case.same_class[:, 1]] = False
    for i, j in case.same_class:
        other = free & (is_candidate != is_candidate[j]) & np.isfinite(gain[i])
        rivals = other & (gain[i] > gain[i, j] - UNCLEAR_NATS)
        unclear |= rivals
        unclear[j] |= rivals.any()
    return unclear


def _away_m(case: FrameReference) -> FloatArray:
    """Return the distances (n,) of the nearby elements."""
    assert case.reference is not None
    return np.asarray(np.linalg.norm(case.reference.apply(case.nearby.anchor_m), axis=1))
