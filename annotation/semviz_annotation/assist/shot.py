"""One image with its camera, what is marked in it, and what is proposed to be."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from semviz_annotation.labels import Observation, Pixel
from semviz_annotation.view import View
from semviz_core.arrays import ByteImage, FloatArray
from semviz_core.camera import Camera
from semviz_core.elements import Elements2D
from semviz_core.errors import SemvizError
from semviz_core.measuring.picture import Picture
from semviz_core.sources.source import Side

SURE = 0.8
"""Proposals of this score and more can be accepted by one key together."""


@dataclass(frozen=True, eq=False)
class Shot(Picture):
    """One image with its camera."""

    view: View
    sizes: dict[Mark, FloatArray] = field(default_factory=dict, init=False, repr=False)
    """Of what is marked in it, once measured: it is followed into many frames."""

    @classmethod
    def of(cls, view: View, rgb: ByteImage) -> Shot:
        """SemvizError where the image is not of the camera's size."""
        expected = (view.camera.height, view.camera.width, 3)
        if rgb.shape != expected or rgb.dtype != np.uint8:
            raise SemvizError(
                f"image is {rgb.shape} of {rgb.dtype}; its camera has {expected} of uint8"
            )
        return cls(rgb, view)


@dataclass(frozen=True)
class Mark:
    """Where a pole or a sign is in one image; an end that is not known is only on the line."""

    anchor_px: Pixel
    """Peak of a pole, middle of a sign."""
    end_px: Pixel | None = None
    """Bottom of a pole; None for signs."""
    anchor_known: bool = True
    end_known: bool = True

    @classmethod
    def of(cls, observation: Observation) -> Mark:
        """Of a label."""
        one = observation
        return cls(one.anchor_px, one.end_px, one.anchor_known, one.end_known)

    @classmethod
    def seen(cls, observed: Elements2D, row: int) -> Mark:
        """Of one of the elements seen in an image."""
        end = pixel(observed.end_px[row]) if observed.is_line[row] else None
        known = bool(observed.anchor_known[row]), bool(observed.end_known[row])
        return cls(pixel(observed.anchor_px[row]), end, *known)

    def at(
        self, frame_index: int, side: Side = "left", id: str = "", element_id: str = ""
    ) -> Observation:
        """As a label; without names it is good to triangulate with, not to be stored."""
        known = self.anchor_known, self.end_known
        return Observation(id, element_id, frame_index, side, self.anchor_px, self.end_px, *known)

    @property
    def ends_px(self) -> FloatArray:
        """(2, 2) of a pole; (1, 2) of a sign."""
        return np.array([one for one in (self.anchor_px, self.end_px) if one is not None])

    def gap_px(self, other: Mark) -> float:
        """As ``gaps_px``."""
        return float(gaps_px(both_ends_px([self]), both_ends_px([other]))[0, 0])


def both_ends_px(marks: Iterable[Mark]) -> FloatArray:
    """(n, 2, 2) anchor and end, which is NaN for signs."""
    ends = [(one.anchor_px, one.end_px or (np.nan, np.nan)) for one in marks]
    return np.array(ends, dtype=np.float64).reshape(-1, 2, 2)


def gaps_px(ones: FloatArray, others: FloatArray) -> FloatArray:
    """(n, m) how far marks (n, 2, 2) are from others (m, 2, 2), anchor and end, NaN for signs.

    Between signs' middles; between poles across the line of the other, at the two ends of the
    first. Infinite between poles and signs, and for poles that are not beside each other.
    """
    middles = np.linalg.norm(ones[:, None, 0] - others[None, :, 0], axis=2)
    along = others[:, 1] - others[:, 0]
    length = np.maximum(np.linalg.norm(along, axis=1), 1e-9)
    gaps = ones[:, None] - others[None, :, :1]  # (n, m, 2, 2)
    across = np.abs(gaps[..., 0] * along[:, 1:] - gaps[..., 1] * along[:, :1]).max(axis=2) / length
    shares = (gaps * along[:, None]).sum(axis=3) / length[:, None] ** 2
    beside = np.minimum(shares.max(axis=2), 1.0) > np.maximum(shares.min(axis=2), 0.0)
    poles = np.isfinite(ones[:, 1, 0])[:, None], np.isfinite(others[:, 1, 0])
    alike = np.where(poles[0] & poles[1] & beside, across, np.inf)
    return np.where(poles[0] | poles[1], alike, middles)


@dataclass(frozen=True)
class Proposed:
    """A mark that a machine made."""

    mark: Mark
    score: float
    """Estimated probability that it is within 2 px; see ``score``."""

    @property
    def sure(self) -> bool:
        return self.score >= SURE


def pixel(point: FloatArray) -> Pixel:
    return float(point[0]), float(point[1])


def clipped(mark: Mark, ends_px: FloatArray, camera: Camera) -> Mark:
    """A mark with ends (1 or 2, 2) instead; where they leave the image, they are not known.

    What is outside altogether stays there.
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
    first, last = np.clip(ends, low, high)  # digits: a cut end is on the border exactly
    known = (mark.anchor_known and enter == 0.0, mark.end_known and leave == 1.0)
    return Mark(pixel(first), pixel(last), *known)
