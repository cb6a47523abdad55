"""A simulated city and the maps that drives through it make, each with poses of its own errors.

No images: a drive maps the elements beside its way with noise that its covariances state, misses
some, invents some, and all of it is moved by errors of its poses that vary slowly along the way.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from semviz_core.base.classes import POLE, ROUNDED
from semviz_core.base.elements import Elements3D
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.common.arrays import FloatArray, IntArray

BLOCK_M, SIDE_M = 200.0, 7.0
SEEN_M, RECALL, FALSE_SHARE = 25.0, 0.85, 0.03
FRAME = MapFrame("city")


@dataclass(frozen=True)
class Drift:
    """Errors of poses: sigmas, and the length over which they are alike."""

    sigma_m: float = 0.3
    sigma_rad: float = float(np.deg2rad(0.2))
    length_m: float = 100.0


@dataclass(frozen=True, eq=False)
class CityDrive:
    """A map of a drive, and what it measures."""

    semantic_map: SemanticMap
    true_row: IntArray
    """(n,) row of each element in the city; -1 for those that it invents."""


def city(blocks: int, seed: int) -> Elements3D:
    """Return poles and signs beside the streets of ``blocks`` by ``blocks`` blocks: a fifth of them
    stand in pairs 1 to 2.5 m apart."""
    rng = np.random.default_rng(seed)
    length_m = blocks * BLOCK_M
    places = []
    for line in range(blocks + 1):
        for side in (-SIDE_M, SIDE_M):
            along = np.cumsum(4.0 + rng.exponential(16.0, int(length_m / 12.0)))
            along = along[along < length_m]
            twin = rng.random(len(along)) < 0.1
            along = np.sort(np.append(along, along[twin] + rng.uniform(1.0, 2.5, twin.sum())))
            across = line * BLOCK_M + side + rng.normal(0.0, 0.5, len(along))
            places.append(np.column_stack([along, across]))
            places.append(np.column_stack([across, along]))
    at_m = np.concatenate(places)
    is_pole = rng.random(len(at_m)) < 0.7
    bottom = np.column_stack([at_m, 0.01 * at_m[:, 0]])
    top = bottom + np.column_stack([np.zeros((len(at_m), 2)), rng.uniform(2.5, 8.0, len(at_m))])
    end = np.where(is_pole[:, None], bottom, np.nan)
    kind = np.where(is_pole, POLE, ROUNDED)
    return Elements3D.from_ends(np.arange(1, len(at_m) + 1), top, end, kind)


def random_way(blocks: int, length_m: float, seed: int) -> FloatArray:
    """Return points (p, 3), 1 m apart, along random streets without turning back."""
    rng = np.random.default_rng(seed)
    corner, before = rng.integers(0, blocks + 1, 2), np.zeros(2, np.int64)
    corners = [corner]
    while (len(corners) - 1) * BLOCK_M < length_m:
        steps = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
        inside = ((corner + steps >= 0) & (corner + steps <= blocks)).all(axis=1)
        steps = steps[inside & (steps != -before).any(axis=1)]
        before = steps[rng.integers(len(steps))]
        corner = corner + before
        corners.append(corner)
    parts = [
        BLOCK_M * (a + np.linspace(0.0, 1.0, int(BLOCK_M), endpoint=False)[:, None] * (b - a))
        for a, b in pairwise(corners)
    ]
    at_m = np.concatenate(parts)[: int(length_m)]
    return np.column_stack([at_m, 0.01 * at_m[:, 0] + 1.6])


def drive(truth: Elements3D, way_m: FloatArray, drift: Drift, seed: int) -> CityDrive:
    """Return the map of a drive along ``way_m`` (p, 3), points 1 m apart."""
    rng = np.random.default_rng(seed)
    seen, along = _seen(truth, way_m, rng)
    errors = pose_errors(len(way_m), drift, rng)
    true_row = np.concatenate([seen, np.full(round(FALSE_SHARE * len(seen)), -1)])
    invented = rng.integers(0, len(seen), len(true_row) - len(seen))
    rows, along = np.append(seen, seen[invented]), np.append(along, along[invented])
    shift = np.zeros((len(rows), 3))
    shift[len(seen) :, :2] = rng.uniform(-8.0, 8.0, (len(invented), 2))
    sigma_m = np.exp(rng.uniform(np.log(0.03), np.log(0.2), len(rows)))
    ends = [
        _moved(points[rows] + shift, way_m[along], errors[along])
        + rng.normal(0.0, 1.0, (len(rows), 3)) * sigma_m[:, None]
        for points in (truth.anchor_m, truth.end_m)
    ]
    is_line = truth.is_line[rows]
    covariance = np.zeros((len(rows), 6, 6))
    covariance[:, range(3), range(3)] = sigma_m[:, None] ** 2
    covariance[:, range(3, 6), range(3, 6)] = (is_line * sigma_m**2)[:, None]
    elements = Elements3D(
        np.arange(1, len(rows) + 1),
        ends[0],
        ends[1],
        truth.class_id[rows],
        covariance,
        np.ones(len(rows), bool),
        is_line,
    )
    measured_way = _moved(way_m, way_m, errors)
    return CityDrive(SemanticMap(elements, FRAME, trajectory_m=measured_way), true_row)


def _seen(
    truth: Elements3D, way_m: FloatArray, rng: np.random.Generator
) -> tuple[IntArray, IntArray]:
    """Return rows of the elements that a drive maps, and the nearest point of its way to each."""
    from scipy.spatial import cKDTree

    distance_m, along = cKDTree(way_m[:, :2]).query(truth.anchor_m[:, :2])
    seen = np.flatnonzero((distance_m < SEEN_M) & (rng.random(len(truth)) < RECALL))
    return seen, np.asarray(along[seen], np.int64)


def pose_errors(count: int, drift: Drift, rng: np.random.Generator) -> FloatArray:
    """Return the errors (count, 4) of poses 1 m apart: x, y, z (m), heading (rad).

    They vary smoothly, as poses do that odometry carries: a Matern 3/2 process.
    """
    from scipy.signal import lfilter

    kept = np.exp(-np.sqrt(3.0) / drift.length_m)
    before = int(10.0 * drift.length_m)
    noise = rng.normal(0.0, 1.0, (before + count, 4))
    for _ in range(2):
        noise = lfilter([1.0], [1.0, -kept], noise, axis=0)
    scale = np.sqrt((1.0 + kept**2) / (1.0 - kept**2) ** 3)
    return np.asarray(noise[before:] / scale * [*[drift.sigma_m] * 3, drift.sigma_rad])


def _moved(points_m: FloatArray, around_m: FloatArray, errors: FloatArray) -> FloatArray:
    """Return points (n, 3) as a drive at ``around_m`` (n, 3) with ``errors`` (n, 4) maps them."""
    arm = points_m - around_m
    turned = np.column_stack([-arm[:, 1], arm[:, 0], np.zeros(len(arm))])
    return np.asarray(points_m + errors[:, :3] + errors[:, 3:] * turned)
