"""Camera poses along a route, the elements in view there, and the assumed conditions.

The conditions are the detector, its noise and the prior. A simulated detection adds recall, noise
and false positives to the elements in view. Pixels are undistorted: a lens would change only the
limits of the image. Candidates for new poles and signs stand at regular distances on both sides.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from semviz_core.base.camera import MIN_DEPTH_M, Camera
from semviz_core.base.classes import POLE, RECTANGULAR, ROUNDED, TRIANGULAR, ClassSet
from semviz_core.base.detector_model import DetectorModel, Noise
from semviz_core.base.elements import Elements2D, Elements3D, joined
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.priors import PriorOptions

AXES: FloatArray = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Rotation of a level camera that looks along x, z up: its columns are the camera's axes."""
UP: FloatArray = np.array([0.0, 0.0, 1.0])
CAMERA_HEIGHT_M = 1.65
"""Height of KITTI's camera above the road."""
GAP_M = 20.0
"""Positions further apart than this belong to different drives."""
SPACING_M, BESIDE_M = 10.0, 5.0
"""Distance between candidates along the route, and beside it, on either side."""
CLEAR_M = 3.0
"""Least distance of candidates from the route and from mapped elements."""
POLE_M, SIGN_M, SIGMA_M = 4.0, 2.3, 0.05
"""Heights of a candidate pole and of a candidate sign's centre; sigma of their positions."""


def poses_along(track_m: FloatArray) -> tuple[Pose, ...]:
    """Return T_map_camera at each point of ``track_m`` (k, 3), looking along it, without roll.

    A gap of more than GAP_M begins a new drive. A drive of a single point has no direction and is
    left out.
    """
    gaps = np.linalg.norm(np.diff(track_m, axis=0), axis=1) > GAP_M
    drives = np.split(track_m, np.flatnonzero(gaps) + 1)
    return tuple(pose for drive in drives if len(drive) > 1 for pose in _along(drive))


def thinned(centers_m: FloatArray, step_m: float) -> list[int]:
    """Return rows of ``centers_m`` (k, 3): the first, then each ``step_m`` from the previous."""
    kept = [0] if len(centers_m) else []
    for row, center in enumerate(centers_m):
        if np.linalg.norm(center - centers_m[kept[-1]]) >= step_m:
            kept.append(row)
    return kept


def distance_along(centers_m: FloatArray) -> FloatArray:
    """Return (k,) metres driven up to each of ``centers_m`` (k, 3), without gaps of drives."""
    steps = np.linalg.norm(np.diff(centers_m, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(np.where(steps > GAP_M, 0.0, steps))])


def candidates_beside(poses: tuple[Pose, ...], mapped: Elements3D, classes: ClassSet) -> Elements3D:
    """Return candidates for new elements: every SPACING_M on both sides, where there is room.

    Each kind is represented by its first class: all points carry the same information, and so do
    all lines.
    """
    foot = _free_positions(poses, mapped)
    kinds = {class_.kind: class_.id for class_ in reversed(tuple(classes))}
    no_end = np.full_like(foot, np.nan)
    anchor, end = {"line": foot + POLE_M * UP, "point": foot + SIGN_M * UP}, {"line": foot}
    ids = int(mapped.id.max(initial=0)) + 1 + np.arange(len(kinds) * len(foot))
    return Elements3D.from_ends(
        ids,
        np.concatenate([anchor[kind] for kind in kinds]),
        np.concatenate([end.get(kind, no_end) for kind in kinds]),
        np.repeat(list(kinds.values()), len(foot)),
        SIGMA_M,
    )


def _free_positions(poses: tuple[Pose, ...], mapped: Elements3D) -> FloatArray:
    """Return (p, 3) free positions on the ground beside the route."""
    from scipy.spatial import cKDTree

    centers = np.array([pose.translation for pose in poses])
    rows = thinned(centers, SPACING_M)
    right = np.array([poses[row].rotation[:, 0] for row in rows]) * [1.0, 1.0, 0.0]
    middle = centers[rows] - CAMERA_HEIGHT_M * UP
    places = np.concatenate([middle + BESIDE_M * right, middle - BESIDE_M * right])
    occupied = np.concatenate([centers[:, :2], mapped.anchor_m[:, :2]])
    return np.asarray(places[cKDTree(occupied).query(places[:, :2])[0] >= CLEAR_M])


def _along(track_m: FloatArray) -> list[Pose]:
    ahead = np.gradient(track_m, axis=0)
    heading = np.arctan2(ahead[:, 1], ahead[:, 0])
    slope = np.arctan2(ahead[:, 2], np.hypot(ahead[:, 0], ahead[:, 1]))
    poses = []
    for center, turn, rise in zip(track_m, heading, slope, strict=True):
        level = Pose.from_rotvec([0.0, 0.0, turn], center)
        uphill = Pose.from_rotvec([0.0, -rise, 0.0], np.zeros(3))
        poses.append(level @ uphill @ Pose(AXES, np.zeros(3)))
    return poses


LABEL_NOISE = Noise(1.0, 1.0, 0.0, {TRIANGULAR: 1.0, RECTANGULAR: 1.0, ROUNDED: 1.0})
"""Noise of labels drawn by people."""


@dataclass(frozen=True)
class Conditions:
    """The conditions under which the camera will be localized."""

    detector: DetectorModel = field(default_factory=DetectorModel)
    noise: Noise = LABEL_NOISE
    hidden_bottoms: float = 0.5
    """Share of poles with a bottom hidden by cars or hedges. The detector flags it, unless its
    model has ``hidden_bottoms`` too."""
    prior: PriorOptions = field(default_factory=PriorOptions)
    crop_radius_m: float = 120.0
    road_radius_m: float = 60.0
    """Radius of the map's road around the fix, which gives the height."""
    outcomes: int = 64
    """Number of detection outcomes drawn at each position."""
    trials: int = 4
    """Number of simulated frames localized at each position."""
    seed: int = 0

    def __post_init__(self) -> None:
        self.detector.checked()
        if not 0.0 <= self.hidden_bottoms < 1.0:
            raise SemvizError("hidden_bottoms must be in [0, 1)")
        if not 0.0 < self.crop_radius_m < np.inf:
            raise SemvizError(f"crop radius {self.crop_radius_m:g} m: give a positive number")
        if min(self.outcomes, self.trials, self.seed) < 0 or not self.outcomes:
            raise SemvizError(
                "outcomes, trials and seed are whole numbers; give at least 1 outcome"
            )


NEAREST_M = 3.0
"""Elements closer to the camera do not count."""
LEAST_LENGTH_PX = 15.0
"""Shorter poles are not detected."""
SHOWN_LENGTH = (0.5, 0.85)
"""Range of the visible share of a pole with a hidden bottom."""
FALSE_POLES = 0.7
"""Share of poles among false positives."""


@dataclass(frozen=True, eq=False)
class VisibleElements:
    """The m elements in view, and their exact projections."""

    row: IntArray
    """(m,) rows of the given elements."""
    seen: Elements2D
    recall: FloatArray
    """(m,) probability that each is detected."""


def visible_elements(
    elements: Elements3D,
    camera: Camera,
    T_camera_map: Pose,
    conditions: Conditions,
    shown: FloatArray | None = None,
) -> VisibleElements:
    """Return the visible ones of ``elements`` (n,); of poles the upper share ``shown`` (n,)."""
    line = elements.is_line
    anchor_c = T_camera_map.apply(elements.anchor_m)
    bottom_m = elements.end_m
    if shown is not None:
        bottom_m = elements.anchor_m + shown[:, None] * (elements.end_m - elements.anchor_m)
    end_c = T_camera_map.apply(bottom_m)
    anchor, end = _project(camera, anchor_c), _project(camera, end_c)
    top, top_cut = _clip_vertically(camera, anchor, end)
    bottom, bottom_cut = _clip_vertically(camera, end, anchor)
    top = np.where(line[:, None], top, anchor)
    recall = conditions.detector.recall_at(anchor_c[:, 2])
    visible = camera.contains(top) & (anchor_c[:, 2] > NEAREST_M) & (recall > 0.0)
    visible &= ~line | (camera.contains(bottom) & (_length(top - bottom) > LEAST_LENGTH_PX))
    row = np.flatnonzero(visible)
    seen = Elements2D(
        anchor_px=top[row],
        end_px=np.where(line[:, None], bottom, np.nan)[row],
        class_id=elements.class_id[row],
        score=np.full(len(row), 0.9),
        sigma_px=np.ones((len(row), 2)),
        anchor_known=(elements.anchor_known & ~(line & top_cut))[row],
        end_known=(elements.end_known & line & ~bottom_cut)[row],
    )
    return VisibleElements(
        row, replace(seen, sigma_px=detection_sigma_px(seen, conditions.noise)), recall[row]
    )


def detection_sigma_px(seen: Elements2D, noise: Noise) -> FloatArray:
    """Return (m, 2) sigmas across and along; at a pole's ends its angle's error is included."""
    line = seen.is_line
    sign = np.array([noise.sign_px.get(class_id, 1.0) for class_id in seen.class_id.tolist()])
    half = np.where(line, 0.5 * _length(seen.end_px - seen.anchor_px), 0.0)
    across = np.hypot(noise.pole_across_px, np.tan(noise.pole_angle_rad) * half)
    pole = np.stack([across, np.full(len(seen), noise.pole_along_px)], axis=1)
    return np.where(line[:, None], pole, sign.reshape(-1, 1))


def detect(
    elements: Elements3D,
    camera: Camera,
    T_camera_map: Pose,
    conditions: Conditions,
    rng: np.random.Generator,
) -> Elements2D:
    """Return the detections of a simulated frame: noisy true ones, then false positives."""
    n = len(elements)
    hidden = rng.random(n) < conditions.hidden_bottoms
    shown = np.where(hidden, rng.uniform(*SHOWN_LENGTH, n), 1.0)
    visible = visible_elements(elements, camera, T_camera_map, conditions, shown)
    detected = rng.random(n)[visible.row] < visible.recall
    detections, hidden = visible.seen[detected], hidden[visible.row][detected]
    if conditions.detector.hidden_bottoms == 0.0:  # the detector flags hidden bottoms
        detections = replace(detections, end_known=detections.end_known & ~hidden)
    return joined(_with_noise(detections, rng), _false_positives(camera, conditions, rng))


def _project(camera: Camera, points_c: FloatArray) -> FloatArray:
    """Return (n, 2) undistorted pixels; NaN behind the camera and for ends of points."""
    with np.errstate(invalid="ignore", divide="ignore"):
        ahead = np.where(points_c[:, 2:] > MIN_DEPTH_M, points_c, np.nan)
        return np.asarray((ahead @ camera.K.T)[:, :2] / ahead[:, 2:])


def _clip_vertically(
    camera: Camera, point: FloatArray, other: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return points moved along the line to ``other`` into the image's rows, and which moved."""
    limit = np.clip(point[:, 1], 0.0, camera.height - 1.0)
    cut = np.asarray((limit != point[:, 1]) & np.isfinite(point[:, 1]))
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(cut, (limit - point[:, 1]) / (other[:, 1] - point[:, 1]), 0.0)
        return point + share[:, None] * (other - point), cut


def _with_noise(true: Elements2D, rng: np.random.Generator) -> Elements2D:
    """Return the elements with noise across and along at ends of poles, in u and v of signs."""
    m, line = len(true), true.is_line
    down = np.tile([0.0, 1.0], (m, 1))
    axis = true.end_px[line] - true.anchor_px[line]
    down[line] = axis / _length(axis)[:, None]
    across = np.stack([down[:, 1], -down[:, 0]], axis=1)
    noise = rng.standard_normal((2, m, 2)) * true.sigma_px
    offset = noise[:, :, :1] * across + noise[:, :, 1:] * down
    return replace(true, anchor_px=true.anchor_px + offset[0], end_px=true.end_px + offset[1])


def _false_positives(
    camera: Camera, conditions: Conditions, rng: np.random.Generator
) -> Elements2D:
    """Return false positives in the upper half of the image."""
    count = int(rng.poisson(conditions.detector.false_detections))
    signs = np.array(sorted(conditions.noise.sign_px))
    class_id = np.where(rng.random(count) < FALSE_POLES, POLE, rng.choice(signs, count))
    anchor = rng.uniform((0.0, 0.0), (camera.width - 1.0, 0.5 * camera.height), (count, 2))
    length = rng.uniform(0.1, 0.5, count) * camera.height
    end = anchor + np.column_stack([rng.normal(0.0, 2.0, count), length])
    false = Elements2D.from_ends(
        anchor, np.where((class_id == POLE)[:, None], end, np.nan), class_id
    )
    return replace(
        false,
        score=rng.uniform(0.3, 0.8, count),
        sigma_px=detection_sigma_px(false, conditions.noise),
    )


def _length(vectors: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(vectors, axis=1))
