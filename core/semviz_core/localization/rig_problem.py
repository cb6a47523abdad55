"""The problem of a rig: what each camera sees, and all of it for the pose of the first camera.

Each camera pairs its elements on its own, by its pose at the middle of its times. The pose of the
rig is fitted to all of them at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.elements import Elements2D, Elements3D, joined
from semviz_core.base.frame import adjoint
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.localization.association import associate, log_likelihood
from semviz_core.localization.camera_views import BodyMotion, CameraView
from semviz_core.localization.prior_residuals import prior_chi2
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.localization.search import with_sigma_scale

NO_PRIOR = PriorRecord.of(None)


class RigPart(NamedTuple):
    """What one camera sees, for its own pose at the middle of its times."""

    problem: PoseProblem
    mount: Pose
    """T_camera_first."""
    T_camera_first: Pose
    """From the first camera at the time of the frame to this one at its own."""
    change: FloatArray
    """(6, 6) adjoint of that."""
    rows: slice
    """Its elements among those of all cameras."""

    def pose(self, R: FloatArray, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return its pose for a pose of the first camera."""
        T = self.T_camera_first
        return T.rotation @ R, T.rotation @ t + T.translation


@dataclass(frozen=True, eq=False)
class RigProblem:
    """M elements seen by all cameras of a rig, for the pose of the first one."""

    views: tuple[CameraView, ...]
    whole: PoseProblem
    """All elements as if in the image of the first camera, for pairs that are given."""
    parts: tuple[RigPart, ...]

    @classmethod
    def of(
        cls,
        views: Sequence[CameraView],
        submap: Elements3D,
        motion: BodyMotion,
        detector: DetectorModel | None,
    ) -> "RigProblem":
        parts: list[RigPart] = []
        ends: list[PosesOfEnds] = []
        first, count = views[0].T_body_camera, 0
        for view in views:
            T_camera_first = _camera_at(view, motion, view.mean_time_s) @ first
            ends.append(PosesOfEnds.of(view, motion, first))
            own = PoseProblem.of(view.camera, view.observed, submap, detector)
            own = own.moved(*ends[-1].relative_to(T_camera_first))
            rows = slice(count, count + len(view.observed))
            count = rows.stop
            mount = view.T_body_camera.inverse() @ first
            parts.append(RigPart(own, mount, T_camera_first, adjoint(T_camera_first), rows))
        whole = _whole(views, submap, detector, parts).moved(
            np.concatenate([of_view.turn for of_view in ends]),
            np.concatenate([of_view.shift_m for of_view in ends]),
        )
        return cls(tuple(views), whole, tuple(parts))

    def with_sigma_scale(self, scale: float) -> "RigProblem":
        """Return the problem with all sigmas of the detections multiplied."""
        parts = tuple(
            part._replace(problem=with_sigma_scale(part.problem, scale)) for part in self.parts
        )
        return replace(self, whole=with_sigma_scale(self.whole, scale), parts=parts)

    def associated(
        self, R: FloatArray, t: FloatArray, covariance: FloatArray
    ) -> tuple[IntArray, FloatArray]:
        """Return ``associate`` of each camera, for all elements: mapped rows (M,), gains (M,)."""
        own = [
            associate(part.problem, *part.pose(R, t), part.change @ covariance @ part.change.T)
            for part in self.parts
        ]
        match, gain = zip(*own, strict=True)
        return np.concatenate(match), np.concatenate(gain)

    def score(
        self, prior: PriorRecord, R: FloatArray, t: FloatArray, match: IntArray, gain: FloatArray
    ) -> float:
        """Return the score of a pose in nats, of all cameras and the prior."""
        return -0.5 * prior_chi2(prior, R, t) + sum(
            log_likelihood(
                part.problem, NO_PRIOR, *part.pose(R, t), match[part.rows], gain[part.rows]
            )
            for part in self.parts
        )


class PosesOfEnds(NamedTuple):
    """From the first camera at the time of the frame to the camera that saw each end, then."""

    turn: FloatArray  # (m, 2, 3, 3)
    shift_m: FloatArray  # (m, 2, 3)

    @classmethod
    def of(cls, view: CameraView, motion: BodyMotion, first: Pose) -> "PosesOfEnds":
        times, row = np.unique(np.asarray(view.time_s), return_inverse=True)
        poses = [_camera_at(view, motion, time_s) @ first for time_s in times.tolist()]
        shape = (len(view.observed), 2)
        turn = np.array([pose.rotation for pose in poses]).reshape(-1, 3, 3)
        shift_m = np.array([pose.translation for pose in poses]).reshape(-1, 3)
        return cls(turn[row.reshape(shape)], shift_m[row.reshape(shape)])

    def relative_to(self, T_camera_first: Pose) -> "PosesOfEnds":
        """Return them from another pose than that of the first camera."""
        turn = self.turn @ T_camera_first.rotation.T
        return PosesOfEnds(turn, self.shift_m - turn @ T_camera_first.translation)


def _camera_at(view: CameraView, motion: BodyMotion, time_s: float) -> Pose:
    """Return T_camera_body: from the body at the time of the frame to the camera at another."""
    return view.T_body_camera.inverse() @ motion.after(time_s)


def _whole(
    views: Sequence[CameraView],
    submap: Elements3D,
    detector: DetectorModel | None,
    parts: Sequence[RigPart],
) -> PoseProblem:
    """Return the problem of all elements as if they were in the image of the first camera."""
    camera = Camera(views[0].camera.width, views[0].camera.height, views[0].camera.K)
    observed = joined(*(_in_image_of(camera, view) for view in views))
    problem = PoseProblem.of(camera, observed, submap, detector)
    for view, part in zip(views, parts, strict=True):
        own, enlarged = problem.seen[part.rows], camera.K[0, 0] / view.camera.K[0, 0]
        own["variance_px2"] = part.problem.seen["variance_px2"] * enlarged**2
        own["clutter"] = part.problem.seen["clutter"] - np.log(enlarged)
    return problem


def _in_image_of(camera: Camera, view: CameraView) -> Elements2D:
    seen, K = view.observed, camera.K
    end_px = np.where(seen.is_line[:, None], seen.end_px, seen.anchor_px)
    anchor, end = (
        view.camera.normalize(pixels) @ K[:2, :2].T + K[:2, 2]
        for pixels in (seen.anchor_px, end_px)
    )
    end = np.where(seen.is_line[:, None], end, np.nan)
    return replace(seen, anchor_px=anchor, end_px=end)
