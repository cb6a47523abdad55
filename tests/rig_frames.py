"""Frames of a simulated rig: cameras around a car that moves, each exposed row after row."""

from dataclasses import dataclass, replace

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.localization.camera_views import (
    STANDING,
    BodyMotion,
    CameraView,
    rolling_shutter,
)
from semviz_core.localization.least_squares import information
from semviz_core.localization.rig_problem import RigProblem

FRONT = Camera(1240, 380, np.array([[720.0, 0.0, 607.0], [0.0, 720.0, 185.0], [0.0, 0.0, 1.0]]))
ASIDE = Camera(
    960, 600, np.array([[500.0, 0.0, 481.0], [0.0, 500.0, 302.0], [0.0, 0.0, 1.0]]),
    np.array([-0.2, 0.05, 0.0003, -0.0002]),
)  # fmt: skip
FLU = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""R_body_camera of a camera that looks ahead; the body has x ahead, y left, z up."""
REACH_M, NEAREST_M, MAP_SIGMA_M, UP_RAD = 40.0, 3.0, 0.03, float(np.deg2rad(0.5))


def _mount(x_m: float, y_m: float, turned_deg: float) -> Pose:
    turn = Pose.from_rotvec([0.0, 0.0, np.deg2rad(turned_deg)], np.zeros(3)).rotation
    return Pose(turn @ FLU, np.array([x_m, y_m, 1.5]))


MOUNTS = {
    "front": (FRONT, _mount(1.7, 0.1, 0.0)),
    "left": (ASIDE, _mount(0.8, 0.9, 85.0)),
    "right": (ASIDE, _mount(0.8, -0.9, -80.0)),
    "back": (ASIDE, _mount(-1.0, 0.0, 175.0)),
}
LATE_S = {"front": 0.0, "left": 0.013, "right": 0.027, "back": 0.041}
"""When the middle row of each camera is exposed; they need not fire together."""


@dataclass(frozen=True)
class RigKind:
    cameras: tuple[str, ...] = ("front",)
    motion: BodyMotion = STANDING
    readout_s: float = 0.0
    most_seen: int = 8
    """By each camera."""
    sigma_px: float = 1.0
    in_reach: int = 100
    false_share: float = 0.0
    """Detections of each camera that are false, of the true ones."""


@dataclass(frozen=True, eq=False)
class RigFrame:
    views: tuple[CameraView, ...]
    submap: Elements3D
    prior: Prior
    T_first_map: Pose
    """The truth, at the time of the frame."""
    pairs: tuple[IntArray, ...]
    """(k, 2) true ones of each view."""

    @property
    def all_pairs(self) -> IntArray:
        """(K, 2) those of all views, whose elements are counted on."""
        first_row = np.cumsum([0, *(len(view.observed) for view in self.views)])
        own = zip(self.pairs, first_row, strict=False)
        return np.concatenate([pairs + np.array([row, 0]) for pairs, row in own])


def make_rig_frame(seed: int, kind: RigKind) -> RigFrame:
    rng = np.random.default_rng([seed, 31])
    world, body = _world(kind, rng), _body(rng)
    views, pairs = [], []
    for name in kind.cameras:
        camera, mount = MOUNTS[name]
        view, rows = _view(world, body, camera, mount, LATE_S[name], kind, rng)
        views.append(view)
        pairs.append(np.column_stack([np.flatnonzero(rows >= 0), rows[rows >= 0]]))
    error = rng.normal(0.0, MAP_SIGMA_M, (len(world), 3))
    covariance = np.kron([[1.0, 1.0], [1.0, 1.0]], MAP_SIGMA_M**2 * np.eye(3))  # both ends share it
    own = np.kron([[1.0, 0.0], [0.0, 0.0]], np.ones((3, 3)))
    submap = replace(
        world,
        anchor_m=world.anchor_m + error,
        end_m=world.end_m + error,
        covariance_m2=np.where(world.is_line[:, None, None], covariance, own * covariance),
    )
    T_map_first = body @ views[0].T_body_camera
    up = _unit(T_map_first.rotation[2] + rng.normal(0.0, UP_RAD, 3))
    radius, bearing = 10.0 * np.sqrt(rng.random()), rng.uniform(-np.pi, np.pi)
    off_m = np.array([radius * np.cos(bearing), radius * np.sin(bearing), rng.normal(0.0, 0.1)])
    prior = Prior(T_map_first.translation + off_m, 5.0, 0.1, up, UP_RAD)
    return RigFrame(tuple(views), submap, prior, T_map_first.inverse(), tuple(pairs))


def bound(frame: RigFrame, kind: RigKind) -> FloatArray:
    """The Cramer-Rao bound (6, 6) of the first camera's pose: true pairs, at the true pose."""
    problem = RigProblem.of(frame.views, frame.submap, kind.motion, DetectorModel())
    return np.linalg.inv(
        information(problem.whole, frame.prior, frame.T_first_map, frame.all_pairs)
    )


def without_times(frame: RigFrame) -> RigFrame:
    """The same as for somebody who takes all rows of all cameras to be exposed at once."""
    return replace(frame, views=tuple(replace(view, time_s=0.0) for view in frame.views))


def _world(kind: RigKind, rng: np.random.Generator) -> Elements3D:
    n = kind.in_reach
    radius, angle = 60.0 * np.sqrt(rng.random(n)), rng.uniform(-np.pi, np.pi, n)
    class_id = rng.choice(4, n, p=[0.6, 0.1, 0.2, 0.1])
    line, height = class_id == 0, rng.uniform(2.0, 5.0, n)
    foot = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(n)])
    peak = foot + np.column_stack([rng.normal(0.0, 0.01, (n, 2)) * height[:, None], height])
    end = np.where(line[:, None], foot, np.nan)
    return Elements3D.from_ends(np.arange(n), peak, end, class_id, MAP_SIGMA_M)


def _body(rng: np.random.Generator) -> Pose:
    """T_map_body."""
    lean = Pose.from_rotvec([*rng.normal(0.0, 0.01, 2), rng.uniform(-np.pi, np.pi)], np.zeros(3))
    return Pose(lean.rotation, np.array([*rng.uniform(-5.0, 5.0, 2), 0.0]))


def _view(
    world: Elements3D,
    body: Pose,
    camera: Camera,
    mount: Pose,
    late_s: float,
    kind: RigKind,
    rng: np.random.Generator,
) -> tuple[CameraView, IntArray]:
    """What a camera sees, and the row of ``world`` of each element, -1 for false ones."""

    def seen(points_m: FloatArray) -> FloatArray:
        """Pixels of points, each exposed with its own row."""
        pixels = _at(late_s, body, mount, kind, camera, points_m)
        for row in np.flatnonzero(camera.contains(pixels)) if kind.readout_s else ():
            for _ in range(3):
                of_row = np.clip((pixels[row, 1] + 0.5) / camera.height - 0.5, -0.5, 0.5)
                time_s = late_s + kind.readout_s * float(of_row)
                pixels[row] = _at(time_s, body, mount, kind, camera, points_m[row])[0]
        return pixels

    distance = np.linalg.norm(world.anchor_m[:, :2] - body.translation[:2], axis=1)
    near = np.flatnonzero((distance > NEAREST_M) & (distance < REACH_M))
    anchor, end = seen(world.anchor_m[near]), seen(world.end_m[near])
    line = world.is_line[near]
    inside = camera.contains(anchor) & (camera.contains(end) | ~line)
    kept = rng.permutation(np.flatnonzero(inside & (rng.random(len(near)) < 0.8)))[: kind.most_seen]
    rows = near[kept]
    anchor, end = (
        px[kept] + rng.normal(0.0, kind.sigma_px, (len(kept), 2)) for px in (anchor, end)
    )
    class_id = world.class_id[rows]
    false = rng.binomial(len(kept), kind.false_share)
    size = np.array([camera.width, camera.height])
    anchor = np.concatenate([anchor, rng.uniform(0.1, 0.4, (false, 2)) * size])
    end = np.concatenate([end, anchor[len(kept) :] + 0.3 * size * [0.0, 1.0]])
    class_id = np.append(class_id, np.zeros(false, dtype=int))
    end = np.where((class_id == 0)[:, None], end, np.nan)
    observed = Elements2D.from_ends(anchor, end, class_id, kind.sigma_px)
    times = late_s + rolling_shutter(observed, camera, kind.readout_s)
    view = CameraView(observed, camera, mount, times)
    return view, np.append(rows, np.full(false, -1))


def _at(
    time_s: float, body: Pose, mount: Pose, kind: RigKind, camera: Camera, points_m: FloatArray
) -> FloatArray:
    """Where points are in an image exposed at once."""
    T_camera_map = (body @ kind.motion.after(time_s).inverse() @ mount).inverse()
    return camera.project(T_camera_map.apply(points_m))


def _unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / np.linalg.norm(vector))
