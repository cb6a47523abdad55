"""Localization problems with known poses: the elements of a road, as observed and as mapped.

The figures are those of the published error tables of the method and its map: recall and noise
per class, map sigmas. There are no images; the simulated street has them. Everything is drawn
from seeds: road elements and their mapping from (road, seed), and what one frame observes from
(seed, frame).
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Literal

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.classes import POLE
from semviz_core.base.detector_model import NOISE, RANGE_M, DetectorModel
from semviz_core.base.elements import Elements2D, Elements3D, joined
from semviz_core.base.frame import Prior
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray, unit_vectors
from semviz_core.datasets.priors import PriorOptions, simulate_prior
from semviz_core.research.evaluation.roads import (
    BenchmarkRoad,
    simulated_road,
    true_elements,
)
from semviz_core.simulation.detector import FADE, FADE_M, RECALL

CAMERA = Camera(
    1241, 376, np.array([[718.856, 0.0, 607.1928], [0.0, 718.856, 185.2157], [0.0, 0.0, 1.0]])
)
NEEDED_DETECTIONS = 4
"""Fewest detections of a valid frame."""
DETECTOR = DetectorModel(
    false_detections=0.5,
    recall_near=0.72,
    recall_far=0.43,
    near_m=20.0,
    far_m=40.0,
    reach_m=41.0,
    hidden_bottoms=0.5,
)
"""The true rates of the detections below, at the defaults of ``Difficulty``."""
_ROAD_M = 60.0  # of the road handed out with the prior
_LEAST_SIGMA_M = 1e-6  # of a map said to be perfect
_LEAST_LENGTH_PX = 15.0
_OFF_DRIVE_M, _WIDEST_VIEW = 2.0, 1.5
"""More than five sigmas beside the drive's pose, and more than half a view turned by as many."""


@dataclass(frozen=True)
class Difficulty:
    """How noisy a problem is; the defaults are the benchmark's low noise."""

    noise: Literal["paper", "low"] = "low"
    """The paper's table of detection errors, or 1 px and 0.3 deg."""
    sigma_px: float | None = None
    """Along both axes; replaces ``noise``."""
    stated_sigma_px: float | None = None
    """The detector's stated sigma, if it differs from the true one."""
    hidden_bottoms: float = 0.5
    """Share of poles whose bottom a car or hedge hides, unknown to the detector."""
    false_detections: float = 0.5
    """Mean number per image."""
    clutter_share: float = 0.0
    """Further false positives, relative to the true detections."""
    elements: int | None = None
    """Most detections, drawn from all."""
    recall: float | None = None
    """Share of elements detected; None: that of the paper's table, lower far off."""
    seen_within_m: float = RANGE_M[1]
    """Elements further away are not detected."""
    missing: float = 0.05
    """Share of elements not in the map."""
    duplicated: float = 0.03
    """Share of elements mapped twice, the second time with three times the noise."""
    moved: float = 0.05
    """Share of elements that were 8 m elsewhere when the map was made."""
    map_view_sigma_m: float = 0.10
    """Of the map, along the view from which it was made."""
    map_sigma_m: float = 0.02
    """Across that view and vertically."""
    map_turn_rad: float = float(np.deg2rad(0.27))
    """Of a mapped pole's direction."""
    gps_distance_m: tuple[float, float] = (5.0, 10.0)
    """Limits of the fix's distance from the truth, in any direction."""
    stated_gps_sigma_m: float | None = None
    """The fix's stated sigma, if it differs from the true one."""
    with_gravity: bool = True
    heading_sigma_rad: float | None = None
    """None: the heading is unknown."""
    vertical_sigma_m: float = 0.06
    """Of the camera's height above the road: the vehicle's 0.03, and the road between places."""
    crop_m: float = 50.0
    turned: bool = False
    """The map is turned about the vertical by any angle."""


HARD_SETS = {
    "noise 3 px": Difficulty(sigma_px=3.0),
    "noise 3 px unstated": Difficulty(sigma_px=3.0, stated_sigma_px=1.0),
    "clutter 100 %": Difficulty(clutter_share=1.0),
    "4 elements": Difficulty(elements=4),
    "5 elements": Difficulty(elements=5),
    "map 20 % wrong": Difficulty(moved=0.2),
    "all together": Difficulty(sigma_px=3.0, clutter_share=1.0, moved=0.2),
    "GPS 20 m": Difficulty(gps_distance_m=(20.0, 20.0)),
    "GPS 30 m": Difficulty(gps_distance_m=(30.0, 30.0)),
    "GPS 50 m": Difficulty(gps_distance_m=(50.0, 50.0), crop_m=90.0),
    "no attitude": Difficulty(with_gravity=False),
    "heading 15 deg": Difficulty(heading_sigma_rad=float(np.deg2rad(7.5))),
}
"""Each differs from the default as its name states. A heading within 15 deg has sigma 7.5 deg."""

PAPER_20M = Difficulty(
    false_detections=0.0,
    recall=1.0,
    seen_within_m=20.0,
    missing=0.0,
    moved=0.0,
    gps_distance_m=(0.0, 5.0),
    crop_m=20.0,
    turned=True,
)
"""The paper's own protocol. Elements are as labelled, and all of them are mapped, since its map is
made from the labels; some are twice, as it reports."""


@dataclass(frozen=True, eq=False)
class LocalizationProblem:
    """The input of a method, and the ground truth."""

    observed: Elements2D
    submap: Elements3D
    camera: Camera
    prior: Prior
    T_camera_map: Pose
    """Ground truth."""
    pairs: IntArray
    """(k, 2) true pairs (row of observed, row of submap), moved elements left out."""
    end_visible: BoolArray
    """(m,) True if a pole's given bottom is its true bottom."""

    @property
    def is_valid(self) -> bool:
        return len(self.observed) >= NEEDED_DETECTIONS


def valid_problems(
    roads: Sequence[BenchmarkRoad], level: Difficulty, seed: int
) -> Iterator[LocalizationProblem]:
    """Yield the valid problems of the seeds from ``seed`` on, endlessly, on alternating roads."""
    for number in itertools.count(seed):
        problem = make_problem(number, level, roads[number % len(roads)])
        if problem.is_valid:
            yield problem


def make_problem(
    seed: int,
    difficulty: Difficulty | None = None,
    road: BenchmarkRoad | None = None,
    index: int | None = None,
    *,
    driving: bool = False,
    variant: int | None = None,
    added: Elements3D | None = None,
) -> LocalizationProblem:
    """Return a frame on a road with observations and submap; repeatable by seed.

    ``road`` is by default a simulated one, ``index`` a random frame of its drive. With ``driving``,
    the camera has the same offset from the road's pose in all frames of the seed, so that it does
    not jump. ``variant`` draws another frame at the same position, by number. ``added`` elements,
    with their own ids, are mapped without error.
    """
    level = difficulty or Difficulty()
    road = road or default_road()
    if index is None:
        index = int(np.random.default_rng([seed, 0]).integers(len(road)))
    rng = np.random.default_rng([seed, 1, index] if variant is None else [seed, 1, index, variant])
    world, mapped = true_elements(road, seed), _mapped(road, seed, _in_the_map(level))
    if added is not None:
        moved = np.append(mapped.moved, np.zeros(len(added), dtype=bool))
        world, mapped = joined(world, added), _Mapped(joined(mapped.elements, added), moved)
    pose_rng = np.random.default_rng([seed, 6]) if driving else rng
    T_camera_map = _query(road.T_map_camera[index], pose_rng)
    prior = _prior(road, T_camera_map, level, rng)
    observed, ids, end_visible = _observed(world, T_camera_map, level, rng)
    distance = np.linalg.norm(mapped.elements.anchor_m[:, :2] - prior.position_m[:2], axis=1)
    rows = np.flatnonzero(distance <= level.crop_m)
    submap = mapped.elements[rows]
    trusted = np.where(mapped.moved[rows], -2, submap.id)  # -1 is a false detection
    pairs = np.argwhere(ids[:, None] == trusted[None, :])
    problem = LocalizationProblem(observed, submap, CAMERA, prior, T_camera_map, pairs, end_visible)
    return _turned(problem, rng.uniform(-np.pi, np.pi)) if level.turned else problem


def _turned(problem: LocalizationProblem, angle_rad: float) -> LocalizationProblem:
    """Return the problem with its map, and what is known in it, turned about the vertical."""
    T_turned_map = Pose.from_rotvec([0.0, 0.0, angle_rad], np.zeros(3))
    prior = problem.prior
    heading_rad = None if prior.heading_rad is None else prior.heading_rad + angle_rad
    road_m = None if prior.road_m is None else T_turned_map.apply(prior.road_m)
    position_m = T_turned_map.apply(prior.position_m)
    return replace(
        problem,
        submap=problem.submap.transformed(T_turned_map),
        prior=replace(prior, position_m=position_m, heading_rad=heading_rad, road_m=road_m),
        T_camera_map=problem.T_camera_map @ T_turned_map.inverse(),
    )


def may_be_valid(road: BenchmarkRoad, seed: int, index: int, level: Difficulty) -> bool:
    """Return False if ``make_problem`` surely shows too few elements there; fast."""
    if level.false_detections or level.clutter_share:
        return True
    x, _, z = road.T_map_camera[index].inverse().apply(true_elements(road, seed).anchor_m).T
    near = (np.hypot(x, z) < level.seen_within_m + _OFF_DRIVE_M) & (
        np.abs(x) < _WIDEST_VIEW * z + _OFF_DRIVE_M
    )
    return int(near.sum()) >= NEEDED_DETECTIONS


def mapped_elements(
    road: BenchmarkRoad, seed: int, difficulty: Difficulty | None = None
) -> Elements3D:
    """Return the whole map of which the problems of this road and seed hold submaps."""
    return _mapped(road, seed, _in_the_map(difficulty or Difficulty())).elements


def _in_the_map(level: Difficulty) -> Difficulty:
    """Return ``level`` with only the fields that affect the map, so that problems share it."""
    names = ("missing", "duplicated", "moved", "map_view_sigma_m", "map_sigma_m", "map_turn_rad")
    return Difficulty(**{name: getattr(level, name) for name in names})


@dataclass(frozen=True, eq=False)
class _Mapped:
    elements: Elements3D
    moved: BoolArray


@lru_cache(maxsize=1)
def default_road() -> BenchmarkRoad:
    """Return the default road of problems."""
    return simulated_road(0)


@lru_cache(maxsize=4)
def _mapped(road: BenchmarkRoad, seed: int, level: Difficulty) -> _Mapped:
    """Return the map of the world with errors, and which of its elements have moved since."""
    rng = np.random.default_rng([seed, 3])
    world = true_elements(road, seed)
    n, p = len(world), len(road.poles_m)
    drawn = rng.random((3, n))
    moved = drawn[1] < level.moved
    twice = np.flatnonzero(drawn[2] < level.duplicated)
    rows = np.concatenate([np.arange(n), twice])
    noise = np.concatenate([np.ones(n), np.full(len(twice), 3.0)])
    angle = rng.uniform(0.0, 2.0 * np.pi, n)
    shift = 8.0 * moved[:, None] * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(n)])
    covariance = _map_covariance(world, road.mapping_view[world.id % p], level)[rows]
    covariance *= noise[:, None, None] ** 2
    factor = np.linalg.cholesky(covariance + 1e-12 * np.eye(6))
    error = (factor @ rng.standard_normal((len(rows), 6, 1)))[..., 0]
    elements = Elements3D(
        id=np.concatenate([world.id, 2 * p + world.id[twice]]),
        anchor_m=world.anchor_m[rows] + shift[rows] + error[:, :3],
        end_m=world.end_m[rows] + shift[rows] + error[:, 3:],
        class_id=world.class_id[rows],
        covariance_m2=covariance,
        anchor_known=world.anchor_known[rows],
        end_known=world.end_known[rows],
    )
    kept = (drawn[0] >= level.missing)[rows]
    return _Mapped(elements[kept], moved[rows][kept])


def _map_covariance(world: Elements3D, view: FloatArray, level: Difficulty) -> FloatArray:
    """Return (n, 6, 6) of anchor and end: the anchor's error moves both, a turn only the end."""
    n, line = len(world), world.is_line
    across, along = max(level.map_sigma_m, _LEAST_SIGMA_M), level.map_view_sigma_m
    view3 = np.column_stack([view, np.zeros(n)])
    more = max(along**2 - across**2, 0.0)
    anchor = across**2 * np.eye(3) + more * view3[:, :, None] * view3[:, None, :]
    length = np.where(line, np.linalg.norm(world.anchor_m - world.end_m, axis=1), 0.0)
    turned = (level.map_turn_rad * length)[:, None] ** 2 * [1.0, 1.0, 0.0] + [0.0, 0.0, across**2]
    covariance = np.zeros((n, 6, 6))
    covariance[:, :3, :3] = anchor
    covariance[line, :3, 3:] = covariance[line, 3:, :3] = anchor[line]
    covariance[line, 3:, 3:] = anchor[line] + turned[line, :, None] * np.eye(3)
    return covariance


def _query(T_map_camera: Pose, rng: np.random.Generator) -> Pose:
    """Draw T_camera_map near the drive's pose: offset in the lane and in height, and turned."""
    lateral, height = rng.normal(0.0, [0.3, 0.03])
    turn = np.deg2rad(rng.normal(0.0, [0.5, 3.0, 0.5]))  # pitch, yaw, roll about x, y, z
    return (T_map_camera @ Pose.from_rotvec(turn, [lateral, height, 0.0])).inverse()


def _prior(
    road: BenchmarkRoad, T_camera_map: Pose, level: Difficulty, rng: np.random.Generator
) -> Prior:
    options = PriorOptions(
        distance_m=level.gps_distance_m,
        heading_sigma_rad=level.heading_sigma_rad,
        imu_sigma_rad=PriorOptions().imu_sigma_rad if level.with_gravity else None,
        vertical_sigma_m=level.vertical_sigma_m,
    )
    simulated = simulate_prior(T_camera_map.inverse(), options, int(rng.integers(2**63)))
    fix_m = simulated.position_m
    values = {field.name: getattr(simulated, field.name) for field in fields(Prior)}
    values["position_m"] = np.array([fix_m[0], fix_m[1], road.height(fix_m)])
    values["road_m"] = road.near(fix_m, _ROAD_M + level.gps_distance_m[1])
    if level.stated_gps_sigma_m is not None:
        values["horizontal_sigma_m"] = level.stated_gps_sigma_m
    return Prior(**values)


def _observed(
    world: Elements3D, T_camera_map: Pose, level: Difficulty, rng: np.random.Generator
) -> tuple[Elements2D, IntArray, BoolArray]:
    """Return the detections, their ids (m,), -1 for false positives, and ``end_visible`` (m,).

    Random numbers are drawn for every element, seen or not, so that levels share them.
    """
    n = len(world)
    chance, hiding, share = rng.random(n), rng.random(n), rng.uniform(0.5, 0.85, n)
    noise = rng.standard_normal((n, 2, 2))
    place_m = T_camera_map.apply(world.anchor_m)
    depth = place_m[:, 2]
    seen = (depth > RANGE_M[0]) & (depth < RANGE_M[1])
    if level.seen_within_m < RANGE_M[1]:
        seen &= np.linalg.norm(place_m, axis=1) < level.seen_within_m
    rows = np.flatnonzero(seen & (chance < _recall(world, depth, level)))
    hidden = (hiding < level.hidden_bottoms)[rows]
    true, visible = _projected(world[rows], T_camera_map, np.where(hidden, share[rows], 1.0))
    true = _disturbed(true[visible], noise[rows][visible], level)
    ids, hidden = world.id[rows][visible], hidden[visible]
    count = int(rng.poisson(level.false_detections + level.clutter_share * len(true)))
    observed = joined(true, _false(count, level, rng)) if count else true
    ids = np.append(ids, np.full(count, -1))
    end_visible = observed.end_known & ~np.append(hidden, np.ones(count, dtype=bool))
    if level.elements is not None and len(observed) > level.elements:
        kept = np.sort(rng.choice(len(observed), level.elements, replace=False))
        return observed[kept], ids[kept], end_visible[kept]
    return observed, ids, end_visible


def _recall(world: Elements3D, depth_m: FloatArray, level: Difficulty) -> FloatArray:
    """Return the chance (n,) of each element to be detected."""
    if level.recall is not None:
        return np.full(len(world), level.recall)
    recall = np.array([RECALL[class_] for class_ in range(4)])[world.class_id]
    return np.asarray(recall * (1.0 - FADE * np.interp(depth_m, FADE_M, (0.0, 1.0))))


def _projected(
    elements: Elements3D, T_camera_map: Pose, shown: FloatArray
) -> tuple[Elements2D, BoolArray]:
    """Return elements without noise, poles shown down to a share of their length and clipped to the
    image; and which of them are in the image."""
    line = elements.is_line
    end_m = elements.anchor_m + shown[:, None] * (elements.end_m - elements.anchor_m)
    anchor = CAMERA.project(T_camera_map.apply(elements.anchor_m))
    end = CAMERA.project(T_camera_map.apply(end_m))
    top, top_cut = _clipped(anchor, end)
    bottom, bottom_cut = _clipped(end, anchor)
    top, bottom = np.where(line[:, None], top, anchor), np.where(line[:, None], bottom, np.nan)
    visible = CAMERA.contains(top) & (CAMERA.contains(bottom) | ~line)
    visible &= ~line | (np.linalg.norm(top - bottom, axis=1) > _LEAST_LENGTH_PX)
    m = len(elements)
    seen = Elements2D(
        anchor_px=np.where(visible[:, None], top, 0.0),
        end_px=np.where((visible & line)[:, None], bottom, np.nan),
        class_id=elements.class_id,
        score=np.full(m, 0.9),
        sigma_px=np.ones((m, 2)),
        anchor_known=~(line & top_cut),
        end_known=visible & line & ~bottom_cut,
    )
    return seen, visible


def _clipped(point: FloatArray, other: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Move points along the line to ``other`` until inside the image's top and bottom rows."""
    limit = np.clip(point[:, 1], 0.0, CAMERA.height - 1.0)
    cut = np.asarray(limit != point[:, 1]) & np.isfinite(point[:, 1])
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(cut, (limit - point[:, 1]) / (other[:, 1] - point[:, 1]), 0.0)
    return point + share[:, None] * (other - point), cut


def _disturbed(true: Elements2D, noise: FloatArray, level: Difficulty) -> Elements2D:
    """Return the detections with noise (m, 2 ends, across and along or u and v) and their sigma.

    Ends that are cut off get noise too.
    """
    sigma = _sigma_px(true, level)
    down = np.tile([0.0, 1.0], (len(true), 1))
    line = true.is_line
    axis = true.end_px[line] - true.anchor_px[line]
    down[line] = unit_vectors(axis)
    across = np.stack([down[:, 1], -down[:, 0]], axis=1)
    offset = noise[:, :, :1] * (sigma[:, :1] * across)[:, None]
    offset = offset + noise[:, :, 1:] * (sigma[:, 1:] * down)[:, None]
    stated = sigma
    if level.stated_sigma_px is not None:
        stated = np.full_like(sigma, level.stated_sigma_px)
    return Elements2D(
        true.anchor_px + offset[:, 0],
        true.end_px + offset[:, 1],
        true.class_id,
        true.score,
        stated,
        true.anchor_known,
        true.end_known,
    )


def _sigma_px(true: Elements2D, level: Difficulty) -> FloatArray:
    """Return sigmas (m, 2) across and along. Both ends of a pole are drawn independently, each with
    the lateral error and the error of the angle at half the length."""
    if level.sigma_px is not None:
        return np.full((len(true), 2), level.sigma_px)
    table = NOISE[level.noise]
    line = true.is_line
    sign = np.array([table.sign_px.get(id, 1.0) for id in true.class_id.tolist()])
    half = np.zeros(len(true))
    half[line] = 0.5 * np.linalg.norm(true.end_px[line] - true.anchor_px[line], axis=1)
    across = np.hypot(table.pole_across_px, np.tan(table.pole_angle_rad) * half)
    along = np.full(len(true), table.pole_along_px)
    return np.where(line[:, None], np.stack([across, along], axis=1), sign[:, None])


def _false(count: int, level: Difficulty, rng: np.random.Generator) -> Elements2D:
    """Draw false positives, 70 % of them poles."""
    class_id = np.where(rng.random(count) < 0.7, POLE, rng.integers(1, 4, count))
    anchor = rng.uniform([20.0, 10.0], [1220.0, 180.0], (count, 2))
    end = anchor + np.column_stack([rng.normal(0.0, 2.0, count), rng.uniform(40.0, 180.0, count)])
    end = np.where((class_id == POLE)[:, None], end, np.nan)
    false = Elements2D.from_ends(anchor, end, class_id)
    sigma = _sigma_px(false, level)
    if level.stated_sigma_px is not None:
        sigma = np.full_like(sigma, level.stated_sigma_px)
    return replace(false, score=rng.uniform(0.3, 0.8, count), sigma_px=sigma)
