"""One element's place in space from two or more views: rays and planes, with its covariance.

It is what ``mapping.place_linearly`` finds, quick enough to follow a hand that drags.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semviz_annotation.labels import Observation
from semviz_annotation.mapping.placing.linear import MIN_ANGLE_RAD
from semviz_annotation.mapping.placing.place import PlaceOptions, place_linearly
from semviz_annotation.mapping.placing.sightings import Sightings, as_views, undistorted
from semviz_annotation.view import View, rig_view
from semviz_core.arrays import FloatArray
from semviz_core.camera import Rig
from semviz_core.errors import SemvizError

_NO_END = (np.nan, np.nan)


@dataclass(frozen=True, eq=False)
class Triangulated:
    """One element in the map frame."""

    anchor_m: FloatArray
    """(3,) peak of a pole, middle of a sign."""
    end_m: FloatArray
    """(3,) bottom of a pole, NaN for signs."""
    covariance_m2: FloatArray
    """(6, 6) of (anchor, end), to first order; zero in the rows of a sign's end."""
    anchor_known: bool
    end_known: bool
    angle_rad: float
    """Largest angle between two of the rays (signs) or planes (poles)."""
    rms_px: float
    """Reprojection error: of the point, or of a pole's ends across its line."""

    @property
    def is_line(self) -> bool:
        return bool(np.isfinite(self.end_m).all())


@dataclass(frozen=True)
class Failed:
    """Why there is no place."""

    reason: str
    too_narrow: bool = False
    """The rays are sound but nearly parallel: views from elsewhere can help."""


def triangulate_pair(
    rig: Rig, left: Observation, right: Observation, sigma_px: float = 1.0
) -> Triangulated | Failed:
    """An element from both images of one frame, in the coordinates of the left camera."""
    return triangulate([rig_view(rig, "left"), rig_view(rig, "right")], [left, right], sigma_px)


def triangulate(
    views: Sequence[View],
    observations: Sequence[Observation],
    sigma_px: float = 1.0,
    min_angle_rad: float = MIN_ANGLE_RAD,
) -> Triangulated | Failed:
    """An element from k >= 2 observations, one in each of ``views``, in their map frame.

    ``sigma_px`` is the standard deviation of an end in each direction. Returns ``Failed`` where the
    geometry gives no answer. Raises SemvizError for fewer than two views, or poles among signs.
    """
    if len(views) < 2 or len(views) != len(observations):
        raise SemvizError("triangulation needs two or more observations, and a view for each")
    images = [(one.frame_index, one.side) for one in observations]
    options = PlaceOptions(sigma_px, min_angle_rad)
    placed = place_linearly(as_views(images, views), _sightings(views, observations), options)
    if not placed.ok[0]:
        return Failed(placed.failure[0], bool(placed.too_narrow[0]))
    return Triangulated(
        anchor_m=placed.anchor_m[0],
        end_m=placed.end_m[0],
        covariance_m2=placed.covariance_m2[0],
        anchor_known=bool(placed.anchor_known[0]),
        end_known=bool(placed.end_known[0]),
        angle_rad=float(placed.angle_rad[0]),
        rms_px=float(placed.rms_px[0]),
    )


def _sightings(views: Sequence[View], observations: Sequence[Observation]) -> Sightings:
    """Of one thing, each in a view of its own."""
    k = len(observations)
    ends_px = np.array([(one.anchor_px, one.end_px or _NO_END) for one in observations])
    for pair, view in zip(ends_px, views, strict=True):
        pair[:] = undistorted(view.camera, pair)
    return Sightings(
        thing=np.zeros(k, dtype=np.int64),
        view=np.arange(k),
        anchor_px=ends_px[:, 0],
        end_px=ends_px[:, 1],
        anchor_known=np.array([one.anchor_known for one in observations]),
        end_known=np.array([one.end_known for one in observations]),
        observation=np.arange(k),
        count=1,
    )
