"""The two images on the page: a frame's left and right or, with one camera, two frames."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from semviz.annotator.cameras import Cameras
from semviz_core.arrays import FloatArray
from semviz_core.errors import SemvizError
from semviz_core.sources.source import Side

APART_M = 4.0
"""How far from the frame on screen its companion is, where there is no right camera: a pole 20 m
ahead and 4 m aside is then seen from directions 2.5 degrees apart, and is still on screen."""
LEAST_APART_M = 0.3
MOST_FRAMES_APART = 20


@dataclass(frozen=True)
class Pane:
    """Which image: of which frame, by which camera."""

    frame_index: int
    side: Side


class Panes:
    """Which images belong on the page together. They are called left and right there."""

    def __init__(self, cameras: Cameras) -> None:
        self._cameras = cameras
        self._indices = tuple(cameras.T_map_camera)
        self._places = {index: place for place, index in enumerate(self._indices)}

    def of(self, frame_index: int) -> Mapping[Side, Pane]:
        """Left alone where there is neither a right camera nor a frame from elsewhere."""
        if self._cameras.rig.right is not None:
            return {"left": Pane(frame_index, "left"), "right": Pane(frame_index, "right")}
        panes: dict[Side, Pane] = {"left": Pane(frame_index, "left")}
        companion = self._companion(frame_index)
        return panes if companion is None else panes | {"right": Pane(companion, "left")}

    def pane(self, frame_index: int, shown_as: Side) -> Pane:
        """The image that is shown as ``shown_as``; SemvizError where there is none."""
        try:
            return self.of(frame_index)[shown_as]
        except KeyError:
            raise SemvizError(f"frame {frame_index} has no second image") from None

    def _companion(self, frame_index: int) -> int | None:
        """The earlier frame (or else later one) that is about ``APART_M`` away, or the furthest.

        What is ahead in a frame is ahead in earlier ones too, and those are labelled already.
        """
        place = self._places[frame_index]
        first, end = max(0, place - MOST_FRAMES_APART), place + MOST_FRAMES_APART + 1
        around = np.r_[np.arange(first, place)[::-1], np.arange(place + 1, end)]
        around = around[around < len(self._indices)]
        gaps = np.linalg.norm(self._centers[around] - self._centers[place], axis=1)
        if np.nanmax(gaps, initial=0.0) < LEAST_APART_M:
            return None
        far = np.flatnonzero(gaps >= APART_M)
        return self._indices[int(around[far[0] if len(far) else np.nanargmax(gaps)])]

    @cached_property
    def _centers(self) -> FloatArray:
        """(n, 3) m; NaN without a pose."""
        nowhere = np.full(3, np.nan)
        return np.array(
            [
                nowhere if pose is None else pose.translation
                for pose in self._cameras.T_map_camera.values()
            ]
        )
