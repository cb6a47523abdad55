"""Track the camera through a sequence: the tracker's pose of each frame as a localization."""

from dataclasses import dataclass, field
from time import perf_counter

import numpy as np

from semviz.runs.recorder import fitted_pairs
from semviz.runs.run import TRACK
from semviz_core.base.camera import Camera
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Odometry, Prior
from semviz_core.base.localization import Localization, Refinement
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.localization.localizer import Localizer
from semviz_core.tracking.tracker import TrackedPose, Tracker


@dataclass
class SequenceTracker:
    """Localizes the frames of one sequence by tracking; give them in order."""

    camera: Camera
    semantic_map: SemanticMap
    localizer: Localizer
    """Localizes single frames while the pose is unknown."""
    crop_m: float
    _tracker: Tracker = field(init=False)

    def __post_init__(self) -> None:
        self._tracker = Tracker(
            self.camera,
            self.semantic_map,
            self.localizer.detector,
            self.localizer,
            crop_m=self.crop_m,
        )

    def localize(
        self, observed: Elements2D, prior: Prior | None, odometry: Odometry | None
    ) -> Localization:
        """Return the tracked pose as ``ok``, or ``cannot`` while it is starting or lost.

        ``odometry`` is the motion since the frame before.
        """
        start = perf_counter()
        tracked = self._tracker.step(observed, odometry, prior)
        time_ms = (perf_counter() - start) * 1e3
        return self._as_localization(tracked, observed, prior, time_ms)

    def _as_localization(
        self, tracked: TrackedPose, observed: Elements2D, prior: Prior | None, time_ms: float
    ) -> Localization:
        single, pose = tracked.localization, tracked.T_camera_map
        submap = single.submap if single else self._submap(pose, prior)
        stages = single.time_ms if single else {}
        return Localization(
            TRACK,
            self.camera,
            prior,
            observed,
            submap,
            status="cannot" if pose is None else "ok",
            reason=_reason(tracked),
            T_camera_map=pose,
            covariance=tracked.covariance,
            match=single.match if single else None,
            search=single.search if single else None,
            refinement=None if pose is None else self._fit(tracked, pose, observed, submap),
            alternatives=single.alternatives if single else (),
            time_ms={**stages, "track": time_ms - sum(stages.values())},
        )

    def _fit(
        self, tracked: TrackedPose, T_camera_map: Pose, observed: Elements2D, submap: Elements3D
    ) -> Refinement:
        """Return the tracked pairs and their residuals against the map at the tracked pose."""
        pairs = np.argwhere(tracked.element_id[:, None] == submap.id)
        detector = self.localizer.detector
        return fitted_pairs(T_camera_map, self.camera, observed, submap, pairs, detector)

    def _submap(self, T_camera_map: Pose | None, prior: Prior | None) -> Elements3D:
        if T_camera_map is not None:
            return self.semantic_map.crop(T_camera_map.inverse().translation, self.crop_m)
        if prior is None:
            return self.semantic_map.elements[:0]
        return self.semantic_map.crop(prior.position_m, self.crop_m)


def _reason(tracked: TrackedPose) -> str:
    if tracked.status == "ok":
        return tracked.reason
    state = "Starting" if tracked.status == "starting" else "Lost"
    return f"{state}: {tracked.reason[0].lower()}{tracked.reason[1:]}"
