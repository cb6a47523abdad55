"""The whole of it on one screen: a map and a route, to what a camera will know of its place."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.camera import Camera
from semviz_core.errors import SemvizError
from semviz_core.localizability.conditions import Conditions
from semviz_core.localizability.effects import Effect, critical, suggest
from semviz_core.localizability.outlook import LOST_M, look_out
from semviz_core.localizability.route import candidates_beside, distance_along
from semviz_core.localizability.trial import try_out
from semviz_core.pose import Pose
from semviz_core.semantic_map import SemanticMap

STRETCH_M = 20.0
NEARBY_M = 5.0
"""Positions no further along the route than this share what was drawn for them: they see nearly
the same, and share its chance."""
EFFECTS = 3
"""So many new elements are suggested, and so many critical ones named."""
LIMITS_M = (0.1, 0.2, 0.4, 0.7)
"""Of the expected error, between the levels in which it is shown; the same for all maps."""

Watch = Callable[[Iterable[Pose], str, int], Iterable[Pose]]
"""Passes poses through, and tells people what is done with them and how many there are."""


@dataclass(frozen=True, eq=False)
class Localizability:
    """What single frames will know of their place at k positions along a route."""

    T_map_camera: tuple[Pose, ...]
    along_m: FloatArray
    """(k,) metres driven up to each position."""
    found: FloatArray
    """(k,) mapped elements that a detector finds, on average."""
    sigma_m: FloatArray
    """(k,) of the camera centre: the median over what may be found; inf where most frames have no
    answer."""
    sigma_deg: FloatArray
    """(k,) of the heading, likewise."""
    expected_m: FloatArray
    """(k,) mean sigma of the camera centre over what may be found; a frame without an answer, or
    with a worse one, counts as 1 m."""
    lost: FloatArray
    """(k,) share of frames that find too little to answer."""
    ambiguous: FloatArray
    """(k,) share of frames whose answer is not sure, or is sure and 1 m off."""
    suggested: tuple[Effect, ...]
    """New elements that would help most, each given those before it."""
    critical: tuple[Effect, ...]
    """Mapped elements whose loss would cost most."""

    def stretches(self) -> "tuple[Stretch, ...]":
        """The route in pieces of STRETCH_M, the worst first."""
        piece = (self.along_m // STRETCH_M).astype(np.int64)
        found = [self._stretch(np.flatnonzero(piece == one)) for one in np.unique(piece)]
        return tuple(sorted(found, key=lambda one: (-one.badness_m, one.first_m)))

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
    """A piece of the route: means over its positions, of sigmas the median."""

    first: int
    """Position where it begins."""
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
        """The expected error if a frame that is not sure counts as one without an answer."""
        return self.expected_m + self.ambiguous * (LOST_M - self.expected_m)


def predict(
    semantic_map: SemanticMap,
    camera: Camera,
    poses: tuple[Pose, ...],
    conditions: Conditions,
    watch: Watch = lambda items, what, total: items,
) -> Localizability:
    """Localizability at ``poses`` (T_map_camera), in the order in which a camera comes by.

    Images are taken to be undistorted: of a lens, only how far the image reaches would matter.
    """
    if not len(semantic_map):
        raise SemvizError("the map is empty: nothing in it can be seen")
    if not poses:
        raise SemvizError(
            "no pose along the route: the map has no trajectory, and no poses are given"
        )
    outlooks = [
        look_out(semantic_map, camera, pose, conditions, number)
        for number, pose in enumerate(watch(poses, "looking along the route", len(poses)))
    ]
    tried = np.array([
        try_out(semantic_map, camera, pose, conditions, number)
        for number, pose in enumerate(watch(poses, "trying made-up frames", len(poses)))
    ])  # fmt: skip
    sigmas = np.array([np.median(one.sigmas(), axis=0) for one in outlooks])
    along_m = distance_along(np.array([pose.translation for pose in poses]))
    elements = semantic_map.elements
    candidates = candidates_beside(poses, elements, semantic_map.classes)
    return Localizability(
        T_map_camera=poses,
        along_m=along_m,
        found=np.array([one.count.mean() for one in outlooks]),
        sigma_m=sigmas[:, 0],
        sigma_deg=np.rad2deg(sigmas[:, 1]),
        expected_m=_mean_nearby(along_m, np.array([one.expected_m for one in outlooks])),
        lost=_mean_nearby(along_m, np.array([one.lost for one in outlooks])),
        ambiguous=_mean_nearby(along_m, tried[:, 1]),
        suggested=suggest(outlooks, along_m, candidates, camera, conditions, EFFECTS),
        critical=critical(outlooks, along_m, elements, EFFECTS),
    )


def _mean_nearby(along_m: FloatArray, values: FloatArray) -> FloatArray:
    """(k,) mean of the values (k,) at positions up to NEARBY_M before and after each."""
    first = np.searchsorted(along_m, along_m - NEARBY_M)
    last = np.searchsorted(along_m, along_m + NEARBY_M, side="right")
    sums = np.concatenate([[0.0], np.cumsum(values)])
    return np.asarray((sums[last] - sums[first]) / (last - first))
