"""Localization problems with known answers: poles and signs along a road, seen and mapped.

Figures follow the published error tables of the method and its map (per class recall, map sigmas).
No pictures; the simulated street has those.
"""

from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.camera import Camera
from semviz_core.classes import POLE, RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.frame import Prior
from semviz_core.pose import Pose

CAMERA = Camera(
    1241, 376, np.array([[718.856, 0.0, 607.1928], [0.0, 718.856, 185.2157], [0.0, 0.0, 1.0]])
)
CAMERA_HEIGHT_M = 1.65
RECALL = np.array([0.66, 0.89, 0.87, 0.79])
"""By class id: pole, triangular, rectangular, rounded."""


@dataclass(frozen=True)
class Difficulty:
    """How noisy a problem is; the defaults are the benchmark's low noise."""

    sigma_px: float = 1.0
    hidden_bottoms: float = 0.5
    """Share of poles whose bottom a car or hedge hides."""
    false_detections: float = 0.5
    """Mean number in an image."""
    missing: float = 0.05
    """Share of elements not in the map."""
    moved: float = 0.05
    """Share of elements that stood 8 m elsewhere when the map was made."""
    map_sigma_m: float = 0.04
    gps_sigma_m: float = 5.5
    gps_offset_m: float | None = None
    """Exact distance of the fix from the truth instead of a random one."""
    with_gravity: bool = True
    crop_m: float = 50.0
    elements: int = 60
    """Poles along 150 m of road; signs come on top."""


@dataclass(frozen=True, eq=False)
class Problem:
    """What a solver is given, and the answer."""

    observed: Elements2D
    submap: Elements3D
    camera: Camera
    prior: Prior
    T_camera_map: Pose
    pairs: IntArray
    """(k, 2) true pairs (row of observed, row of submap), moved elements left out."""


def make_problem(seed: int, difficulty: Difficulty | None = None) -> Problem:
    """A camera on a winding road, what it sees and what the map holds. Repeatable by seed."""
    level = difficulty or Difficulty()
    rng = np.random.default_rng(seed)
    T_camera_map = _camera_pose(rng)
    world = _street(level, rng)
    mapped, moved = _mapped(world, level, rng)
    observed, seen = _observed(world, T_camera_map, level, rng)
    prior = _prior(T_camera_map, level, rng)
    distance = np.linalg.norm(mapped.anchor_m[:, :2] - prior.position_m[:2], axis=1)
    rows = np.flatnonzero(distance <= level.crop_m)
    submap = mapped[rows]
    trusted = np.where(moved[rows], -2, submap.id)  # -1 is a false detection
    pairs = np.argwhere(seen[:, None] == trusted[None, :])
    return Problem(observed, submap, CAMERA, prior, T_camera_map, pairs)


def _road_y(x_m: FloatArray | float) -> FloatArray:
    """Lateral position (m) of the road's middle at ``x_m``."""
    return np.asarray(6.0 * np.sin(np.asarray(x_m) / 35.0))


def _camera_pose(rng: np.random.Generator) -> Pose:
    x = rng.normal(0.0, 5.0)
    y = float(_road_y(x)) - 1.5 + rng.normal(0.0, 0.3)
    slope = 6.0 / 35.0 * np.cos(x / 35.0)
    heading = np.arctan(slope) + np.deg2rad(rng.normal(0.0, 3.0))
    pitch, roll = np.deg2rad(rng.normal(0.0, 0.5, 2))
    T_map_level = Pose.from_rotvec([0.0, 0.0, heading], [x, y, CAMERA_HEIGHT_M])
    axes = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # z forward -> x
    tilt = Pose.from_rotvec([pitch, 0.0, roll], np.zeros(3))
    return (T_map_level @ Pose(axes, np.zeros(3)) @ tilt).inverse()


def _street(level: Difficulty, rng: np.random.Generator) -> Elements3D:
    """Posts, lamps and others on both sides, with signs on most posts; the true world."""
    count = level.elements
    x = rng.uniform(-75.0, 75.0, count)
    side = rng.choice([-1.0, 1.0], count)
    y = _road_y(x) + side * rng.uniform(3.5, 9.0, count)
    kind = rng.choice(3, count, p=[0.4, 0.4, 0.2])
    height = rng.uniform(np.array([2.2, 4.0, 3.0])[kind], np.array([3.3, 8.0, 5.0])[kind])
    ground = rng.normal(0.0, 0.1, count)
    lean = np.deg2rad(rng.normal(0.0, 0.7, (count, 2))) * height[:, None]
    bottom = np.column_stack([x, y, ground])
    peak = bottom + np.column_stack([lean, height])
    signed = rng.random(count) < np.array([0.75, 0.15, 0.0])[kind]
    sign_height = rng.uniform(2.0, np.minimum(height, 2.9))
    middle = bottom + (peak - bottom) * (sign_height / height)[:, None]
    signs = middle[signed]
    sign_class = rng.choice([TRIANGULAR, RECTANGULAR, ROUNDED], len(signs), p=[0.25, 0.45, 0.3])
    return Elements3D.from_ends(
        np.arange(count + len(signs)),
        np.concatenate([peak, signs]),
        np.concatenate([bottom, np.full_like(signs, np.nan)]),
        np.concatenate([np.full(count, POLE), sign_class]),
    )


def _mapped(
    world: Elements3D, level: Difficulty, rng: np.random.Generator
) -> tuple[Elements3D, BoolArray]:
    """The map of the world, with its errors; and (n,) which elements stand elsewhere now."""
    present = np.flatnonzero(rng.random(len(world)) >= level.missing)
    kept = world[present]
    moved = rng.random(len(kept)) < level.moved
    angle = rng.uniform(0.0, 2.0 * np.pi, len(kept))
    shift = np.zeros((len(kept), 3))
    shift[:, :2] = 8.0 * moved[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    noise = rng.normal(0.0, level.map_sigma_m, (2, len(kept), 3))
    mapped = Elements3D.from_ends(
        kept.id,
        kept.anchor_m + shift + noise[0],
        kept.end_m + shift + noise[1],
        kept.class_id,
        max(level.map_sigma_m, 1e-3),
    )
    return mapped, moved


def _observed(
    world: Elements3D, T_camera_map: Pose, level: Difficulty, rng: np.random.Generator
) -> tuple[Elements2D, IntArray]:
    """What the camera sees, and (m,) the ids of the elements; -1 for false detections."""
    anchor_c, end_c = T_camera_map.apply(world.anchor_m), T_camera_map.apply(world.end_m)
    depth = anchor_c[:, 2]
    recall = RECALL[world.class_id] * (1.0 - 0.4 * np.clip((depth - 20.0) / 20.0, 0.0, 1.0))
    found = (depth > 3.0) & (depth < 40.0) & (rng.random(len(world)) < recall)
    rows = np.flatnonzero(found)
    anchor, end = CAMERA.project(anchor_c[rows]), CAMERA.project(end_c[rows])
    line = world.is_line[rows]
    hidden = line & (rng.random(len(rows)) < level.hidden_bottoms)
    end = np.where(
        hidden[:, None], end + (anchor - end) * rng.uniform(0.15, 0.5, (len(rows), 1)), end
    )
    top, anchor_cut = _clip_rows(anchor, end)
    bottom, end_cut = _clip_rows(end, anchor)
    anchor, end = np.where(line[:, None], top, anchor), np.where(line[:, None], bottom, end)
    inside = CAMERA.contains(anchor) & (CAMERA.contains(end) | ~line)
    inside &= ~line | (np.linalg.norm(anchor - end, axis=1) > 15.0)
    clutter_anchor, clutter_end, clutter_class = _clutter(level, rng)
    noise = rng.normal(0.0, level.sigma_px, (2, int(inside.sum()), 2))
    m = int(inside.sum()) + len(clutter_class)
    grown = np.zeros(len(clutter_class), dtype=bool)
    line = np.concatenate([line[inside], clutter_class == POLE])
    observed = Elements2D(
        anchor_px=np.concatenate([anchor[inside] + noise[0], clutter_anchor]),
        end_px=np.concatenate([end[inside] + noise[1], clutter_end]),
        class_id=np.concatenate([world.class_id[rows][inside], clutter_class]),
        score=np.full(m, 0.9),
        sigma_px=np.full((m, 2), level.sigma_px),
        anchor_known=~(line & np.concatenate([anchor_cut[inside], grown])),
        end_known=line & ~np.concatenate([(end_cut | hidden)[inside], grown]),
    )
    return observed, np.append(world.id[rows][inside], np.full(len(clutter_class), -1))


def _clip_rows(point: FloatArray, other: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Points moved along the line to ``other`` until inside the image's top and bottom rows."""
    limit = np.clip(point[:, 1], 0.0, CAMERA.height - 1.0)
    cut = np.asarray(limit != point[:, 1]) & np.isfinite(point[:, 1])
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(cut, (limit - point[:, 1]) / (other[:, 1] - point[:, 1]), 0.0)
    return point + share[:, None] * (other - point), cut


def _clutter(
    level: Difficulty, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, IntArray]:
    count = int(rng.poisson(level.false_detections))
    class_id = np.where(rng.random(count) < 0.7, POLE, rng.integers(1, 4, count))
    anchor = rng.uniform([20.0, 10.0], [1220.0, 180.0], (count, 2))
    end = anchor + np.column_stack([rng.normal(0.0, 2.0, count), rng.uniform(40.0, 180.0, count)])
    end = np.where((class_id == POLE)[:, None], end, np.nan)
    return anchor, end, class_id.astype(np.int64)


def _prior(T_camera_map: Pose, level: Difficulty, rng: np.random.Generator) -> Prior:
    offset = rng.normal(0.0, level.gps_sigma_m, 2)
    if level.gps_offset_m is not None:
        offset *= level.gps_offset_m / np.linalg.norm(offset)
    height = rng.normal(0.0, 0.1)
    shake = Pose.from_rotvec(np.deg2rad(rng.normal(0.0, 0.5, 3)), np.zeros(3))
    up = shake.rotation @ T_camera_map.rotation[:, 2]
    return Prior(
        position_m=T_camera_map.inverse().translation + np.append(offset, height),
        horizontal_sigma_m=max(level.gps_sigma_m, 0.1),
        vertical_sigma_m=0.15,
        up_camera=up / np.linalg.norm(up) if level.with_gravity else None,
        up_sigma_rad=float(np.deg2rad(0.5)),
    )
