"""Where the frames of a pass should see the elements of a map, and where they do."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from semviz_annotation.mapping.passes.existence import PassCounts
from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.frame import Frame
from semviz_core.base.localization import Localization
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.diagnosis.reference import FrameReference

_SCALE_RANGE = (0.3, 1.5)


@dataclass(frozen=True, eq=False)
class Pass:
    """One drive through the map, localized in it."""

    name: str
    frames: tuple[Frame, ...]
    localizations: tuple[Localization, ...]
    """One for each frame."""
    detector: DetectorModel

    @cached_property
    def sure(self) -> list[tuple[Frame, Localization]]:
        """The frames whose estimated pose is sure; no true pose is used."""
        return [
            (frame, result)
            for frame, result in zip(self.frames, self.localizations, strict=True)
            if result.status == "ok" and result.T_camera_map is not None
        ]


def counts_of(passes: Sequence[Pass], semantic_map: SemanticMap) -> PassCounts:
    """Return what the passes saw of the elements of the map (n).

    Detections that are expected follow from each detector's rates, scaled to how often the pass
    detects the elements that it sees at all.
    """
    n, p = len(semantic_map), len(passes)
    row_of = {int(id_): row for row, id_ in enumerate(semantic_map.elements.id)}
    chances, seen = np.zeros((n, p), np.int64), np.zeros((n, p), np.int64)
    expected = np.zeros((n, p))
    for column, one in enumerate(passes):
        for _, result in one.sure:
            case = FrameReference.of(result, semantic_map, None, one.detector)
            rows = np.array([row_of[int(id_)] for id_ in case.nearby.id], np.int64)
            detected = np.zeros(len(rows), np.bool_)
            detected[case.same_class[:, 1]] = True
            shown = case.in_view | detected
            chances[rows, column] += shown
            seen[rows, column] += detected
            expected[rows, column] += np.where(shown, _recall(case, one.detector), 0.0)
        met = seen[:, column] > 0
        if met.any():
            scale = seen[met, column].sum() / expected[met, column].sum()
            expected[:, column] *= np.clip(scale, *_SCALE_RANGE)
    return PassCounts(chances, expected, seen)


def unexplained(result: Localization, semantic_map: SemanticMap, model: DetectorModel) -> IntArray:
    """Return the rows of the detections of a sure frame that no element of the map explains."""
    case = FrameReference.of(result, semantic_map, None, model)
    return np.setdiff1d(np.arange(len(result.observed)), case.same_class[:, 0])


def _recall(case: FrameReference, model: DetectorModel) -> FloatArray:
    """Return the recall (n,) of the nearby elements at their distances."""
    assert case.reference is not None
    away_m = np.linalg.norm(case.reference.apply(case.nearby.anchor_m), axis=1)
    recall = (model.recall_near, model.recall_far)
    return np.asarray(np.interp(away_m, (model.near_m, model.far_m), recall))
