"""Where frames, images and calibration come from."""

from typing import Literal, Protocol

from semviz_core.arrays import ByteImage
from semviz_core.camera import Rig
from semviz_core.frame import Frame
from semviz_core.semantic_map import MapFrame

Side = Literal["left", "right"]


class Source(Protocol):
    """A sequence of (stereo) images with poses, real or simulated.

    Opening a source reads no image; a missing or wrong one raises SemvizError from ``image``.
    """

    @property
    def map_frame(self) -> MapFrame:
        """The frame of the poses."""
        ...

    @property
    def rig(self) -> Rig: ...

    @property
    def frames(self) -> tuple[Frame, ...]:
        """In order of time."""
        ...

    def image(self, index: int, side: Side) -> ByteImage:
        """(height, width, 3) sRGB of the frame numbered ``index``."""
        ...
