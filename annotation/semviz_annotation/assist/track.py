"""The labelled views of an element, and how far a mark that follows them can be trusted.

A mark that is only followed keeps its offset in metres. In pixels the offset grows as the camera
comes near. So a person has to look again from time to time, unless the image itself shows where
the element is.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from semviz_annotation.assist.image_search import PropagatedMark
from semviz_annotation.assist.marked_image import Mark, MarkedImage
from semviz_annotation.assist.score import probability
from semviz_annotation.labels.views import PosedView
from semviz_annotation.mapping.placement.triangulation import Triangulated
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray

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


def size(element: Triangulated, view: PosedView) -> float:
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
