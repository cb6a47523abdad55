"""How a model wants its images, and where what it says of them lies in the image."""

from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from semviz_core.arrays import ByteImage, FloatArray
from semviz_core.errors import SemvizError

Maps = NDArray[np.float32]
"""(k, height, width) one number for each pixel and kind."""
LARGEST_SIDE = 8192
_PAD = 114
"""The grey beside a letterboxed image, as YOLO models know it."""


class Placing(NamedTuple):
    """Where an image lies in a model's input. Pixel (0, 0) of either is the centre of its first.

    Between them edges count, not centres: ``input + 0.5 = scale (image + 0.5) + offset``.
    """

    image_size: tuple[int, int]
    """Width and height."""
    input_size: tuple[int, int]
    scale: FloatArray
    """(2,) of width and height."""
    offset: FloatArray
    """(2,) of the image's corner, pixels of the input."""

    def boxes_px(self, edges: FloatArray) -> FloatArray:
        """(n, 4) left, top, right, bottom in the image, cut at its border.

        ``edges`` are those in the input, from its corner, as models count.
        """
        box_px = (edges.reshape(-1, 2, 2) - self.offset) / self.scale - 0.5
        last = np.array(self.image_size) - 1.0
        return np.asarray(np.clip(box_px, 0.0, last).reshape(-1, 4))

    def maps(self, maps: Maps) -> Maps:
        """(k, height, width) of the image, from maps of the input at any resolution; bilinear."""
        import cv2

        shrunk = np.array([maps.shape[2], maps.shape[1]]) / self.input_size
        scale = self.scale * shrunk
        shift = (0.5 * self.scale + self.offset) * shrunk - 0.5
        matrix = np.column_stack([np.diag(scale), shift])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.stack(
            [
                cv2.warpAffine(
                    one, matrix, self.image_size, flags=flags, borderMode=cv2.BORDER_REPLICATE
                )
                for one in maps
            ]
        )


class ModelInput(BaseModel):
    """What a model takes: (1, 3, height, width) numbers ``(scale pixel - mean) / std``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    width: int = Field(ge=16, le=LARGEST_SIDE)
    height: int = Field(ge=16, le=LARGEST_SIDE)
    resize: Literal["stretch", "letterbox"] = "letterbox"
    """``letterbox`` keeps proportions, with the image in the middle and grey beside it."""
    colors: Literal["rgb", "bgr"] = "rgb"
    scale: float = Field(default=1.0 / 255.0, gt=0.0, allow_inf_nan=False)
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def model_post_init(self, _: Any) -> None:
        if not (np.isfinite([*self.mean, *self.std]).all() and min(self.std) > 0.0):
            raise ValueError("mean and std must be finite numbers, and std above 0")

    def placing(self, image: ByteImage) -> Placing:
        """Raises SemvizError where that is no (height, width, 3) image of bytes."""
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
            raise SemvizError(
                f"an image of shape {image.shape} and type {image.dtype}: give (height, width, 3) "
                "bytes, sRGB"
            )
        height, width = image.shape[:2]
        size, room = np.array([width, height]), np.array([self.width, self.height])
        scale = room / size
        if self.resize == "letterbox":
            scale = np.maximum(np.round(size * scale.min()), 1.0) / size
        offset = (room - np.round(size * scale)) // 2
        return Placing((width, height), (self.width, self.height), scale, offset.astype(np.float64))

    def tensor(self, image: ByteImage, placing: Placing) -> NDArray[np.float32]:
        """(1, 3, height, width)."""
        columns, rows = np.round(np.array(placing.image_size) * placing.scale).astype(int)
        left, top = placing.offset.astype(int)
        canvas = np.full((self.height, self.width, 3), _PAD, np.uint8)
        canvas[top : top + rows, left : left + columns] = _resized(image, int(columns), int(rows))
        ordered = canvas if self.colors == "rgb" else canvas[..., ::-1]
        mean, std = np.array([self.mean, self.std], np.float32)
        values = (ordered.astype(np.float32) * np.float32(self.scale) - mean) / std
        return np.ascontiguousarray(values.transpose(2, 0, 1)[None])


def _resized(image: ByteImage, columns: int, rows: int) -> ByteImage:
    """Means where a side shrinks: thin poles would fall between samples. Bilinear where it grows.

    A side at a time, since OpenCV takes means only where both shrink.
    """
    import cv2

    for size in ((columns, image.shape[0]), (columns, rows)):
        shrinks = size[0] < image.shape[1] or size[1] < image.shape[0]
        method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        image = np.asarray(cv2.resize(image, size, interpolation=method), np.uint8)
    return image
