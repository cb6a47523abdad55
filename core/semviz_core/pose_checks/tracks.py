"""Points tracked from one frame to the next, in the left and right images.

Corners are spread over the left image, and followed by the pyramidal method of Lucas and Kanade
(Bouguet 2001) to the next left image and to both right images. A point counts in an image if
tracking it back ends where it began.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from semviz_core.base.frame import Dataset, Frame
from semviz_core.common.arrays import BoolArray, ByteImage, FloatArray, float_array
from semviz_core.common.errors import SemvizError

CORNERS = 600
"""Most corners of an image."""
CORNER_QUALITY, CORNER_SPACING_PX = 0.002, 12.0
WINDOW_PX, LEVELS = 17, 4
MOST_BACK_PX = 0.3
"""A point that tracking back leads further away is lost."""
MOST_ACROSS_PX = 4.0
"""A match in the right image is at most so far from its row: more than any usual calibration error,
less than most wrong matches."""


@dataclass(frozen=True, eq=False)
class PointTracks:
    """n points in the images of two frames; NaN where one was not found, or without stereo."""

    before_left_px: FloatArray
    """(n, 2)"""
    before_right_px: FloatArray
    """(n, 2)"""
    now_left_px: FloatArray
    """(n, 2)"""
    now_right_px: FloatArray
    """(n, 2)"""

    def __post_init__(self) -> None:
        count = len(np.atleast_2d(self.before_left_px))
        for name in ("before_left_px", "before_right_px", "now_left_px", "now_right_px"):
            array = float_array(getattr(self, name), (count, 2), f"tracks: {name}", nan=True)
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return len(self.before_left_px)

    @classmethod
    def none(cls) -> "PointTracks":
        """Return the tracks of two frames without a readable image."""
        empty = np.zeros((0, 2))
        return cls(empty, empty, empty, empty)


def tracks_of(dataset: Dataset, frames: tuple[Frame, ...]) -> Iterator[PointTracks]:
    """Yield the tracks from each of ``frames`` to the next; none where an image is missing."""
    before = _read(dataset, frames[0]) if frames else None
    for frame in frames[1:]:
        now = _read(dataset, frame)
        yield PointTracks.none() if before is None or now is None else _tracks(before, now)
        before = now


@dataclass(frozen=True, eq=False)
class _Images:
    """The grey images of a frame, and the corners of the left one."""

    left: Any
    right: Any
    corners_px: FloatArray
    right_px: FloatArray
    """(n, 2) the corners in the right image."""


def _read(dataset: Dataset, frame: Frame) -> _Images | None:
    import cv2

    try:
        left = _grey(dataset.image(frame.index, "left"))
        has_right = dataset.rig.right is not None
        right = _grey(dataset.image(frame.index, "right")) if has_right else None
    except SemvizError:  # raised again when this image is shown
        return None
    found = cv2.goodFeaturesToTrack(left, CORNERS, CORNER_QUALITY, CORNER_SPACING_PX, blockSize=5)
    corners = np.zeros((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64)
    return _Images(left, right, corners, _near_row(corners, _followed(left, right, corners)))


def _tracks(before: _Images, now: _Images) -> PointTracks:
    now_left = _followed(before.left, now.left, before.corners_px)
    found = np.isfinite(now_left[:, 0])
    corners, now_left = before.corners_px[found], now_left[found]
    now_right = _near_row(now_left, _followed(now.left, now.right, now_left))
    return PointTracks(corners, before.right_px[found], now_left, now_right)


def _grey(image: ByteImage) -> Any:
    import cv2

    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def _followed(first: Any, second: Any, points_px: FloatArray) -> FloatArray:
    """Return (n, 2) points (n, 2) of one image in another; NaN for those lost."""
    import cv2

    if second is None or not len(points_px):
        return np.full((len(points_px), 2), np.nan)
    start = np.ascontiguousarray(points_px, dtype=np.float32)[:, None]
    window: dict[str, Any] = {"winSize": (WINDOW_PX, WINDOW_PX), "maxLevel": LEVELS}
    there, ok_there, _ = cv2.calcOpticalFlowPyrLK(first, second, start, cast(Any, None), **window)
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(second, first, there, cast(Any, None), **window)
    error_px = np.linalg.norm((back - start)[:, 0], axis=1)
    kept: BoolArray = (ok_there[:, 0] == 1) & (ok_back[:, 0] == 1) & (error_px < MOST_BACK_PX)
    return np.where(kept[:, None], there[:, 0].astype(np.float64), np.nan)


def _near_row(left_px: FloatArray, right_px: FloatArray) -> FloatArray:
    """Return the right points (n, 2), NaN for those that no calibration puts there."""
    with np.errstate(invalid="ignore"):
        kept = np.abs(right_px[:, 1] - left_px[:, 1]) < MOST_ACROSS_PX
    return np.where(kept[:, None], right_px, np.nan)
