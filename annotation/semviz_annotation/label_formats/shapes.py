"""From shapes of other tools to the two points of a pole, or the middle of a sign.

A line is a pole from its first to its last point. A box is one along its longer middle line, a
polygon along the principal axis of its area. The middle of a sign is that of a box, or the centroid
of a polygon. Poles and signs are convex, so a polygon stands for its convex hull: neither
self-intersections nor separate parts do harm.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from semviz_annotation.labels.rows import ImportedOutline, OutlineForm, Pixel
from semviz_core.common.arrays import FloatArray

Form: TypeAlias = Literal["line", "points", "box", "polygon"]
SLENDER = 2.0
"""A box or polygon that is less elongated has no axis to take for a pole."""


@dataclass(frozen=True)
class DrawnShape:
    """A drawn shape in pixels of the image that it was drawn in."""

    form: Form
    points: tuple[Pixel, ...]
    """Of a line in their order, of a box its top left and bottom right corner before the turn."""
    turn_rad: float = 0.0
    """Of a box about its middle, clockwise in the image."""
    is_peak_first: bool = False
    """Whether the file says that a line starts at the peak; else that is its upper end."""

    def below_middle(self, share: float) -> Pixel:
        """Return the middle of a box, moved by a share of its height towards its own bottom."""
        (left, top), (right, bottom) = self.points
        down = share * (bottom - top)
        return (
            0.5 * (left + right) - down * math.sin(self.turn_rad),
            0.5 * (top + bottom) + down * math.cos(self.turn_rad),
        )

    @property
    def corners(self) -> tuple[Pixel, ...]:
        """The four corners of a box, or the points of any other shape."""
        if self.form != "box":
            return self.points
        (left, top), (right, bottom) = self.points
        if not self.turn_rad:
            return (left, top), (right, top), (right, bottom), (left, bottom)
        u, v, half_u, half_v = (
            (left + right) / 2,
            (top + bottom) / 2,
            (right - left) / 2,
            (bottom - top) / 2,
        )
        cos, sin = math.cos(self.turn_rad), math.sin(self.turn_rad)
        return tuple(
            (u + cos * x * half_u - sin * y * half_v, v + sin * x * half_u + cos * y * half_v)
            for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))
        )


def outline_of(corners: Sequence[Pixel]) -> tuple[OutlineForm, tuple[Pixel, ...]]:
    """Return form and points of an ``ImportedOutline``: a box if its corners are upright."""
    us, vs = sorted({u for u, _ in corners}), sorted({v for _, v in corners})
    if len(corners) == 4 and len(us) == len(vs) == 2 and len(set(corners)) == 4:
        return "box", ((us[0], vs[0]), (us[1], vs[1]))
    return "polygon", tuple(corners)


def outline_corners(outline: ImportedOutline) -> tuple[Pixel, ...]:
    """Return the corners of an outline, of a box from its top left one on."""
    if outline.form == "polygon":
        return outline.points_px
    return DrawnShape("box", outline.points_px).corners


def centroid(points: Sequence[Pixel]) -> Pixel | None:
    """Return the centroid of the hull of a polygon; None if it has no area."""
    area = _area(points)
    return None if area is None else (float(area[1][0]), float(area[1][1]))


def axis(points: Sequence[Pixel]) -> tuple[Pixel, Pixel] | None:
    """Return the upper and the lower end of a slender polygon; None if it is none, or flat.

    The ends are where the principal axis of the area leaves the extent of the hull.
    """
    area = _area(points)
    if area is None:
        return None
    hull, middle, moments = area
    (small, large), directions = np.linalg.eigh(moments)
    if large < SLENDER**2 * max(small, 0.0):
        return None
    along = directions[:, 1]
    reach = (hull - middle) @ along
    ends = (middle + reach.min() * along).tolist(), (middle + reach.max() * along).tolist()
    (u, v), (other_u, other_v) = sorted(ends, key=lambda end: float(end[1]))
    return (u, v), (other_u, other_v)


def _area(points: Sequence[Pixel]) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return hull (n, 2), centroid (2,) and central second moments (2, 2) per area of a polygon.

    None if it has no area.
    """
    from scipy.spatial import ConvexHull, QhullError

    corners = np.array(points, dtype=np.float64).reshape(-1, 2)
    try:
        hull = corners[ConvexHull(corners).vertices]
    except (QhullError, ValueError):  # on a line, or fewer than three points
        return None
    shift = hull.mean(axis=0)
    here = hull - shift
    following = np.roll(here, -1, axis=0)
    cross = here[:, 0] * following[:, 1] - following[:, 0] * here[:, 1]
    area = 0.5 * cross.sum()
    middle = (cross[:, None] * (here + following)).sum(axis=0) / (6.0 * area)
    pairs = np.einsum("n,ni,nj->ij", cross, here, here)
    pairs += np.einsum("n,ni,nj->ij", cross, following, following)
    mixed = np.einsum("n,ni,nj->ij", cross, here, following)
    second = (2.0 * pairs + mixed + mixed.T) / (24.0 * area)
    return hull, shift + middle, second - np.outer(middle, middle)
