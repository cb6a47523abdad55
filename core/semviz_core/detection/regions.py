"""Regions that a model finds, the elements measured in them, and their predicted sigmas.

Of an element measured twice, the first measurement, by score, is kept. Pixel (0, 0) is the centre
of the top-left pixel.

The logarithm of sigma is linear in the evidence. The weights maximize the (Gaussian) likelihood of
the errors on simulated streets. ``python bench/subpixel.py --fit`` fitted them on streets with
seeds from 20_000; ``python bench/subpixel.py`` shows the calibration on other streets.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from operator import mul

import numpy as np

from semviz_core.base.elements import Elements2D
from semviz_core.common.arrays import BoolArray, FloatArray, bool_array, float_array
from semviz_core.common.errors import SemvizError
from semviz_core.common.jit import compiled


@dataclass(frozen=True, eq=False)
class Region:
    """One pole or sign found by a model. Pixel (0, 0) is the centre of the top-left pixel."""

    class_id: int | None
    """None: a sign of unknown shape."""
    score: float
    """The model's confidence in [0, 1]."""
    box_px: FloatArray
    """(4,) left, top, right, bottom."""
    mask: BoolArray | None = None
    """(height, width) mask of the element's pixels, beginning at ``corner_px``; None without."""
    corner_px: tuple[int, int] = (0, 0)
    """Column and row of the mask's first pixel."""
    ends_px: FloatArray | None = None
    """(2, 2) peak and bottom of a pole, to a few pixels; None if the model does not give them."""
    ends_known: tuple[bool, bool] | None = None
    """Whether peak and bottom are visible, neither hidden nor cut off; None if unknown."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "box_px", float_array(self.box_px, (4,), "box_px"))
        if (self.box_px[2:] < self.box_px[:2]).any():
            raise SemvizError(f"box_px {self.box_px.tolist()}: give left, top, right, bottom")
        if self.mask is not None:
            object.__setattr__(self, "mask", bool_array(self.mask, (None, None), "mask"))
        if self.ends_px is not None:
            object.__setattr__(self, "ends_px", float_array(self.ends_px, (2, 2), "ends_px"))
        if not 0.0 <= self.score <= 1.0:
            raise SemvizError(f"score {self.score:g}: give a number from 0 to 1")

    @property
    def center_px(self) -> FloatArray:
        """(2,) centre of the box."""
        return np.asarray((self.box_px[:2] + self.box_px[2:]) / 2.0)

    @cached_property
    def mask_points_px(self) -> FloatArray:
        """(n, 2) centres of the mask's pixels; none without a mask."""
        if self.mask is None:
            return np.zeros((0, 2))
        rows, columns = np.nonzero(self.mask)
        points = np.stack([columns, rows], axis=1).astype(np.float64)
        return np.asarray(points + np.asarray(self.corner_px))

    @cached_property
    def filled(self) -> float | None:
        """Share of its extent that the mask covers; None without a mask."""
        if self.mask is None or not self.mask.any():
            return None
        rows, columns = self.mask.any(axis=1), self.mask.any(axis=0)
        return float(self.mask[rows][:, columns].mean())


_SAME_POLE_PX = 1.5
"""Poles closer than this plus half a width are the same."""
_MIN_OVERLAP = 0.5
"""Share of the shorter length that two measurements of one pole have in common."""
_SAME_SIGN = 0.5
"""Share of the smaller half size: signs with closer centres are the same."""


@dataclass(frozen=True, eq=False)
class MeasuredElement:
    """A measured pole or sign."""

    class_id: int
    score: float
    points_px: FloatArray
    """(2, 2) a pole's ends, or (1, 2) a sign's centre."""
    sigma_px: tuple[float, float]
    """Across and along a pole; equal for signs."""
    known: tuple[bool, bool]
    """Whether peak (or centre) and bottom are known."""
    size_px: float
    """Width of a pole, half the shorter side of a sign."""
    to_centroid_px: float = math.nan
    """As in ``Elements2D``. A triangular sign's point is the middle of its box."""


def elements(measured: Iterable[MeasuredElement]) -> Elements2D:
    """Return the measured elements as arrays, in the same order; triangles by their box."""
    rows = list(measured)
    no_end = np.full((1, 2), np.nan)
    ends = np.array([np.concatenate([row.points_px, no_end])[:2] for row in rows])
    ends = ends.reshape(-1, 2, 2)
    return Elements2D(
        anchor_px=ends[:, 0],
        end_px=ends[:, 1],
        class_id=np.array([row.class_id for row in rows], np.int64),
        score=np.array([row.score for row in rows], np.float64),
        sigma_px=np.array([row.sigma_px for row in rows], np.float64).reshape(-1, 2),
        anchor_known=np.array([row.known[0] for row in rows], bool),
        end_known=np.array([row.known[1] for row in rows], bool),
        to_centroid_px=np.array([row.to_centroid_px for row in rows], np.float64),
    )


def suppress_duplicates(measured: Iterable[MeasuredElement]) -> list[MeasuredElement]:
    """Return each element once; its first measurement is kept."""
    kept: list[MeasuredElement] = []
    for element in measured:
        if not any(_same(element, earlier) for earlier in kept):
            kept.append(element)
    return kept


def _same(first: MeasuredElement, second: MeasuredElement) -> bool:
    if len(first.points_px) != len(second.points_px):
        return False
    size = min(first.size_px, second.size_px)
    if len(first.points_px) == 1:
        apart = np.linalg.norm(first.points_px - second.points_px)
        return bool(apart < _SAME_SIGN * size)
    return _same_pole(first.points_px, second.points_px, _SAME_POLE_PX + size / 2.0)


@compiled
def _same_pole(first: FloatArray, second: FloatArray, beside_px: float) -> bool:
    """Whether two lines (2, 2) coincide over much of the shorter one."""
    length = np.hypot(first[1, 0] - first[0, 0], first[1, 1] - first[0, 1])
    other = np.hypot(second[1, 0] - second[0, 0], second[1, 1] - second[0, 1])
    along_u, along_v = (first[1, 0] - first[0, 0]) / length, (first[1, 1] - first[0, 1]) / length
    places, offsets = np.empty(2), np.empty(2)
    for k in range(2):
        u, v = second[k, 0] - first[0, 0], second[k, 1] - first[0, 1]
        places[k], offsets[k] = u * along_u + v * along_v, u * along_v - v * along_u
    overlap = min(places.max(), length) - max(places.min(), 0.0)
    if overlap < _MIN_OVERLAP * min(length, other):
        return False
    farthest = max(abs(offsets[0]), abs(offsets[1]))
    return bool(abs(offsets.mean()) < beside_px and farthest < 3.0 * beside_px)


_LEAST_PX, _MOST_PX = 0.1, 20.0
_LEAST_ALONG_PX = 1.2
"""Least sigma of a pole's ends along it: even of clear ones, one in 50 is another edge."""

WEIGHTS: dict[str, tuple[float, ...]] = {
    "line by ends": (-0.1109, -0.0696, 0.3786),
    "line by mask": (1.0091, -0.1197, 1.6611, -0.0911),
    "line by box": (-1.7229, -0.0206, 0.4456),
    "line by edges": (
        0.4826,
        -1.0948,
        0.7555,
        0.8464,
        0.4171,
        -0.8344,
        -0.1262,
        0.5127,
        0.2309,
        0.0738,
        -0.4923,
        -0.3118,
    ),
    "end by model": (-1.3372, 0.7704, 0.3999, -0.2252),
    "end by mask": (4.6675, -0.5195, -0.1106, -0.1048),
    "end by box": (3.7878, -0.6093, -0.2772, -0.2635),
    "end held": (0.8797, 0.1833, 0.054, 2.4817, 0.0184),
    "end by growth": (5.1776, 0.1242, -1.1205, 0.3889, 0.8933, -0.442, 0.3768, -1.2058),
    "end by rows": (2.9423, -0.2072, 0.6796, 0.5384, -0.0257, 0.8976, -0.7558),
    "end by edges": (3.4282, -0.3209, 0.6803, 0.6168, 0.4248, -0.1311, 0.6631, 0.0381),
    "end at sign": (1.5034, -0.5065, 0.6051, 0.5666),
    "center by box": (0.6093, -0.2213, 0.3221, 0),
    "center by mask": (-2.9763, 0.7614, 0.9497, 3.0552),
    "center by outline": (
        -3.4662,
        3.768,
        -3.1183,
        0.6287,
        -0.0105,
        0.0073,
        -0.0849,
        -0.2683,
        0.6684,
        0.2526,
        0.5581,
    ),
}

CHOSEN = {"across": (0.6232, 1.3036), "along": (0.1304, 1.1551), "center": (0.9229, 1.5179)}
"""The least sigma of several is often the least by chance. Constant and factor of its corrected
logarithm, fitted last, by ``python bench/subpixel_chosen.py``. Across poles and for signs the
constants are those of the first fit, which suit real images better than those fitted since."""
KNOWN: tuple[float, ...] = (
    2.6215, 1.6484, 0.5129, 1.8814, 0.4928, -0.9017, -2.0039, 0.1223,
    -0.8807, -0.8904, -0.3391, 0.1638, -0.8356, -0.3354, -0.5088,
)  # fmt: skip
"""Weights of ``pole_ends.end_evidence`` for a visible end being the pole's own (logistic)."""
KNOWN_LOG_ODDS = (0.0, math.log(1 / 2))
"""Least log-odds of a known peak and bottom. A bottom that is given up is lost, while a hidden one
does little harm: the images of a map's element outvote it, and localization expects a share."""
SHAPE = np.array(
    (-2.2206, -2.5348, -2.9158, -0.0197, 3.8794, 5.9878, -3.1262, -0.7591, -1.3119, -1.3762)
)
"""Weights of ``sign_centers.shape_evidence`` for a sign's class, against no sign."""
PAPER = (1.38, 4.11)
"""Sigmas (px) across and along of the paper's measurement: its root mean square errors."""


def predicted_sigma_px(kind: str, evidence: FloatArray) -> float:
    """Return the sigma of one coordinate of a measurement; the first weight is the constant."""
    weights = WEIGHTS[kind]
    exponent = weights[0] + sum(map(mul, weights[1:], evidence.tolist()))
    return min(max(math.exp(min(exponent, 10.0)), _LEAST_PX), _MOST_PX)


def predicted_sigmas_px(kind: str, evidence: FloatArray) -> FloatArray:
    """Return ``predicted_sigma_px`` of each row of evidence (..., k)."""
    weights = np.array(WEIGHTS[kind])
    exponent = weights[0] + evidence @ weights[1:]
    return np.asarray(np.clip(np.exp(np.minimum(exponent, 10.0)), _LEAST_PX, _MOST_PX))


def chosen_sigma_px(what: str, least_px: float) -> float:
    """Return the sigma of a candidate chosen for the least predicted sigma."""
    constant, factor = CHOSEN[what]
    floor = _LEAST_ALONG_PX if what == "along" else _LEAST_PX
    return min(max(math.exp(constant + factor * math.log(least_px)), floor), _MOST_PX)


def known(evidence: FloatArray, which: int) -> bool:
    """Whether a visible end, peak (0) or bottom (1), is taken for the pole's own."""
    return bool(KNOWN[0] + np.dot(KNOWN[1:], evidence) > KNOWN_LOG_ODDS[which])
