"""What the localizer is asked of one frame, as values that changes make others of."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from semviz.drive import ROAD_RADIUS_M
from semviz.recording.run import FrameRecord, Run
from semviz.verdicts import detector_of
from semviz_core.arrays import IntArray
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.frame import Prior
from semviz_core.localize import METHODS, Localizer
from semviz_core.pose import Pose
from semviz_core.semantic_map import SemanticMap
from semviz_core.solving.matched import MatchedMethodName

NamedPair = tuple[int, int]
"""A row of what was observed, as recorded, and the id of a map element."""


@dataclass(frozen=True, eq=False)
class Asked:
    """One frame's question."""

    record: FrameRecord
    """As it was recorded."""
    semantic_map: SemanticMap
    observed: Elements2D
    row: IntArray
    """(m,) which recorded row each observed one is."""
    element_id: IntArray
    """(m,) as in ``FrameRecord``."""
    submap: Elements3D
    radius_m: float
    """Of the submap, about the prior."""
    prior: Prior
    localizer: Localizer
    matched: MatchedMethodName | None = None
    """A solver that takes the matches which the frame brought, in place of the localizer."""
    start: Pose | None = None
    """T_camera_map in place of a search."""
    forced: tuple[NamedPair, ...] = ()
    forbidden: tuple[NamedPair, ...] = ()

    @classmethod
    def of(cls, run: Run, record: FrameRecord) -> "Asked":
        """As the run asked; of a run that followed the camera, as of a frame by itself."""
        one, info = record.localization, run.info
        by_itself = info.method in METHODS
        method = info.method if by_itself else METHODS[0]
        weights = info.options.get("weights") if by_itself else None
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
            one.observed,
            np.arange(len(one.observed)),
            record.element_id,
            one.submap,
            float(info.options.get("crop_radius_m") or _reach_m(one.submap, one.prior)),
            one.prior,
            localizer,
        )

    @property
    def method(self) -> str:
        """How it is solved."""
        return self.matched or self.localizer.method

    @property
    def truth(self) -> Pose | None:
        """T_map_camera."""
        return self.record.frame.T_map_camera

    @cached_property
    def about(self) -> Pose | None:
        """T_map_camera of the truth, or else of the recorded answer."""
        answer = self.record.localization.T_camera_map
        return self.truth or (None if answer is None else answer.inverse())

    def keeping(self, rows: IntArray) -> "Asked":
        """With these of the observed rows alone."""
        return replace(
            self,
            observed=self.observed[rows],
            row=self.row[rows],
            element_id=self.element_id[rows],
        )

    def around(self, prior: Prior, radius_m: float) -> "Asked":
        """With another prior or radius: submap and road are cut out of the map anew."""
        road_m = self.semantic_map.road_near(prior.position_m, ROAD_RADIUS_M)
        return replace(
            self,
            prior=replace(prior, road_m=None if prior.road_m is None else road_m),
            radius_m=radius_m,
            submap=self.semantic_map.crop(prior.position_m, radius_m),
        )


def _reach_m(submap: Elements3D, prior: Prior) -> float:
    """How far the submap reaches, where the run does not say."""
    offset_m = submap.anchor_m[:, :2] - prior.position_m[:2]
    return float(np.linalg.norm(offset_m, axis=1).max(initial=1.0))
