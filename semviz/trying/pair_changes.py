"""Changes of who is who: pairs that must be, and pairs that cannot."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from semviz.trying.asked import Asked
from semviz.trying.change import Change, Stage, element_name
from semviz.trying.seen_changes import is_there
from semviz_core.arrays import IntArray
from semviz_core.errors import SemvizError
from semviz_core.explaining.faults import SURELY_OFF
from semviz_core.semantic_map import SemanticMap
from semviz_core.solving.pairing import Pairing
from semviz_core.solving.residuals import INLIER_CHI2, scene_residuals
from semviz_core.solving.scene import Scene


@dataclass(frozen=True)
class ForcePair(Change):
    """One detection of a frame is one element of the map."""

    stage: ClassVar[Stage] = Stage.PAIRS
    frame: int
    observed: int
    element: int

    def words(self, semantic_map: SemanticMap) -> str:
        return f"with detection #{self.observed} as {element_name(semantic_map, self.element)}"

    def concerns(self, asked: Asked) -> bool:
        return is_there(asked, self.frame, self.observed)

    def applied(self, asked: Asked) -> Asked:
        return replace(asked, forced=(*asked.forced, (self.observed, self.element)))


@dataclass(frozen=True)
class ForbidPair(Change):
    """One detection of a frame is not one element of the map."""

    stage: ClassVar[Stage] = Stage.PAIRS
    frame: int
    observed: int
    element: int

    def words(self, semantic_map: SemanticMap) -> str:
        name = element_name(semantic_map, self.element)
        return f"with detection #{self.observed} not as {name}"

    def concerns(self, asked: Asked) -> bool:
        return is_there(asked, self.frame, self.observed)

    def applied(self, asked: Asked) -> Asked:
        return replace(asked, forbidden=(*asked.forbidden, (self.observed, self.element)))


@dataclass(frozen=True)
class ForceTruePairs(Change):
    """Every detection is the element that it is known to be, if it fits it at the true pose."""

    stage: ClassVar[Stage] = Stage.PAIRS

    def words(self, semantic_map: SemanticMap) -> str:
        return "with the true pairs"

    def concerns(self, asked: Asked) -> bool:
        return len(_true_pairs(asked)) > 0

    def applied(self, asked: Asked) -> Asked:
        i, j = _true_pairs(asked).T
        taken = {row for row, _ in asked.forced}
        rows, ids = asked.row[i].tolist(), asked.submap.id[j].tolist()
        true = [pair for pair in zip(rows, ids, strict=True) if pair[0] not in taken]
        return replace(asked, forced=(*asked.forced, *true))


def pairing_of(asked: Asked) -> Pairing:
    """The pairs by rows. SemvizError where one names what is not in the question."""
    return Pairing(_rows(asked, asked.forced), _rows(asked, asked.forbidden))


def _rows(asked: Asked, pairs: tuple[tuple[int, int], ...]) -> IntArray:
    seen = {row: i for i, row in enumerate(asked.row.tolist())}
    mapped = {element: j for j, element in enumerate(asked.submap.id.tolist())}
    for row, element in pairs:
        if row not in seen or element not in mapped:
            name = element_name(asked.semantic_map, element)
            raise SemvizError(
                f"detection #{row} or {name} is left out or not in the submap: no pair to decide on"
            )
    rows = [(seen[row], mapped[element]) for row, element in pairs]
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


def _true_pairs(asked: Asked) -> IntArray:
    """(k, 2) rows (observed, submap) of known ids that fit at the true pose."""
    if asked.truth is None:
        return np.empty((0, 2), dtype=np.int64)
    pairs = np.argwhere(asked.element_id[:, None] == asked.submap.id)
    pairs = pairs[asked.observed.is_line[pairs[:, 0]] == asked.submap.is_line[pairs[:, 1]]]
    camera, detector = asked.record.localization.camera, asked.localizer.detector
    scene = Scene.of(camera, asked.observed, asked.submap, detector)
    found = scene_residuals(scene, asked.truth.inverse(), pairs)
    return np.asarray(pairs[found.chi2 <= SURELY_OFF * INLIER_CHI2[found.rows]])
