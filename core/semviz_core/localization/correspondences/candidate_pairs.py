"""A frame as a matcher's sample, and its candidate pairs: level view, distances, heading bins.

A sample is rays, map points around the prior, and in training the target. Coordinates are local:
the map frame's, around ``origin_m``.

Gravity is taken out first, as `upright` does for the search, by the poles and the prior. The
height of a mapped element over the road, seen under a slope, is a distance. Roads rise: with
the plane z = h + g.x of the driven path, a camera at x = p - d u sees the slope s = (z_p - h -
g.p) / d + g.u. So the distance depends on the direction u of the element, and thereby on the
heading, by as much as the road rises. For each heading bin a pair gives a camera position,
tested against fix and compass.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet, as_known
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, ComplexArray, FloatArray, IntArray, unit_vectors
from semviz_core.common.jit import compiled
from semviz_core.localization import upright
from semviz_core.localization.problem import perpendicular

PRIOR_LENGTH = 9
FIX_UNIT_M = 10.0
_ROAD_REACH_M = 15.0
_BRIDGE_M = 0.5
_LEVEL = np.diag([1e-3, 300.0, 300.0])  # weight of a level road, against that of one place driven
_EXACT_RAD = 1e-3  # smaller sigmas make no difference to a network


@dataclass(frozen=True, eq=False)
class SampleTarget:
    """The ground truth of a sample."""

    rotation: FloatArray
    """(3, 3) of T_camera_local, from the sample's coordinates to the camera's."""
    translation: FloatArray
    """(3,) of the same, metres."""
    pairs: BoolArray
    """(m, n) True if observed i is mapped j; several j if the map holds the element twice."""


@dataclass(frozen=True, eq=False)
class Sample:
    """m observed and n mapped elements in local coordinates: the map's, about ``origin_m``.

    Point elements have their anchor as bottom, so that nothing is NaN.
    """

    ray: FloatArray
    """(m, 3) unit, camera axes: peak or middle."""
    bottom_ray: FloatArray
    """(m, 3) unit: the given lower end of a pole."""
    sigma_rad: FloatArray
    """(m, 2) standard deviation across and along, as an angle."""
    score: FloatArray
    """(m,)"""
    seen_class: IntArray
    """(m,) number of the class in the class set, from 0."""
    seen_known: BoolArray
    """(m, 2) whether peak (or middle) and bottom are known."""
    point_m: FloatArray
    """(n, 3) peak or middle."""
    bottom_m: FloatArray
    """(n, 3)"""
    mapped_class: IntArray
    """(n,)"""
    mapped_known: BoolArray
    """(n, 2)"""
    road: FloatArray
    """(3,) plane through the cameras of the map's drive: its height (m) at the local origin, and
    its slopes along x and y."""
    prior: FloatArray
    """(PRIOR_LENGTH,) the prior, scaled to about 1: up in camera axes (3, zeros if
    unknown), log of its sigma over 0.01 rad, sigma of the fix in tens of metres, cosine and sine of
    the heading (zeros if unknown), log of its sigma over 0.1 rad, sigma of the height (m)."""
    origin_m: FloatArray
    """(3,) of the local coordinates in the map: the prior's position."""
    truth: SampleTarget | None = None

    @classmethod
    def of(
        cls,
        observed: Elements2D,
        submap: Elements3D,
        camera: Camera,
        prior: Prior,
        classes: ClassSet = DEFAULT_CLASSES,
    ) -> "Sample":
        """Return a frame without ground truth; other classes count as one of ``classes``."""
        number = {class_.id: row for row, class_ in enumerate(classes)}
        seen_line, mapped_line = observed.is_line[:, None], submap.is_line[:, None]
        origin = prior.position_m
        return cls(
            ray=camera.bearing(observed.anchor_px),
            bottom_ray=camera.bearing(np.where(seen_line, observed.end_px, observed.anchor_px)),
            sigma_rad=observed.sigma_px / float(np.sqrt(camera.K[0, 0] * camera.K[1, 1])),
            score=observed.score,
            seen_class=_numbers(observed, number, classes),
            seen_known=np.column_stack([observed.anchor_known, observed.end_known]),
            point_m=submap.anchor_m - origin,
            bottom_m=np.where(mapped_line, submap.end_m, submap.anchor_m) - origin,
            mapped_class=_numbers(submap, number, classes),
            mapped_known=np.column_stack([submap.anchor_known, submap.end_known]),
            road=_road_plane(prior),
            prior=_prior_numbers(prior),
            origin_m=origin,
        )

    def with_truth(self, T_camera_map: Pose, pairs: IntArray) -> "Sample":
        """Return the sample with ground truth; ``pairs`` (k, 2) are rows of observed and submap."""
        true = np.zeros((len(self.ray), len(self.point_m)), dtype=bool)
        true[tuple(np.asarray(pairs).reshape(-1, 2).T)] = True
        truth = SampleTarget(T_camera_map.rotation, T_camera_map.apply(self.origin_m), true)
        return replace(self, truth=truth)


def _numbers(
    elements: Elements2D | Elements3D, number: dict[int, int], classes: ClassSet
) -> IntArray:
    """Return the numbers (k,) of the classes of elements; see ``as_known``."""
    known = as_known(elements.class_id, elements.is_line, classes)
    return np.array([number[id] for id in known.tolist()], dtype=np.int64)


def _road_plane(prior: Prior) -> FloatArray:
    """Fit a plane to the road, weighted towards the fix; level without a road.

    The fit is reweighted (Cauchy), starting at a level plane through the fix, so that a bridge does
    not lift the street below it.
    """
    plane = np.zeros(3)
    if prior.road_m is None:
        return plane
    offset = prior.road_m - prior.position_m
    reach = max(_ROAD_REACH_M, prior.horizontal_sigma_m)
    near = np.exp(-0.25 * (offset[:, :2] ** 2).sum(axis=1) / reach**2)
    rows = np.column_stack([np.ones(len(offset)), offset[:, :2]])
    for _ in range(3):
        off = (offset[:, 2] - rows @ plane) / _BRIDGE_M
        weighted = (rows * (near / (1.0 + off**2))[:, None]).T
        plane = np.linalg.solve(weighted @ rows + _LEVEL, weighted @ offset[:, 2])
    return plane


def _prior_numbers(prior: Prior) -> FloatArray:
    numbers = np.zeros(PRIOR_LENGTH)
    if prior.up_camera is not None:
        numbers[:3] = prior.up_camera
        numbers[3] = np.log(max(prior.up_sigma_rad, _EXACT_RAD) / 0.01)
    numbers[4] = prior.horizontal_sigma_m / FIX_UNIT_M
    if prior.heading_rad is not None:
        numbers[5:7] = np.cos(prior.heading_rad), np.sin(prior.heading_rad)
        numbers[7] = np.log(max(prior.heading_sigma_rad, _EXACT_RAD) / 0.1)
    numbers[8] = prior.vertical_sigma_m
    return numbers


_LEAST_LENGTH = 1e-4  # of an observed line (rad); shorter ones are points
_PRIOR_RAD = 0.01  # unit of the sigma of up among the prior's numbers


class Level(NamedTuple):
    """m observed elements in the level frame: x is the horizontal optical axis, z is up."""

    direction: ComplexArray
    """(m,) unit x + iy towards the element; of a pole, towards its middle."""
    slope: FloatArray
    """(m, 2) tangents of the elevation of anchor and end."""
    up_sigma_rad: float


def level_view(sample: Sample) -> Level:
    """Return the observed elements in the level frame.

    Gravity follows from the prior, or a camera that looks about level, and the observed poles.
    """
    up, sigma = _up(sample)
    R = upright.level_rotation(up)
    anchor, end = sample.ray @ R.T, sample.bottom_ray @ R.T
    middle = (anchor + end)[:, :2]
    unit = unit_vectors(middle)
    slope = [ray[:, 2] / np.maximum(np.hypot(ray[:, 0], ray[:, 1]), 1e-3) for ray in (anchor, end)]
    return Level(unit[:, 0] + 1j * unit[:, 1], np.column_stack(slope), sigma)


def _up(sample: Sample) -> tuple[FloatArray, float]:
    """Return up (3,) in camera axes and its sigma.

    This fits the prior and the vertical vanishing point of the poles by least squares, reweighted
    (Cauchy) since false poles may lean by any angle.
    """
    start, information = _prior_up(sample)
    x, y = perpendicular(start)
    normal = np.cross(sample.ray, sample.bottom_ray)
    length = np.maximum(np.linalg.norm(normal, axis=1), 1e-9)
    normal = normal / length[:, None]
    line = length > _LEAST_LENGTH
    variance = 2.0 * np.square(sample.sigma_rad[:, 0] / length) + upright.POLE_LEAN_RAD**2
    off, by_x, by_y = normal @ start, normal @ x, normal @ y
    tilt_x = tilt_y = 0.0
    for _ in range(3):
        left = off + by_x * tilt_x + by_y * tilt_y
        weight = np.where(line, 1.0 / (variance + np.square(left / _CAUCHY_SIGMAS)), 0.0)
        a = float(weight @ np.square(by_x)) + information
        b = float(weight @ (by_x * by_y))
        d = float(weight @ np.square(by_y)) + information
        right_x, right_y = float(weight @ (by_x * off)), float(weight @ (by_y * off))
        determinant = a * d - b * b
        tilt_x = (b * right_y - d * right_x) / determinant
        tilt_y = (b * right_x - a * right_y) / determinant
    up = start + tilt_x * x + tilt_y * y
    return up / np.linalg.norm(up), math.sqrt(0.5 * (a + d) / determinant)


def _prior_up(sample: Sample) -> tuple[FloatArray, float]:
    """Return up (3,) and its information (1 / rad^2): the prior's, or the assumed one."""
    up = sample.prior[:3]
    if up @ up > 0.5:
        return up, float(_PRIOR_RAD * np.exp(sample.prior[3])) ** -2
    return upright.ASSUMED_UP, upright.ASSUMED_UP_SIGMA_RAD**-2


NEAREST_M, FARTHEST_M = 2.5, 42.0
_USUAL, _USUAL_SIGMA = 0.07, 0.05
"""Prior of 1 / distance (1 / m): mean and sigma."""
_CAUCHY_SIGMAS = 2.0  # poles that lean by more count less; as the matcher was trained
_HEIGHT_SIGMA_M = 0.15
"""Of the road's plane, the map and the vehicle's suspension together."""
_AGREEING = 3.0
"""Sigmas by which a bottom may differ from the anchor's distance; otherwise it is hidden or
wrong."""
_HIDDEN_SHARE, _HIDDEN_SLOPE = 0.4, 0.03
"""Sigma of a bottom without a known anchor: a share of its slope, and a constant."""
_MOST_SIGMAS = 5.0
_MOST_PAIR_FIX_SIGMAS = 2.5
_LEAST_HEIGHT_M = 0.3


class CandidatePairs(NamedTuple):
    """N pairs that the prior does not rule out, by observed, then by mapped element."""

    seen: IntArray  # (N,) row of the observed element
    mapped: IntArray  # (N,) row of the mapped element
    direction: ComplexArray  # (N,) unit: of the observed element in the level frame
    place_m: ComplexArray  # (N,) of the mapped element in the local frame
    nearness: FloatArray  # (N,) 1 / distance (1 / m), on a level road
    by_slope: FloatArray  # (N,) its derivative by the slope
    sigma_m: FloatArray  # (N,) of the distance
    wide_m: FloatArray  # (N,) the same if the direction in the map is unknown
    off: FloatArray  # (N, 2) residuals of the slopes of anchor and end in sigmas, 0 if unknown
    known: BoolArray  # (N, 2) slopes that are compared
    slope_sigma: FloatArray  # (N,)
    azimuth_sigma: FloatArray  # (N,)
    rise: complex  # gradient of the road
    fix_sigma_m: float


def candidate_pairs(sample: Sample, possible: BoolArray) -> CandidatePairs:
    """Return the pairs among ``possible`` (m, n), such as those of one class, whose slopes agree
    with a distance, and the distance with the fix."""
    seen, mapped = np.nonzero(possible)
    level, fix_sigma_m = level_view(sample), FIX_UNIT_M * float(sample.prior[4])
    anchor, end = sample.point_m[mapped], sample.bottom_m[mapped]
    place = 0.5 * (anchor + end)[:, :2]
    ground = sample.road[0] + place @ sample.road[1:]
    height = np.column_stack([anchor[:, 2], end[:, 2]]) - ground[:, None]
    variance = np.square(sample.sigma_rad[seen, 1]) + level.up_sigma_rad**2
    slope = level.slope[seen]
    known = sample.seen_known[seen] & sample.mapped_known[mapped]
    rise = complex(sample.road[1], sample.road[2])
    uphill = 0.5 * abs(rise) ** 2  # variance of g.u where u may be any
    near, near_sigma, by_slope = _nearness(height, slope, known, variance, uphill)
    cut = ~sample.seen_known[seen, 0] & sample.mapped_known[mapped, 0]
    least = np.where(cut, slope[:, 0] / np.maximum(height[:, 0], _LEAST_HEIGHT_M), 0.0)
    nearness = np.maximum(near, np.clip(least, 1.0 / FARTHEST_M, 0.25))
    nearness = np.minimum(nearness, 1.0 / NEAREST_M)
    distance = 1.0 / nearness
    sigma = np.minimum(near_sigma * np.square(distance), 0.5 * distance) + 0.1
    wide = np.hypot(sigma, math.sqrt(uphill) * np.abs(by_slope) * np.square(distance))
    wide = np.minimum(wide, 0.6 * distance)
    slope_sigma = np.sqrt(variance + uphill + np.square(_HEIGHT_SIGMA_M * nearness))
    off = known * (slope - height * nearness[:, None]) / slope_sigma[:, None]
    place_m = place[:, 0] + 1j * place[:, 1]
    beyond = (np.abs(np.abs(place_m) - distance) - _AGREEING * wide) / fix_sigma_m
    agree = (np.abs(off[:, 0]) < _MOST_SIGMAS) & (off[:, 1] > -_MOST_SIGMAS)
    kept = agree & (nearness - near < _AGREEING * near_sigma) & (beyond < _MOST_PAIR_FIX_SIGMAS)
    all_pairs = CandidatePairs(
        seen, mapped, level.direction[seen], place_m, nearness, by_slope, sigma, wide, off, known,
        slope_sigma, sample.sigma_rad[seen, 0], rise, fix_sigma_m,
    )  # fmt: skip
    columns: dict[str, Any] = {
        name: value[kept]
        for name, value in all_pairs._asdict().items()
        if isinstance(value, np.ndarray)
    }
    return all_pairs._replace(**columns)


def _nearness(
    height: FloatArray, slope: FloatArray, known: BoolArray, variance: FloatArray, uphill: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return 1 / distance (N,), its sigma, and its derivative by both slopes (1 / m).

    Fits slope = height x nearness at both ends (N, 2) by least squares, with a prior. A bottom
    counts if it agrees with the anchor, or if the anchor is unknown: half of the bottoms are
    hidden. ``variance`` (N,) is that of slopes, ``uphill`` that of the road's slope.
    """
    anchor, end = known.T
    prior_information = _USUAL_SIGMA**-2
    near = np.full_like(variance, _USUAL)
    for _ in range(2):
        slope_variance = variance + np.square(_HEIGHT_SIGMA_M * near)
        by_anchor = anchor * height[:, 0] / slope_variance
        information = prior_information + by_anchor * height[:, 0]
        first = (prior_information * _USUAL + by_anchor * slope[:, 0]) / information
        off = slope[:, 1] - height[:, 1] * first
        agrees = np.square(off) < _AGREEING**2 * (
            slope_variance + uphill + np.square(height[:, 1]) / information
        )
        hidden_variance = np.square(_HIDDEN_SHARE * slope[:, 1]) + _HIDDEN_SLOPE**2
        by_end = height[:, 1] / (slope_variance + np.where(anchor, 0.0, hidden_variance))
        by_end = np.where(end & (agrees | ~anchor), by_end, 0.0)
        information = information + by_end * height[:, 1]
        both = by_anchor * slope[:, 0] + by_end * slope[:, 1]
        mean = (prior_information * _USUAL + both) / information
        near = np.clip(mean, 0.5 / FARTHEST_M, 1.0 / NEAREST_M)
    return mean, 1.0 / np.sqrt(information), (by_anchor + by_end) / information


@compiled
def pair_distance_m(pairs: CandidatePairs, row: int, turn: complex) -> float:
    """Return the distance of the pair in ``row`` if ``turn``, a complex unit, turns the level
    frame into the local one."""
    uphill = (np.conj(pairs.rise) * pairs.direction[row] * turn).real
    nearness = pairs.nearness[row] - pairs.by_slope[row] * uphill
    return 1.0 / min(max(nearness, 1.0 / FARTHEST_M), 1.0 / NEAREST_M)


BINS = 36
"""Ten degrees each."""
BIN_RAD = 2.0 * math.pi / BINS
_MOST_BIN_FIX_SIGMAS = 3.0
_MOST_COMPASS_CHI2 = 14.0
_BIN_SIGMA_RAD = 0.05  # within a bin
_COMPASS_UNIT_RAD = 0.1  # of its sigma among the prior's numbers
USUAL_FIX_SIGMAS = 1.3
"""Typical distance of a fix from the truth, in sigmas."""


class Compass(NamedTuple):
    """The prior's heading."""

    known: bool
    heading_rad: float
    sigma_rad: float

    @classmethod
    def of(cls, sample: Sample) -> "Compass":
        x, y, log_sigma = sample.prior[5:8].tolist()
        known = x * x + y * y > 0.5
        return cls(known, math.atan2(y, x), _COMPASS_UNIT_RAD * math.exp(log_sigma))


@compiled
def compass_chi2(compass: Compass, heading_rad: float, variance: float) -> float:
    """Return chi2 of a heading with this variance (rad^2); 0 without a compass."""
    if not compass.known:
        return 0.0
    off = (heading_rad - compass.heading_rad + np.pi) % (2.0 * np.pi) - np.pi
    return off * off / (compass.sigma_rad**2 + variance)


class Bins(NamedTuple):
    """N pairs under each heading bin."""

    feature: FloatArray
    """(N, BINS, 3)"""
    possible: BoolArray
    """(N, BINS) True unless fix or compass rules it out."""


def in_bins(pairs: CandidatePairs, compass: Compass) -> Bins:
    """Return how far the camera is from the fix, and the heading from the compass, in each bin."""
    heading = np.arange(BINS) * BIN_RAD
    turned = pairs.direction[:, None] * np.exp(1j * heading)
    uphill = (np.conj(pairs.rise) * turned).real
    nearness = pairs.nearness[:, None] - pairs.by_slope[:, None] * uphill
    offset = turned / np.clip(nearness, 1.0 / FARTHEST_M, 1.0 / NEAREST_M)
    sigma = np.hypot(pairs.fix_sigma_m, pairs.sigma_m)
    from_fix = np.abs(pairs.place_m[:, None] - offset) / sigma[:, None]
    of_heading = [compass_chi2(compass, angle, _BIN_SIGMA_RAD**2) for angle in heading]
    chi2 = np.broadcast_to(np.array(of_heading), from_fix.shape)
    feature = [
        np.minimum(np.square(from_fix), _MOST_BIN_FIX_SIGMAS**2) / 3.0,
        np.clip(from_fix - USUAL_FIX_SIGMAS, -2.0, 2.0),
        np.minimum(chi2, _MOST_COMPASS_CHI2) / 5.0,
    ]
    possible = (from_fix < _MOST_BIN_FIX_SIGMAS) & (chi2 < _MOST_COMPASS_CHI2)
    return Bins(np.stack(feature, axis=2), possible)
