"""Upright candidate poses (x, y, z, heading) from two matches each, gated by the prior.

Three generators, for what two matches can tell:
- two-point: both slopes known; their heights give the camera's as well;
- height-range: the prior's height and one slope (or a pole's whole length) give one range;
- circle: neither gives a range (tops at the camera's height, cut off poles), so the arc from which
  both are seen under the right angle is walked in steps.
Planar geometry is in complex numbers: P1 - c = r1 e^(i t), P2 - c = r2 e^(i (t + d)).
"""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.frame import Prior
from semviz_core.solving.residuals import Scene
from semviz_core.solving.upright import UprightView

ComplexArray: TypeAlias = NDArray[np.complex128]

GATE_WIDER_M, GATE_WIDER_RAD, GATE_WIDER_HEIGHT_M = 3.5, float(np.deg2rad(8.0)), 0.5
"""Two matches place a camera with errors of their own: gates are wider than the prior by these."""
NEAREST_M, FARTHEST_M = 2.5, 60.0
SURE_RANGE_M = 1.0
"""A range with a smaller sigma is used as it is, a worse one only bounds the walk on the circle."""
CIRCLE_STEP_M = 2.0
MOST_PAIRS = 5_000
"""Pairs of matches tried for one image. Beyond, half of them are those of the observed elements
with the fewest candidates (signs), half a random part of the rest. True poses are hit by dozens of
pairs, so this costs no accuracy (bench/localize.py) and bounds the time."""


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """h candidate poses; the camera is upright."""

    position_m: FloatArray
    """(h, 3)"""
    heading_rad: FloatArray
    """(h,)"""

    def __len__(self) -> int:
        return len(self.heading_rad)


@dataclass(frozen=True, eq=False)
class _Matches:
    """k single matches that the prior allows."""

    seen: IntArray
    mapped: IntArray
    range_m: FloatArray
    range_sigma_m: FloatArray


def upright_hypotheses(
    scene: Scene, view: UprightView, prior: Prior, rng: np.random.Generator
) -> tuple[Hypotheses, int]:
    """Candidates that pass the gates, and how many were tried."""
    matches = _single_matches(scene, view, prior)
    first, second = _pairs(matches, rng)
    P, Q = _planar(scene, matches.mapped[first]), _planar(scene, matches.mapped[second])
    turn = view.azimuth_rad[matches.seen[second]] - view.azimuth_rad[matches.seen[first]]
    rows, r1, height = _ranges(scene, view, prior, matches, first, second, Q - P, turn)
    found: list[Hypotheses] = []
    for sign in (1.0, -1.0):
        with np.errstate(invalid="ignore"):
            root = np.sqrt(np.abs((Q - P)[rows]) ** 2 - (r1 * np.sin(turn[rows])) ** 2)
        r2 = r1 * np.cos(turn[rows]) + sign * root
        toward = np.angle((Q - P)[rows]) - np.angle(r2 * np.exp(1j * turn[rows]) - r1)
        place = P[rows] - r1 * np.exp(1j * toward)
        heading = toward - view.azimuth_rad[matches.seen[first[rows]]]
        other = second[rows]
        off = np.abs(r2 - matches.range_m[other])
        agrees = ~(off > 3.0 * matches.range_sigma_m[other] + 1.0)
        agrees &= (r2 > NEAREST_M) & (r2 < FARTHEST_M) & _allowed(prior, place, heading, height)
        position = np.stack([place.real, place.imag, height], axis=1)
        found.append(Hypotheses(position[agrees], heading[agrees]))
    together = Hypotheses(
        np.concatenate([one.position_m for one in found]),
        np.concatenate([one.heading_rad for one in found]),
    )
    return together, 2 * len(rows)


def _single_matches(scene: Scene, view: UprightView, prior: Prior) -> _Matches:
    """Class-consistent matches whose range the prior's position allows."""
    i, j = np.nonzero(scene.compatible)
    heights = np.stack([scene.anchor_m[j, 2], scene.end_m[j, 2]], axis=1)
    known = view.slope_known[i] & scene.mapped_known[j]
    slope = view.slope[i]
    sigma = np.hypot(view.sigma_rad[i, 1], view.up_sigma_rad)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (heights - prior.position_m[2]) / slope
        spread = np.sqrt(prior.vertical_sigma_m**2 + (reach * sigma) ** 2) / np.abs(slope)
        length = slope[:, 0] - slope[:, 1]
        whole = (heights[:, 0] - heights[:, 1]) / length
        whole_spread = np.abs(whole / length) * view.sigma_rad[i, 1] * 1.5 + 0.05
    reach = np.column_stack([reach, whole])
    spread = np.column_stack([spread, whole_spread])
    spread[~np.column_stack([known, known.all(axis=1)])] = np.inf
    spread[~np.isfinite(spread)] = np.inf
    best = spread.argmin(axis=1)[:, None]
    best_range = np.take_along_axis(reach, best, axis=1)[:, 0]
    best_sigma = np.take_along_axis(spread, best, axis=1)[:, 0]
    best_range = np.where(np.isfinite(best_sigma), best_range, 0.0)
    away = np.linalg.norm(scene.anchor_m[j, :2] - prior.position_m[:2], axis=1)
    slack = 3.0 * best_sigma
    allowed = np.abs(away - best_range) <= _position_gate(prior) + slack
    allowed &= (best_range + slack > NEAREST_M) & (best_range - slack < FARTHEST_M)
    return _Matches(i[allowed], j[allowed], best_range[allowed], best_sigma[allowed])


def _pairs(matches: _Matches, rng: np.random.Generator) -> tuple[IntArray, IntArray]:
    """Rows of two matches that share no element; the one with the better range comes first."""
    order = np.argsort(matches.range_sigma_m, kind="stable")
    a, b = np.triu_indices(len(order), 1)
    first, second = order[a], order[b]
    apart = (matches.seen[first] != matches.seen[second]) & (
        matches.mapped[first] != matches.mapped[second]
    )
    first, second = first[apart], second[apart]
    if len(first) > MOST_PAIRS:
        candidates = np.bincount(matches.seen)[matches.seen]
        likely = np.argsort(candidates[first] * candidates[second], kind="stable")
        rare, rest = likely[: MOST_PAIRS // 2], likely[MOST_PAIRS // 2 :]
        some = rng.choice(rest, MOST_PAIRS - len(rare), replace=False)
        kept = np.concatenate([rare, some])
        first, second = first[kept], second[kept]
    return first, second


def _ranges(
    scene: Scene,
    view: UprightView,
    prior: Prior,
    matches: _Matches,
    first: IntArray,
    second: IntArray,
    base: ComplexArray,
    turn: FloatArray,
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Ranges to try for the first match of pairs: rows of pairs, range, camera height."""
    sigma, reach = matches.range_sigma_m[first], matches.range_m[first]
    height = float(prior.position_m[2])
    sure = np.flatnonzero(sigma <= SURE_RANGE_M)
    parts = [(sure, reach[sure], np.full(len(sure), height))]
    for z in _two_point_heights(scene, view, matches, first, second, base, turn):
        slope = view.slope[matches.seen[first], 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            r1 = (scene.anchor_m[matches.mapped[first], 2] - z) / slope
        fits = np.abs(z - height) <= 3.0 * prior.vertical_sigma_m + GATE_WIDER_HEIGHT_M
        rows = np.flatnonzero(fits & (r1 > NEAREST_M) & (r1 < FARTHEST_M))
        parts.append((rows, r1[rows], z[rows]))
    unsure = np.flatnonzero(sigma > SURE_RANGE_M)
    for r1 in np.arange(NEAREST_M, FARTHEST_M, CIRCLE_STEP_M):
        rows = unsure[np.abs(r1 - reach[unsure]) <= 2.0 * sigma[unsure]]
        rows = rows[r1 * np.abs(np.sin(turn[rows])) <= np.abs(base[rows])]
        parts.append((rows, np.full(len(rows), r1), np.full(len(rows), height)))
    rows, r1, z = (np.concatenate(column) for column in zip(*parts, strict=True))
    return rows, r1, z


def _two_point_heights(
    scene: Scene,
    view: UprightView,
    matches: _Matches,
    first: IntArray,
    second: IntArray,
    base: ComplexArray,
    turn: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Camera heights (k,), (k,) from which both anchors have their slopes; NaN where none.

    Ranges are (H - z) / s, so |base|^2 = r1^2 + r2^2 - 2 r1 r2 cos(turn) is quadratic in z.
    """
    i, j = matches.seen, matches.mapped
    known = view.slope_known[i, 0] & scene.mapped_known[j, 0]
    s1, s2 = view.slope[i[first], 0], view.slope[i[second], 0]
    H1, H2 = scene.anchor_m[j[first], 2], scene.anchor_m[j[second], 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        a1, a2 = 1.0 / s1, 1.0 / s2
        # r1 = p1 - a1 z, r2 = p2 - a2 z
        p1, p2, c = H1 * a1, H2 * a2, np.cos(turn)
        A = a1**2 + a2**2 - 2.0 * a1 * a2 * c
        B = p1 * a1 + p2 * a2 - (p1 * a2 + p2 * a1) * c
        C = p1**2 + p2**2 - 2.0 * p1 * p2 * c - np.abs(base) ** 2
        root = np.sqrt(B**2 - A * C)
        usable = known[first] & known[second]
        return (
            np.where(usable, (B + root) / A, np.nan),
            np.where(usable, (B - root) / A, np.nan),
        )


def _planar(scene: Scene, rows: IntArray) -> ComplexArray:
    middle = 0.5 * (scene.anchor_m[rows] + scene.end_m[rows])
    return np.asarray(middle[:, 0] + 1j * middle[:, 1])


def _position_gate(prior: Prior) -> float:
    return 3.0 * prior.horizontal_sigma_m + GATE_WIDER_M


def _allowed(
    prior: Prior,
    place: ComplexArray,
    heading: FloatArray,
    height: FloatArray,
) -> BoolArray:
    center = prior.position_m[0] + 1j * prior.position_m[1]
    allowed = np.abs(place - center) <= _position_gate(prior)
    allowed &= (
        np.abs(height - prior.position_m[2]) <= 3.0 * prior.vertical_sigma_m + GATE_WIDER_HEIGHT_M
    )
    if prior.heading_rad is not None:
        off = np.angle(np.exp(1j * (heading - prior.heading_rad)))
        allowed &= np.abs(off) <= 3.0 * prior.heading_sigma_rad + GATE_WIDER_RAD
    return np.asarray(allowed)
