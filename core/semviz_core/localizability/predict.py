"""Predict the localization error and status at every position of a route.

No formula predicts how often two positions are confused: that depends on chance, on missed, false
and hidden detections, and on the localizer's own limits. So simulated frames at each pose are
localized by the real localizer. Stretches summarize the route by means, and sigmas by medians.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.elements import Elements3D
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.priors import simulate_prior
from semviz_core.localizability.expected_error import (
    LOST_M,
    Effect,
    critical_elements,
    expected_error,
    suggest_elements,
)
from semviz_core.localizability.route import Conditions, candidates_beside, detect, distance_along
from semviz_core.localization.localizer import Localizer

_LEAST_VARIANCE_M2 = 1e-12  # of a map without errors; its covariance has no factor


class OutcomeShares(NamedTuple):
    """Shares of the simulated frames at one pose, by status."""

    ok: float
    ambiguous: float
    """Includes frames with status ``ok`` that are LOST_M off or more."""
    cannot: float


def simulate_localization(
    semantic_map: SemanticMap,
    camera: Camera,
    T_map_camera: Pose,
    conditions: Conditions,
    number: int,
) -> OutcomeShares:
    """Localize ``conditions.trials`` simulated frames at one pose; return the status shares.

    The true elements are drawn from the map's covariances, so the map has the errors it states.
    """
    localizer = Localizer(classes=semantic_map.classes, detector=conditions.detector)
    nearby = semantic_map.crop(T_map_camera.translation, conditions.crop_radius_m)
    counts = dict.fromkeys(OutcomeShares._fields, 0)
    for trial in range(conditions.trials):
        rng = np.random.default_rng([conditions.seed, number, trial])
        observed = detect(
            _true_elements(nearby, rng), camera, T_map_camera.inverse(), conditions, rng
        )
        prior = simulate_prior(T_map_camera, conditions.prior, int(rng.integers(2**63)))
        road_m = semantic_map.road_near(prior.position_m, conditions.road_radius_m)
        submap = semantic_map.crop(prior.position_m, conditions.crop_radius_m)
        localization = localizer.localize(observed, submap, camera, replace(prior, road_m=road_m))
        counts[_outcome(localization, T_map_camera)] += 1
    return OutcomeShares(*(count / conditions.trials for count in counts.values()))


def _true_elements(mapped: Elements3D, rng: np.random.Generator) -> Elements3D:
    """Return true elements drawn from the covariances of the mapped ones."""
    factor = np.linalg.cholesky(mapped.covariance_m2 + _LEAST_VARIANCE_M2 * np.eye(6))
    offset = np.einsum("nij,nj->ni", factor, rng.standard_normal((len(mapped), 6)))
    return replace(
        mapped, anchor_m=mapped.anchor_m + offset[:, :3], end_m=mapped.end_m + offset[:, 3:]
    )


def _outcome(localization: Localization, T_map_camera: Pose) -> str:
    if localization.status != "ok" or localization.T_camera_map is None:
        return localization.status
    center = localization.T_camera_map.inverse().translation
    error_m = np.linalg.norm(center - T_map_camera.translation)
    return "ok" if error_m < LOST_M else "ambiguous"


STRETCH_M = 20.0
NEARBY_M = 5.0
"""Draws are averaged over positions within this distance along the route, since these see nearly
the same elements."""
EFFECTS = 3
"""Number of suggested elements, and of critical ones."""
LIMITS_M = (0.1, 0.2, 0.4, 0.7)
"""Limits between the levels in which the expected error is shown; the same for all maps."""

RouteProgress = Callable[[Iterable[Pose], str, int], Iterable[Pose]]
"""Yields the poses it is given; also gets what is done with them and their number, to show it."""


@dataclass(frozen=True, eq=False)
class Localizability:
    """The predicted accuracy of single frames at k positions along a route."""

    T_map_camera: tuple[Pose, ...]
    along_m: FloatArray
    """(k,) metres driven up to each position."""
    found: FloatArray
    """(k,) mean number of mapped elements that a detector finds."""
    sigma_m: FloatArray
    """(k,) sigma of the camera centre: median over detection outcomes, inf if most give no pose."""
    sigma_deg: FloatArray
    """(k,) sigma of the heading, likewise."""
    expected_m: FloatArray
    """(k,) mean sigma of the camera centre over detection outcomes, each at most LOST_M, also
    without a pose."""
    lost: FloatArray
    """(k,) share of outcomes with too few elements for a pose."""
    ambiguous: FloatArray
    """(k,) share of frames with status ``ambiguous``, or ``ok`` and LOST_M off or more."""
    suggested: tuple[Effect, ...]
    """New elements that would help most, each given the previous ones."""
    critical: tuple[Effect, ...]
    """Mapped elements whose loss would cost most."""

    def stretches(self) -> "tuple[Stretch, ...]":
        """Return the route in stretches of STRETCH_M, worst first."""
        piece = (self.along_m // STRETCH_M).astype(np.int64)
        stretches = [
            self._stretch(np.flatnonzero(piece == stretch)) for stretch in np.unique(piece)
        ]
        return tuple(sorted(stretches, key=lambda stretch: (-stretch.badness_m, stretch.first_m)))

    def _stretch(self, rows: IntArray) -> "Stretch":
        return Stretch(
            first=int(rows[0]),
            last=int(rows[-1]),
            first_m=float(self.along_m[rows[0]]),
            last_m=float(self.along_m[rows[-1]]),
            found=float(self.found[rows].mean()),
            sigma_m=float(np.median(self.sigma_m[rows])),
            sigma_deg=float(np.median(self.sigma_deg[rows])),
            expected_m=float(self.expected_m[rows].mean()),
            lost=float(self.lost[rows].mean()),
            ambiguous=float(self.ambiguous[rows].mean()),
        )


@dataclass(frozen=True)
class Stretch:
    """A stretch of the route: means over its positions, and medians of sigmas."""

    first: int
    """Its first position."""
    last: int
    """Its last position."""
    first_m: float
    last_m: float
    found: float
    sigma_m: float
    sigma_deg: float
    expected_m: float
    lost: float
    ambiguous: float

    @property
    def badness_m(self) -> float:
        """Expected error if ambiguous frames count as frames without a pose."""
        return self.expected_m + self.ambiguous * (LOST_M - self.expected_m)


def predict(
    semantic_map: SemanticMap,
    camera: Camera,
    poses: tuple[Pose, ...],
    conditions: Conditions,
    watch: RouteProgress = lambda items, what, total: items,
) -> Localizability:
    """Predict localizability at ``poses`` (T_map_camera), in the order of the drive.

    Images are assumed undistorted: a lens would change only the limits of the image.
    """
    if not len(semantic_map):
        raise SemvizError("the map is empty: choose a map with elements")
    if not poses:
        raise SemvizError(
            "no pose along the route: the map has no trajectory, and no poses are given"
        )
    positions = [
        expected_error(semantic_map, camera, pose, conditions, number)
        for number, pose in enumerate(watch(poses, "predicting errors", len(poses)))
    ]
    shares = np.array([
        simulate_localization(semantic_map, camera, pose, conditions, number)
        for number, pose in enumerate(watch(poses, "simulating frames", len(poses)))
    ])  # fmt: skip
    sigmas = np.array([np.median(position.sigmas(), axis=0) for position in positions])
    along_m = distance_along(np.array([pose.translation for pose in poses]))
    elements = semantic_map.elements
    candidates = candidates_beside(poses, elements, semantic_map.classes)
    return Localizability(
        T_map_camera=poses,
        along_m=along_m,
        found=np.array([position.count.mean() for position in positions]),
        sigma_m=sigmas[:, 0],
        sigma_deg=np.rad2deg(sigmas[:, 1]),
        expected_m=_mean_nearby(along_m, np.array([position.expected_m for position in positions])),
        lost=_mean_nearby(along_m, np.array([position.lost for position in positions])),
        ambiguous=_mean_nearby(along_m, shares[:, 1]),
        suggested=suggest_elements(positions, along_m, candidates, camera, conditions, EFFECTS),
        critical=critical_elements(positions, along_m, elements, EFFECTS),
    )


def _mean_nearby(along_m: FloatArray, values: FloatArray) -> FloatArray:
    """Return (k,) means of the values (k,) at positions up to NEARBY_M before and after each."""
    first = np.searchsorted(along_m, along_m - NEARBY_M)
    last = np.searchsorted(along_m, along_m + NEARBY_M, side="right")
    sums = np.concatenate([[0.0], np.cumsum(values)])
    return np.asarray((sums[last] - sums[first]) / (last - first))
