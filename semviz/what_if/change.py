"""A change to a recorded frame, the request that the localizer then solves, and changed priors.

Changes apply in the order of their stages, not in the order they are listed in. A change to a
detection names the frame's number. A prior moves along the axes of the true camera pose, or else
of the estimate.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np

from semviz.runs.diagnosis import detector_of
from semviz.runs.run import FrameRecord, Run
from semviz.workspace.localization.localize import CROP_RADIUS_M, ROAD_RADIUS_M
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.diagnosis.assumptions import GRAVITY, HEADING, PriorPart, raised
from semviz_core.localization.localizer import Localizer, known_methods
from semviz_core.localization.matched import MatchedMethodName

NamedPair = tuple[int, int]
"""The recorded row of a detection and the id of a map element."""


@dataclass(frozen=True, eq=False)
class FrameRequest:
    """The input of the localizer for one frame."""

    record: FrameRecord
    """The frame as recorded."""
    semantic_map: SemanticMap
    observed: Elements2D
    row: IntArray
    """(m,) recorded row of each detection."""
    element_id: IntArray
    """(m,) as in ``FrameRecord``."""
    submap: Elements3D
    radius_m: float
    """Radius of the submap around the prior."""
    prior: Prior
    localizer: Localizer
    matched: MatchedMethodName | None = None
    """Solve from the recorded matches by this method, not by the localizer."""
    start: Pose | None = None
    """T_camera_map; the refinement starts here, and there is no search."""
    forced: tuple[NamedPair, ...] = ()
    forbidden: tuple[NamedPair, ...] = ()

    @classmethod
    def of(cls, run: Run, record: FrameRecord) -> "FrameRequest":
        """The recorded request. A frame of a tracked run becomes a request without its history."""
        recorded, info = record.localization, run.info
        prior = recorded.prior or _assumed_prior(record)
        radius_m = float(info.options.get("crop_radius_m") or _extent_m(recorded.submap, prior))
        is_given = recorded.prior is not None
        submap = recorded.submap if is_given else run.semantic_map.crop(prior.position_m, radius_m)
        is_single = info.method in known_methods()
        method = info.method if is_single else "search"
        weights = info.options.get("weights") if is_single else None
        localizer = Localizer(
            method,
            info.seed,
            run.semantic_map.classes,
            detector_of(run),
            Path(weights) if weights else None,
        )
        return cls(
            record,
            run.semantic_map,
            recorded.observed,
            np.arange(len(recorded.observed)),
            record.element_id,
            submap,
            radius_m,
            prior,
            localizer,
        )

    @property
    def method(self) -> str:
        """Name of the method that solves it."""
        return self.matched or self.localizer.method

    @property
    def truth(self) -> Pose | None:
        """True T_map_camera; None if unknown."""
        return self.record.frame.T_map_camera

    @cached_property
    def reference_pose(self) -> Pose | None:
        """T_map_camera: the true pose, or else the recorded estimate."""
        estimate = self.record.localization.T_camera_map
        return self.truth or (None if estimate is None else estimate.inverse())

    def with_rows(self, rows: IntArray) -> "FrameRequest":
        """Keep these rows of the detections only."""
        return replace(
            self,
            observed=self.observed[rows],
            row=self.row[rows],
            element_id=self.element_id[rows],
        )

    def with_prior(self, prior: Prior, radius_m: float) -> "FrameRequest":
        """Replace prior and radius, and crop submap and road from the map again."""
        road_m = self.semantic_map.road_near(prior.position_m, ROAD_RADIUS_M)
        return replace(
            self,
            prior=replace(prior, road_m=None if prior.road_m is None else road_m),
            radius_m=radius_m,
            submap=self.semantic_map.crop(prior.position_m, radius_m),
        )


def _assumed_prior(record: FrameRecord) -> Prior:
    """Return a fix, as common as any, where a frame without one is: by its true pose, or estimate.

    Raise SemvizError without either.
    """
    estimate = record.localization.T_camera_map
    pose = record.frame.T_map_camera or (None if estimate is None else estimate.inverse())
    if pose is None:
        raise SemvizError(
            f"frame {record.frame.index} has no prior, true pose or estimate, so there is no place "
            "to search: what-if needs one; localize or record the run with --priors"
        )
    return Prior(pose.translation)


def _extent_m(submap: Elements3D, prior: Prior) -> float:
    """Horizontal distance from the prior to the farthest element of the submap.

    Without a submap, as far as labels are taken.
    """
    if not len(submap):
        return CROP_RADIUS_M["labels"]
    offset_m = submap.anchor_m[:, :2] - prior.position_m[:2]
    return float(np.linalg.norm(offset_m, axis=1).max(initial=1.0))


class Stage(IntEnum):
    """Changes apply in this order."""

    MAP = 0
    PRIOR = 1
    SUBMAP = 2
    DETECTIONS = 3
    PAIRS = 4
    SOLVER = 5


@dataclass(frozen=True)
class WhatIfChange(ABC):
    """A change to a request. Fields are JSON values; ``frame`` is the number of a frame."""

    stage: ClassVar[Stage]

    @abstractmethod
    def describe(self, semantic_map: SemanticMap) -> str:
        """Return the change in words, for example ``without R-052``."""

    def affects(self, request: FrameRequest) -> bool:
        """Whether the change alters this request."""
        return True

    @abstractmethod
    def applied(self, request: FrameRequest) -> FrameRequest:
        """Return the request with the change, which must affect it."""

    def applied_to_map(self, elements: Elements3D) -> Elements3D:
        """Return the map's elements with the change. Most changes leave the map as it is."""
        return elements


def map_element_name(semantic_map: SemanticMap, element: int) -> str:
    """Return a name, for example R-052; ``element 52`` if the map has no such element."""
    elements = semantic_map.elements
    for class_id in elements.class_id[elements.id == element].tolist():
        return semantic_map.classes.element_name(class_id, element)
    return f"element {element}"


LEFT_OUT: dict[str, PriorPart] = {"heading": HEADING, "gravity": GRAVITY}
"""The parts of a prior that can be left out; position and height are changed instead."""


@dataclass(frozen=True)
class MovePrior(WhatIfChange):
    """Move the prior, in the horizontal axes of the true camera pose, or else of the estimate."""

    stage: ClassVar[Stage] = Stage.PRIOR
    ahead_m: float
    left_m: float

    def describe(self, semantic_map: SemanticMap) -> str:
        moves = [(self.ahead_m, "ahead", "back"), (self.left_m, "to the left", "to the right")]
        texts = [
            f"{abs(m):g} m {positive if m > 0 else negative}"
            for m, positive, negative in moves
            if m
        ]
        return f"with the prior {' and '.join(texts) or '0 m'}"

    def applied(self, request: FrameRequest) -> FrameRequest:
        if request.reference_pose is None:
            raise SemvizError(
                "without a true pose or an estimate, 'ahead' is unknown; choose another change"
            )
        ahead = request.reference_pose.rotation[:2, 2]
        ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
        by_m = self.ahead_m * ahead + self.left_m * np.array([-ahead[1], ahead[0]])
        position_m = request.prior.position_m + np.append(by_m, 0.0)
        return request.with_prior(replace(request.prior, position_m=position_m), request.radius_m)


@dataclass(frozen=True)
class PriorAtTruth(WhatIfChange):
    """Move the prior to the true position."""

    stage: ClassVar[Stage] = Stage.PRIOR

    def describe(self, semantic_map: SemanticMap) -> str:
        return "with the prior at the true position"

    def affects(self, request: FrameRequest) -> bool:
        return request.truth is not None

    def applied(self, request: FrameRequest) -> FrameRequest:
        assert request.truth is not None
        prior = replace(request.prior, position_m=request.truth.translation)
        return request.with_prior(prior, request.radius_m)


@dataclass(frozen=True)
class PriorSigma(WhatIfChange):
    """Change the horizontal sigma of the prior."""

    stage: ClassVar[Stage] = Stage.PRIOR
    sigma_m: float

    def describe(self, semantic_map: SemanticMap) -> str:
        return f"with the prior ± {self.sigma_m:g} m"

    def affects(self, request: FrameRequest) -> bool:
        return request.prior.horizontal_sigma_m != self.sigma_m

    def applied(self, request: FrameRequest) -> FrameRequest:
        return replace(request, prior=replace(request.prior, horizontal_sigma_m=self.sigma_m))


@dataclass(frozen=True)
class CropRadius(WhatIfChange):
    """Change the radius of the submap."""

    stage: ClassVar[Stage] = Stage.PRIOR
    radius_m: float

    def __post_init__(self) -> None:
        if not 0.0 < self.radius_m < np.inf:
            raise SemvizError(f"submap radius {self.radius_m:g} m: give a positive number")

    def describe(self, semantic_map: SemanticMap) -> str:
        return f"with a submap of {self.radius_m:g} m"

    def affects(self, request: FrameRequest) -> bool:
        return request.radius_m != self.radius_m

    def applied(self, request: FrameRequest) -> FrameRequest:
        return request.with_prior(request.prior, self.radius_m)


@dataclass(frozen=True)
class WithoutPriorPart(WhatIfChange):
    """Leave out the heading or the gravity of the prior."""

    stage: ClassVar[Stage] = Stage.PRIOR
    part: str
    """A key of ``LEFT_OUT``."""

    def __post_init__(self) -> None:
        if self.part not in LEFT_OUT:
            raise SemvizError(f"prior part '{self.part}': give {' or '.join(LEFT_OUT)}")

    def describe(self, semantic_map: SemanticMap) -> str:
        return f"without the {LEFT_OUT[self.part].name}"

    def affects(self, request: FrameRequest) -> bool:
        return LEFT_OUT[self.part].is_given(request.prior)

    def applied(self, request: FrameRequest) -> FrameRequest:
        without, *_ = LEFT_OUT[self.part].without(request.prior)
        return replace(request, prior=without)


@dataclass(frozen=True)
class RaisePrior(WhatIfChange):
    """Raise the height that the prior gives, and the road with it."""

    stage: ClassVar[Stage] = Stage.PRIOR
    up_m: float

    def describe(self, semantic_map: SemanticMap) -> str:
        return f"with the prior {abs(self.up_m):.2g} m {'higher' if self.up_m > 0.0 else 'lower'}"

    def applied(self, request: FrameRequest) -> FrameRequest:
        return replace(request, prior=raised(request.prior, self.up_m))
