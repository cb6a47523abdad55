"""An image with its camera, marks of poles and signs in it, and proposed marks.

An end of a pole that is not known is only a point on its line. Ends are (n, 2, 2) px, NaN for the
end of a sign.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from semviz_annotation.labels.labels import Observation, Pixel
from semviz_annotation.labels.views import PosedView
from semviz_core.base.camera import Camera
from semviz_core.base.classes import OLDER_CENTER, TriangleCenter
from semviz_core.base.elements import Elements2D
from semviz_core.base.frame import Side
from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.subpixel.joint_outlines import EdgeProfile
from semviz_core.subpixel.sampling import SampledImage

SURE = 0.9
"""Proposals with at least this score can be accepted together by one key."""


@dataclass(frozen=True, eq=False)
class MarkedImage(SampledImage):
    """One image with its camera and pose."""

    view: PosedView
    triangle_center: TriangleCenter = OLDER_CENTER
    """What marks of triangular signs are."""
    sizes: dict[Mark, FloatArray] = field(default_factory=dict, init=False, repr=False)
    """Cache of measured widths and sizes, as one mark is propagated to many frames."""
    profiles: dict[tuple[Mark, str], EdgeProfile] = field(
        default_factory=dict, init=False, repr=False
    )
    """Cache of the edges around marks of signs, by outline shape."""

    @classmethod
    def of(
        cls, view: PosedView, rgb: ByteImage, triangle_center: TriangleCenter = OLDER_CENTER
    ) -> MarkedImage:
        """Return ``rgb`` with its view. Raise SemvizError if it has not the camera's size."""
        expected = (view.camera.height, view.camera.width, 3)
        if rgb.shape != expected or rgb.dtype != np.uint8:
            raise SemvizError(
                f"image is {rgb.shape} of {rgb.dtype}; its camera has {expected} of uint8"
            )
        return cls(rgb, view, triangle_center)


@dataclass(frozen=True)
class Mark:
    """A pole or a sign in one image; an end that is not known is only a point on the line."""

    anchor_px: Pixel
    """Peak of a pole, centre of a sign."""
    end_px: Pixel | None = None
    """Bottom of a pole; None for signs."""
    anchor_known: bool = True
    end_known: bool = True

    @classmethod
    def of(cls, observation: Observation) -> Mark:
        """Return the mark of a label."""
        return cls(
            observation.anchor_px,
            observation.end_px,
            observation.anchor_known,
            observation.end_known,
        )

    @classmethod
    def of_element(cls, observed: Elements2D, row: int) -> Mark:
        """Return the mark of an element observed in an image."""
        end = pixel(observed.end_px[row]) if observed.is_line[row] else None
        known = bool(observed.anchor_known[row]), bool(observed.end_known[row])
        return cls(pixel(observed.anchor_px[row]), end, *known)

    def at(
        self, frame_index: int, side: Side = "left", id: str = "", element_id: str = ""
    ) -> Observation:
        """Return the mark as a label. Without ids it can be triangulated, but not stored."""
        known = self.anchor_known, self.end_known
        return Observation(id, element_id, frame_index, side, self.anchor_px, self.end_px, *known)

    @property
    def ends_px(self) -> FloatArray:
        """(2, 2) of a pole; (1, 2) of a sign."""
        return np.array([point for point in (self.anchor_px, self.end_px) if point is not None])

    def gap_px(self, other: Mark) -> float:
        """Return the distance to another mark; see ``gaps_px``."""
        return float(gaps_px(both_ends_px([self]), both_ends_px([other]))[0, 0])


def both_ends_px(marks: Iterable[Mark]) -> FloatArray:
    """Return anchors and ends (n, 2, 2); ends are NaN for signs."""
    ends = [(mark.anchor_px, mark.end_px or (np.nan, np.nan)) for mark in marks]
    return np.array(ends, dtype=np.float64).reshape(-1, 2, 2)


def gaps_px(marks_px: FloatArray, others_px: FloatArray) -> FloatArray:
    """Return the distances (n, m) of marks (n, 2, 2) from others (m, 2, 2), as ``both_ends_px``.

    Signs: distance of the centres. Poles: the larger distance of the first pole's ends from the
    other's line. Infinite between poles and signs, and between poles that do not overlap along it.
    """
    middles = np.linalg.norm(marks_px[:, None, 0] - others_px[None, :, 0], axis=2)
    along = others_px[:, 1] - others_px[:, 0]
    length = np.maximum(np.linalg.norm(along, axis=1), 1e-9)
    gaps = marks_px[:, None] - others_px[None, :, :1]  # (n, m, 2, 2)
    across = np.abs(gaps[..., 0] * along[:, 1:] - gaps[..., 1] * along[:, :1]).max(axis=2) / length
    shares = (gaps * along[:, None]).sum(axis=3) / length[:, None] ** 2
    beside = np.minimum(shares.max(axis=2), 1.0) > np.maximum(shares.min(axis=2), 0.0)
    poles = np.isfinite(marks_px[:, 1, 0])[:, None], np.isfinite(others_px[:, 1, 0])
    alike = np.where(poles[0] & poles[1] & beside, across, np.inf)
    return np.where(poles[0] | poles[1], alike, middles)


@dataclass(frozen=True)
class ProposedMark:
    """A mark proposed by image analysis."""

    mark: Mark
    score: float
    """Estimated probability that the mark is within 2 px; see ``score``."""

    @property
    def sure(self) -> bool:
        """Whether the mark can be accepted together with others."""
        return self.score >= SURE


def pixel(point: FloatArray) -> Pixel:
    return float(point[0]), float(point[1])


def clip_to_image(mark: Mark, ends_px: FloatArray, camera: Camera) -> Mark:
    """Return ``mark`` with ends (1 or 2, 2) clipped to the image; clipped ends are not known.

    A pole that is completely outside is returned unclipped.
    """
    if len(ends_px) == 1:
        return Mark(pixel(ends_px[0]), None, mark.anchor_known, False)
    low, high = np.array([-0.5, -0.5]), np.array([camera.width - 0.5, camera.height - 0.5])
    step = ends_px[1] - ends_px[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        bounds = np.stack([(low - ends_px[0]) / step, (high - ends_px[0]) / step])
    enter = float(np.nanmax(np.append(bounds.min(axis=0), 0.0)))
    leave = float(np.nanmin(np.append(bounds.max(axis=0), 1.0)))
    if enter >= leave:
        return Mark(pixel(ends_px[0]), pixel(ends_px[1]), mark.anchor_known, mark.end_known)
    ends = ends_px[0] + np.array([[enter], [leave]]) * step
    first, last = np.clip(ends, low, high)  # against rounding: clipped ends are on the border
    known = (mark.anchor_known and enter == 0.0, mark.end_known and leave == 1.0)
    return Mark(pixel(first), pixel(last), *known)
