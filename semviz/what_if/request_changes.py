"""Changes to map, detections, forced and forbidden pairs, and method.

A pole cannot become a sign. True pairs are forced only if they fit at the true pose.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from semviz.what_if.change import FrameRequest, Stage, WhatIfChange, map_element_name
from semviz_core.base.classes import ClassSet
from semviz_core.base.elements import SIGMA_PX_RANGE, Elements, Elements3D, joined
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.diagnosis.checks import SURELY_OFF
from semviz_core.localization.association import PairConstraints
from semviz_core.localization.matched import METHODS, MatchedMethodName
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.residuals import INLIER_CHI2, problem_residuals

MATCHED: dict[str, MatchedMethodName] = {name: name for name in METHODS}


@dataclass(frozen=True)
class UseMethod(WhatIfChange):
    """Use another method of ``Localizer``; or ``minimal`` or ``p3p`` on the recorded matches."""

    stage: ClassVar[Stage] = Stage.SOLVER
    method: str

    def describe(self, semantic_map: SemanticMap) -> str:
        matched = " on the recorded matches" if self.method in MATCHED else ""
        return f"with method {self.method}{matched}"

    def affects(self, request: FrameRequest) -> bool:
        return request.method != self.method

    def applied(self, request: FrameRequest) -> FrameRequest:
        if self.method in MATCHED:
            return replace(request, matched=MATCHED[self.method])
        localizer = replace(request.localizer, method=self.method, weights=None)
        return replace(request, localizer=localizer, matched=None)


@dataclass(frozen=True)
class StartAtTruth(WhatIfChange):
    """Refine from the true pose, without a search."""

    stage: ClassVar[Stage] = Stage.SOLVER

    def describe(self, semantic_map: SemanticMap) -> str:
        return "from the true pose"

    def affects(self, request: FrameRequest) -> bool:
        return request.truth is not None

    def applied(self, request: FrameRequest) -> FrameRequest:
        assert request.truth is not None
        return replace(request, start=request.truth.inverse())


MAX_OUTSIDE_M = 50.0
"""An element farther outside the crop than this is not visible."""


@dataclass(frozen=True)
class DropElement(WhatIfChange):
    """Remove an element from the map."""

    stage: ClassVar[Stage] = Stage.MAP
    element: int

    def describe(self, semantic_map: SemanticMap) -> str:
        return f"without {map_element_name(semantic_map, self.element)}"

    def affects(self, request: FrameRequest) -> bool:
        return bool((request.submap.id == self.element).any())

    def applied(self, request: FrameRequest) -> FrameRequest:
        return replace(request, submap=self.applied_to_map(request.submap))

    def applied_to_map(self, elements: Elements3D) -> Elements3D:
        return elements[elements.id != self.element]


@dataclass(frozen=True)
class ChangeElementClass(WhatIfChange):
    """Give a map element another class."""

    stage: ClassVar[Stage] = Stage.MAP
    element: int
    class_id: int

    def describe(self, semantic_map: SemanticMap) -> str:
        name = semantic_map.classes[self.class_id].name
        return f"with {map_element_name(semantic_map, self.element)} as {name}"

    def affects(self, request: FrameRequest) -> bool:
        rows = request.submap.id == self.element
        return bool((request.submap.class_id[rows] != self.class_id).any())

    def applied(self, request: FrameRequest) -> FrameRequest:
        check_same_kind(
            request,
            request.submap,
            self.class_id,
            np.flatnonzero(self._is_selected(request.submap)),
        )
        return replace(request, submap=self.applied_to_map(request.submap))

    def applied_to_map(self, elements: Elements3D) -> Elements3D:
        named = np.where(self._is_selected(elements), self.class_id, elements.class_id)
        return replace(elements, class_id=named)

    def _is_selected(self, elements: Elements3D) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        return np.asarray(elements.id == self.element)


@dataclass(frozen=True)
class AddElement(WhatIfChange):
    """Add a map element that is outside the submap."""

    stage: ClassVar[Stage] = Stage.SUBMAP
    element: int

    def describe(self, semantic_map: SemanticMap) -> str:
        return f"with {map_element_name(semantic_map, self.element)} in the submap"

    def affects(self, request: FrameRequest) -> bool:
        if (request.submap.id == self.element).any():
            return False
        offset_m = self._added(request).anchor_m[:, :2] - request.prior.position_m[:2]
        reach_m = request.radius_m + MAX_OUTSIDE_M
        return bool((np.linalg.norm(offset_m, axis=1) < reach_m).any())

    def applied(self, request: FrameRequest) -> FrameRequest:
        return replace(request, submap=joined(request.submap, self._added(request)))

    def _added(self, request: FrameRequest) -> Elements3D:
        elements = request.semantic_map.elements
        return elements[elements.id == self.element]


def check_same_kind(
    request: FrameRequest, elements: Elements, class_id: int, rows: np.ndarray
) -> None:
    """Raise SemvizError if a pole would become a sign, or a sign a pole."""
    classes = request.localizer.classes
    if class_id not in classes:
        raise SemvizError(f"there is no class {class_id}")
    if (elements.is_line[rows] != (classes[class_id].kind == "line")).any():
        raise SemvizError(
            f"a {classes[class_id].name} has another shape; choose a class of the same shape"
        )


@dataclass(frozen=True)
class DropDetection(WhatIfChange):
    """Remove a detection of one frame."""

    stage: ClassVar[Stage] = Stage.DETECTIONS
    frame: int
    observed: int

    def describe(self, semantic_map: SemanticMap) -> str:
        return f"without detection #{self.observed}"

    def affects(self, request: FrameRequest) -> bool:
        return has_detection(request, self.frame, self.observed)

    def applied(self, request: FrameRequest) -> FrameRequest:
        return request.with_rows(np.flatnonzero(request.row != self.observed))


@dataclass(frozen=True)
class DetectionClass(WhatIfChange):
    """Give a detection of one frame another class."""

    stage: ClassVar[Stage] = Stage.DETECTIONS
    frame: int
    observed: int
    class_id: int

    def describe(self, semantic_map: SemanticMap) -> str:
        return f"with detection #{self.observed} as {semantic_map.classes[self.class_id].name}"

    def affects(self, request: FrameRequest) -> bool:
        selected = request.row == self.observed
        differs = (request.observed.class_id[selected] != self.class_id).any()
        return has_detection(request, self.frame, self.observed) and bool(differs)

    def applied(self, request: FrameRequest) -> FrameRequest:
        selected = request.row == self.observed
        check_same_kind(request, request.observed, self.class_id, np.flatnonzero(selected))
        named = np.where(selected, self.class_id, request.observed.class_id)
        return replace(request, observed=replace(request.observed, class_id=named))


@dataclass(frozen=True)
class LeastScore(WhatIfChange):
    """Ignore detections with a lower score."""

    stage: ClassVar[Stage] = Stage.DETECTIONS
    score: float

    def describe(self, semantic_map: SemanticMap) -> str:
        return f"without detections of a score below {self.score:g}"

    def affects(self, request: FrameRequest) -> bool:
        return bool((request.observed.score < self.score).any())

    def applied(self, request: FrameRequest) -> FrameRequest:
        return request.with_rows(np.flatnonzero(request.observed.score >= self.score))


@dataclass(frozen=True)
class NoiseFactor(WhatIfChange):
    """Multiply the noise of all detections."""

    stage: ClassVar[Stage] = Stage.DETECTIONS
    factor: float

    def __post_init__(self) -> None:
        if not 0.0 < self.factor < np.inf:
            raise SemvizError(f"noise factor {self.factor:g}: give a positive number")

    def describe(self, semantic_map: SemanticMap) -> str:
        return f"with {self.factor:g} times the detections' noise"

    def applied(self, request: FrameRequest) -> FrameRequest:
        sigma_px = np.clip(request.observed.sigma_px * self.factor, *SIGMA_PX_RANGE)
        return replace(request, observed=replace(request.observed, sigma_px=sigma_px))


@dataclass(frozen=True)
class IgnoreClasses(WhatIfChange):
    """Tell poles from signs, and ignore their classes."""

    stage: ClassVar[Stage] = Stage.DETECTIONS

    def describe(self, semantic_map: SemanticMap) -> str:
        return "without classes"

    def applied(self, request: FrameRequest) -> FrameRequest:
        classes = request.localizer.classes
        return replace(
            request,
            observed=replace(request.observed, class_id=_class_of_kind(request.observed, classes)),
            submap=replace(request.submap, class_id=_class_of_kind(request.submap, classes)),
        )


def has_detection(request: FrameRequest, frame: int, observed: int) -> bool:
    """Whether the request is of this frame and has this detection."""
    return request.record.frame.index == frame and observed in request.row.tolist()


def _class_of_kind(elements: Elements, classes: ClassSet) -> IntArray:
    """Return (n,) the first class of each element's kind, line or point."""
    first = {class_.kind: class_.id for class_ in reversed(tuple(classes))}
    return np.where(elements.is_line, first.get("line", -1), first.get("point", -1))


@dataclass(frozen=True)
class ForcePair(WhatIfChange):
    """Force the pair of a detection and a map element."""

    stage: ClassVar[Stage] = Stage.PAIRS
    frame: int
    observed: int
    element: int

    def describe(self, semantic_map: SemanticMap) -> str:
        return f"with detection #{self.observed} as {map_element_name(semantic_map, self.element)}"

    def affects(self, request: FrameRequest) -> bool:
        return has_detection(request, self.frame, self.observed)

    def applied(self, request: FrameRequest) -> FrameRequest:
        return replace(request, forced=(*request.forced, (self.observed, self.element)))


@dataclass(frozen=True)
class ForbidPair(WhatIfChange):
    """Forbid the pair of a detection and a map element."""

    stage: ClassVar[Stage] = Stage.PAIRS
    frame: int
    observed: int
    element: int

    def describe(self, semantic_map: SemanticMap) -> str:
        name = map_element_name(semantic_map, self.element)
        return f"with detection #{self.observed} not as {name}"

    def affects(self, request: FrameRequest) -> bool:
        return has_detection(request, self.frame, self.observed)

    def applied(self, request: FrameRequest) -> FrameRequest:
        return replace(request, forbidden=(*request.forbidden, (self.observed, self.element)))


@dataclass(frozen=True)
class ForceTruePairs(WhatIfChange):
    """Force the true pairs that fit at the true pose."""

    stage: ClassVar[Stage] = Stage.PAIRS

    def describe(self, semantic_map: SemanticMap) -> str:
        return "with the true pairs"

    def affects(self, request: FrameRequest) -> bool:
        return len(_true_pairs(request)) > 0

    def applied(self, request: FrameRequest) -> FrameRequest:
        i, j = _true_pairs(request).T
        forced_rows = {row for row, _ in request.forced}
        rows, ids = request.row[i].tolist(), request.submap.id[j].tolist()
        true = [pair for pair in zip(rows, ids, strict=True) if pair[0] not in forced_rows]
        return replace(request, forced=(*request.forced, *true))


def pair_constraints(request: FrameRequest) -> PairConstraints:
    """Return forced and forbidden pairs by rows. Raise SemvizError if the request lacks one."""
    return PairConstraints(_rows(request, request.forced), _rows(request, request.forbidden))


def _rows(request: FrameRequest, pairs: tuple[tuple[int, int], ...]) -> IntArray:
    observed = {row: i for i, row in enumerate(request.row.tolist())}
    mapped = {element: j for j, element in enumerate(request.submap.id.tolist())}
    for row, element in pairs:
        if row not in observed or element not in mapped:
            name = map_element_name(request.semantic_map, element)
            raise SemvizError(
                f"no pair of detection #{row} and {name}: one was removed or is not in the submap"
            )
    rows = [(observed[row], mapped[element]) for row, element in pairs]
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


def _true_pairs(request: FrameRequest) -> IntArray:
    """Return (k, 2) rows (observed, submap) of true pairs that fit at the true pose."""
    if request.truth is None:
        return np.empty((0, 2), dtype=np.int64)
    pairs = np.argwhere(request.element_id[:, None] == request.submap.id)
    pairs = pairs[request.observed.is_line[pairs[:, 0]] == request.submap.is_line[pairs[:, 1]]]
    camera, detector = request.record.localization.camera, request.localizer.detector
    problem = PoseProblem.of(camera, request.observed, request.submap, detector)
    residuals = problem_residuals(problem, request.truth.inverse(), pairs)
    return np.asarray(pairs[residuals.chi2 <= SURELY_OFF * INLIER_CHI2[residuals.rows]])
