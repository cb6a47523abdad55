"""A drive followed from frame to frame with odometry, each frame recorded as a localization."""

from dataclasses import dataclass, field
from time import perf_counter

import numpy as np

from semviz_core.camera import Camera
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.frame import Frame, Prior
from semviz_core.localization import Localization, Refinement
from semviz_core.localize import Localizer
from semviz_core.pose import Pose
from semviz_core.semantic_map import SemanticMap
from semviz_core.sequence.odometry import Odometry, OdometryNoise
from semviz_core.sequence.tracker import Track, Tracker
from semviz_core.solving.residuals import pair_residuals

METHOD = "track"
"""What localizations and runs of this kind give as their method."""
ODOMETRY_NOISE = OdometryNoise()
_ODOMETRY_DRAWS = 2  # beside those of the prior and of the detector in both images


@dataclass
class Follower:
    """Localizes the frames of one drive; give them in order."""

    camera: Camera
    semantic_map: SemanticMap
    localizer: Localizer
    """For frames by themselves, while the pose is not known yet."""
    crop_m: float
    seed: int
    """Of the simulated odometry."""
    _tracker: Tracker = field(init=False)
    _before: Pose | None = None
    """True T_map_camera of the frame before."""

    def __post_init__(self) -> None:
        self._tracker = Tracker(
            self.camera,
            self.semantic_map,
            self.localizer.detector,
            self.localizer,
            crop_m=self.crop_m,
        )

    def localize(self, frame: Frame, observed: Elements2D, prior: Prior) -> Localization:
        """The tracker's answer: ``ok``, or ``cannot`` while it is starting or lost."""
        odometry = self._odometry(frame)
        self._before = frame.T_map_camera
        start = perf_counter()
        track = self._tracker.step(observed, odometry, prior)
        time_ms = (perf_counter() - start) * 1e3
        return self._recorded(track, observed, prior, time_ms)

    def _odometry(self, frame: Frame) -> Odometry | None:
        """The true way from the frame before, measured with noise; None at the first."""
        now, before = frame.T_map_camera, self._before
        if now is None or before is None:
            return None
        rng = np.random.default_rng([self.seed, frame.index, _ODOMETRY_DRAWS])
        return ODOMETRY_NOISE.measure(now.inverse() @ before, rng)

    def _recorded(
        self, track: Track, observed: Elements2D, prior: Prior, time_ms: float
    ) -> Localization:
        alone, pose = track.localization, track.T_camera_map
        submap = alone.submap if alone else self._submap(pose, prior)
        stages = alone.time_ms if alone else {}
        return Localization(
            METHOD,
            self.camera,
            prior,
            observed,
            submap,
            status="cannot" if pose is None else "ok",
            reason=_reason(track),
            T_camera_map=pose,
            covariance=track.covariance,
            match=alone.match if alone else None,
            search=alone.search if alone else None,
            refinement=None if pose is None else _fit(track, pose, self.camera, observed, submap),
            alternatives=alone.alternatives if alone else (),
            time_ms={**stages, "track": time_ms - sum(stages.values())},
        )

    def _submap(self, T_camera_map: Pose | None, prior: Prior) -> Elements3D:
        center_m = prior.position_m if T_camera_map is None else T_camera_map.inverse().translation
        return self.semantic_map.crop(center_m, self.crop_m)


def _reason(track: Track) -> str:
    if track.status == "ok":
        return track.reason
    state = "Starting" if track.status == "starting" else "Lost"
    return f"{state}: {track.reason[0].lower()}{track.reason[1:]}"


def _fit(
    track: Track, T_camera_map: Pose, camera: Camera, observed: Elements2D, submap: Elements3D
) -> Refinement:
    """The track's pairs and their residuals at its pose, against the map as it is."""
    pairs = np.argwhere(track.element_id[:, None] == submap.id)
    found = pair_residuals(T_camera_map, camera, observed, submap, pairs)
    cost = np.array([np.minimum(found.chi2, 1e9).sum()])  # nothing was iterated
    return Refinement(pairs, found.residual_px, found.chi2, found.inlier, cost)
