"""Recorded images as a dataset: a folder, two for stereo, or the folders of a rig's cameras.

Images are rectified as they are asked for.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from semviz_core.base.camera import Rig
from semviz_core.base.frame import Frame, Side
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame
from semviz_core.common import limits
from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.datasets.own_drive.images.color_orders import ColorOrder, demosaiced
from semviz_core.datasets.own_drive.images.rectification import Rectification, RectifiedRig

_PNG_LEVEL = 1
"""Larger levels take several times as long, for a tenth less space."""


@dataclass(frozen=True, eq=False)
class ImageFolder:
    """A ``Dataset`` of recorded images.

    A rectified image is made when it is first asked for, and kept in ``cache`` as PNG, so that
    labels and measurements of all times see the same pixels. Its file has the recorded image's time
    of change, and is made again if that changes. Images that need no rectification, and have red
    first, are read as they are.
    """

    map_frame: MapFrame
    frames: tuple[Frame, ...]
    """Poses are those of the rectified left camera."""
    left: Mapping[int, Path]
    """Recorded images by the index of their frame."""
    right: Mapping[int, Path]
    """Empty with one camera."""
    rectified: RectifiedRig
    cache: Path
    """Folder of rectified images, made when needed."""
    camera_of: Mapping[int, str] = field(default_factory=dict)
    """Of a rig: the name of each frame's camera. Empty for one camera or a stereo pair."""
    mounts: Mapping[str, Pose] = field(default_factory=dict)
    """Of a rig: ``T_first_camera`` by name, of those that are known."""
    rectified_cameras: Mapping[str, RectifiedRig] = field(default_factory=dict)
    """Of a rig, by name; all have the same camera."""
    colors: ColorOrder = "rgb"
    """Of the recorded images."""

    @property
    def rig(self) -> Rig:
        return self.rectified.rig

    def with_frames(self, frames: tuple[Frame, ...]) -> "ImageFolder":
        """Return the same images with other poses; ``frames`` have the same numbers."""
        return replace(self, frames=frames)

    def image(self, index: int, side: Side) -> ByteImage:
        """Return (height, width, 3) sRGB of the rectified image of frame ``index``.

        Raise SemvizError if the recorded image is missing, unreadable or of another size.
        """
        path = self.image_path(index, side)
        camera = self.rectification(index, side).camera
        return _read_image(path, camera.width, camera.height)

    def image_path(self, index: int, side: Side) -> Path:
        """Return the path of a rectified image, which is made if it is missing."""
        original = self.original_path(index, side)
        rectification = self.rectification(index, side)
        if self._is_read_as_recorded(index, side):
            return original
        path = self._rectified_path(index, side)
        changed_ns = original.stat().st_mtime_ns
        if not self.is_rectified(index, side):
            self._check_replaceable(path)
            recorded = rectification.original
            image = _read_image(original, recorded.width, recorded.height)
            if self.colors == "bgr":
                image = np.ascontiguousarray(image[:, :, ::-1])
            elif self.colors != "rgb":
                image = demosaiced(image, self.colors)
            if not rectification.is_identity:
                image = rectification.rectify(image)
            _write_png(path, image, changed_ns)
        return path

    def is_rectified(self, index: int, side: Side) -> bool:
        """Whether a rectified image is made, or none is needed."""
        if self._is_read_as_recorded(index, side):
            return True
        path, original = self._rectified_path(index, side), self.original_path(index, side)
        return path.is_file() and path.stat().st_mtime_ns == original.stat().st_mtime_ns

    def _is_read_as_recorded(self, index: int, side: Side) -> bool:
        return self.rectification(index, side).is_identity and self.colors == "rgb"

    def _rectified_path(self, index: int, side: Side) -> Path:
        return self.cache / side / f"{index:06d}.png"

    def _check_replaceable(self, path: Path) -> None:
        """Raise SemvizError if a link leads from the cache to somebody's image of the same name."""
        within = self.cache.parent.resolve() / self.cache.name / path.parent.name
        if path.exists() and path.parent.resolve() != within:
            raise SemvizError(
                f"{path}: not replaced, because a link leads there from {self.cache.parent}; "
                "delete that image, or the link"
            )

    def original_path(self, index: int, side: Side) -> Path:
        """Return the path of a recorded image. Raise SemvizError for a frame or side not there."""
        paths = self.left if side == "left" else self.right
        if not paths:
            raise SemvizError(f"{self.map_frame.name}: one camera; there is no right image")
        path = paths.get(index)
        if path is None:
            first, last = self.frames[0].index, self.frames[-1].index
            raise SemvizError(
                f"{self.map_frame.name}: no frame {index} among frames {first} to {last}"
            )
        if not path.is_file():
            raise SemvizError(f"{path}: no such image; copy it there again")
        return path

    def rectification(self, index: int, side: Side) -> Rectification:
        """Return how an image is rectified. Raise SemvizError for a side not there."""
        camera = self.camera_of.get(index)
        rectified = self.rectified if camera is None else self.rectified_cameras[camera]
        return rectified.of(side)

    def to_original(self, pixels_px: FloatArray, index: int, side: Side) -> FloatArray:
        """Return pixels (n, 2) of the recorded image at pixels (n, 2) of the rectified one."""
        return self.rectification(index, side).to_original(pixels_px)


def _read_image(path: Path, width: int, height: int) -> ByteImage:
    image = limits.read_image(path)
    if image.shape[:2] != (height, width):
        raise SemvizError(
            f"{path}: image is {image.shape[1]}x{image.shape[0]}, but its camera's are "
            f"{width}x{height}; all must be of one size"
        )
    return np.ascontiguousarray(image, dtype=np.uint8)


def _write_png(path: Path, image: ByteImage, changed_ns: int) -> None:
    import cv2

    done, data = cv2.imencode(".png", image[:, :, ::-1], [cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL])
    if not done:
        raise SemvizError(f"{path}: the rectified image cannot be written as PNG")
    with replacing(path) as temporary:
        temporary.write_bytes(data.tobytes())
        os.utime(temporary, ns=(changed_ns, changed_ns))
