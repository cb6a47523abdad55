"""How far a mark can be trusted: within 2 px for a proposal, within 1 px for a snap.

Logistic functions of a few measures, fitted on simulated streets with seeds below 1000 by
``python bench/assist.py --fit``; those of followed and seen marks also on KITTI 02 (``--kitti``).
A pole is right if it is within 2 px across. On other streets, ``python bench/assist.py`` measures
their calibration. Detector proposals use
``python bench/detector_proposals.py --fit --streets 24`` with the shipped detector: the probability
that all marks are right, including every pole end marked as seen, and of each such end by itself.

A mark that follows the labelled views of its element keeps its offset in metres, so in pixels it
grows as the camera comes near. A person has to look again from time to time, unless the image
itself shows where the element is.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from semviz_annotation.assist.image_search import PropagatedMark
from semviz_annotation.assist.marked_image import Mark, MarkedImage
from semviz_annotation.labels.views import PosedView
from semviz_annotation.mapping.placement.triangulation import Triangulated
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray

WEIGHTS: dict[str, tuple[float, ...]] = {
    "seen sign": (
        7.2,
        0.65,
        1.22,
        -1.18,
        0.21,
        0.04,
        -2.69,
        -0.53,
        -1.48,
        1.85,
        0.13,
        -0.41,
        0.11,
        2.93,
        -0.26,
        4.08,
        -0.54,
        0,
        0.11,
        -0.37,
        3.34,
    ),
    "followed sign": (
        4.66,
        6.67,
        -1.78,
        -2.2,
        -1.74,
        3.61,
        -0.62,
        5.46,
        0.26,
        0,
        -1.74,
        -0.88,
        -3.66,
    ),
    "seen pole": (
        8.57,
        -0.51,
        -0.94,
        -1.24,
        0.66,
        1.41,
        -0.32,
        -0.07,
        -0.51,
        1.18,
        -0.58,
        -3.58,
        4.63,
        -0.54,
        -0.63,
        0.8,
        0.43,
        0.31,
        -1.2,
        0.19,
        -0.23,
        -0.66,
        -1.39,
    ),
    "followed pole": (
        5.2,
        2.72,
        -2.25,
        -1.79,
        1.44,
        2.29,
        -0.21,
        -0.45,
        -0.29,
        3.45,
        -0.74,
        -1.3,
        3.01,
        -0.27,
        -0.22,
        0,
        0,
        0,
        -0.8,
        0.06,
        -0.47,
        -0.27,
        1.19,
    ),
    "found alone pole": (0.63, 0.97, 0.01),
    "found alone sign": (-0.93, 0.49, 0.1),
    "found end": (7.11, -2.4, -1.34),
    "found one pole": (0.03, 0.48, 0.2, 0.41),
    "found one sign": (-2.19, 1.25, 0.28, 0.49),
    "found pair pole": (4.44, -0.17, -0.78, 0.0, 0.16, 0.54, -3.51),
    "found pair sign": (1.12, 0.63, 0.29, 0.09, 0.2, 0.05, -1.46),
    "stereo pole": (
        2.30,
        -0.22,
        -0.11,
        -2.77,
        1.69,
        -0.37,
        4.33,
        0.30,
        0.00,
        5.99,
        -0.88,
        -0.23,
    ),
    "stereo sign": (0.45, 0.66, 0.84, -0.76, 0.99, 9.54, -0.93, 0.22),
    "snap pole": (-8.70, -1.16, 0.82, 0.84, -0.65, 7.27, 0.36, -2.67, -0.82, -1.35, 1.98),
    "snap sign": (3.16, 2.93, 1.26, 1.26, 0.36, -3.31, 0.55, 0.43, -5.87),
}


def probability(kind: str, evidence: FloatArray) -> float:
    """Return the probability for evidence (k,); the first of the k + 1 weights is the constant."""
    weights = WEIGHTS[kind]
    return float(1.0 / (1.0 + np.exp(-(weights[0] + evidence @ np.array(weights[1:])))))


LOOK_AGAIN = {"pole": 1.15, "sign": 1.03}
"""An element that has grown by this factor since somebody looked is looked at again. The middle of
a sign without a clear outline is where somebody drew it, often a pixel or two off; poles have an
axis."""
LOOK_SCORE = 0.5
"""The largest score of such an element."""


@dataclass(frozen=True, eq=False)
class LabelledView:
    """An image in which an element is labelled."""

    image: MarkedImage
    mark: Mark


@dataclass(frozen=True, eq=False)
class Track:
    """What is known of an element from other moments."""

    views: tuple[LabelledView, ...] = ()
    """Some of its labelled views, beside those that are followed."""
    growth: float = 1.0
    """By how much larger it is than when somebody looked at it last."""


NO_TRACK = Track()


def apparent_size(element: Triangulated, view: PosedView) -> float:
    """Return the size of an element in an image, px per metre; 0 behind the camera."""
    depth_m = float(view.depth_m(element.anchor_m[None])[0])
    return float(view.camera.K[0, 0]) / depth_m if depth_m > 0.0 else 0.0


def look_again(element: Triangulated) -> float:
    """Return the growth from which an element that only follows its labels is looked at again."""
    return LOOK_AGAIN["pole" if element.is_line else "sign"]


def growth(sizes: Iterable[float], now: float, again: float) -> float:
    """Return the factor from the size at which somebody looked last to the size ``now``.

    ``sizes`` are those in all labelled views, and ``again`` is that of ``look_again``. Without
    looking nobody accepts a label of an element that has grown by as much, if no image shows where
    it is; so a label of that size shows that somebody looked, or the image.
    """
    looks: list[float] = []
    for labelled in sorted(sizes):
        if not looks or labelled >= again * looks[-1]:
            looks.append(labelled)
    if not looks or now <= 0.0 or looks[0] <= 0.0:
        return float("inf")
    above = [look for look in looks if look >= now]
    return now / (above[0] if above else looks[-1])


def log_growth(track: Track) -> float:
    """Return the logarithm of a track's growth; 0 if it has not grown, at most that of 4."""
    return float(np.log(np.clip(track.growth, 1.0, 4.0)))


MORE_VIEWS = 4
"""Number of a track's ``views``: two moments of a stereo camera."""
_LARGER = (0.98, 2.0)
"""A view of this relative size shows the element as well as the searched image does."""


def view_to_follow(
    sizes: FloatArray, moments: IntArray, other_camera: BoolArray, now: float
) -> int:
    """Return the row of the labelled view whose mark is followed in an image.

    ``sizes`` (n,) are those of the element in its labelled views and ``now`` in the image;
    ``moments`` (n,) count frames between them. Views in which the element is larger come first,
    as an offset shrinks from them; then the nearest in time, of the same camera if possible.
    """
    larger = (sizes >= _LARGER[0] * now) & (sizes <= _LARGER[1] * now)
    order = np.lexsort((other_camera, moments, ~larger))
    return int(order[0])


def views_beside(moments: IntArray, followed: Iterable[int]) -> list[int]:
    """Return the rows of a track's views: the nearest in time that are not ``followed``."""
    taken = set(followed)
    nearest = np.argsort(moments, kind="stable").tolist()
    return [row for row in nearest if row not in taken][:MORE_VIEWS]


def score_of(view: PropagatedMark, track: Track, element: Triangulated) -> float:
    """Return the score of a propagated mark, which bounds that of one to look at again."""
    score = probability(view.what, view.evidence)
    must_look = view.what.startswith("followed") and track.growth >= look_again(element)
    return min(score, LOOK_SCORE) if must_look or view.is_longer else score
