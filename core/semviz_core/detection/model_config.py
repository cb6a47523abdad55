"""Read how to use an external model: its classes, its input, its preprocessing.

Settings come from a TOML file, and for transformers from ``preprocessor_config.json``. Class
names or numbers map to semviz classes, the rest is ignored; the default mapping covers the labels
of Cityscapes, Mapillary, ADE20K and COCO. The input rules also give the placement of the image in
the model's input, with pixel (0, 0) at the centre of the first pixel in both.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import shorten
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from semviz_core.base.classes import ClassSet
from semviz_core.common.arrays import BoolArray, ByteImage, FloatArray, IntArray
from semviz_core.common.errors import SemvizError, require_extra
from semviz_core.common.limits import first_line, read_toml, shown

SIGN = -1
"""A sign of unknown shape."""
IGNORED = -2
"""Not a pole or a sign."""
_WORDS = {"sign": SIGN, "ignore": IGNORED}

_POLES = ("pole", "utility pole", "street light", "streetlight")
_SIGNS = ("traffic sign", "traffic sign front", "street sign", "stop sign")
_BEFORE = ("object ", "support ")
"""Prefixes of labels, as in Mapillary's ``object--support--utility-pole``."""


@dataclass(frozen=True, eq=False)
class ModelClasses:
    """The classes of a model, in its order."""

    target: IntArray
    """(c,) class ids of semviz, ``SIGN`` or ``IGNORED``."""
    lines: frozenset[int]
    """The targets that are lines: poles."""

    def __len__(self) -> int:
        return len(self.target)

    @property
    def wanted(self) -> tuple[int, ...]:
        """The targets without ``IGNORED``, in order."""
        return tuple(int(target) for target in np.unique(self.target) if target != IGNORED)


def model_classes(
    labels: Sequence[str], mapping: Mapping[str, str], classes: ClassSet, path: Path
) -> ModelClasses:
    """Return the semviz classes of a model's labels; labels without a mapping are ignored.

    ``mapping`` goes from labels (or their numbers as text) to class names; ``path`` is its file.
    Raise SemvizError if it names an unknown label or class, or no pole or sign at all.
    """
    target = np.full(len(labels), IGNORED)
    ours = _WORDS | {class_.name: class_.id for class_ in classes}
    for label, name in mapping.items():
        if name not in ours:
            raise SemvizError(
                f"{path}: classes: {label!r} cannot be {name!r}; known are {', '.join(ours)}"
            )
        target[_index(labels, label, path)] = ours[name]
    if (target == IGNORED).all():
        raise SemvizError(f"{path}: classes: no class of the model is a pole or a sign; name one")
    return ModelClasses(target, frozenset(class_.id for class_ in classes if class_.kind == "line"))


def default_classes(labels: Sequence[str]) -> dict[str, str]:
    """Return the default mapping for labels of Cityscapes, Mapillary, ADE20K and COCO."""
    means = dict.fromkeys(_POLES, "pole") | dict.fromkeys(_SIGNS, "sign")
    names = {label: means.get(_plain(label)) for label in labels}
    return {label: name for label, name in names.items() if name is not None}


def _plain(label: str) -> str:
    words = " ".join(re.findall("[a-z]+", label.lower()))
    for prefix in _BEFORE:
        words = words.removeprefix(prefix)
    return words


def _index(labels: Sequence[str], label: str, path: Path) -> int:
    if label in labels:
        return labels.index(label)
    if label.isdecimal() and int(label) < len(labels):
        return int(label)
    some = ", ".join(labels[:20]) + (", ..." if len(labels) > 20 else "")
    raise SemvizError(
        f"{path}: classes: the model has no class {shown(label)!r}; it has {shown(some)}"
    )


Settings = TypeVar("Settings", bound=BaseModel)


def read_settings(path: Path, kind: type[Settings]) -> Settings:
    """Read a TOML file. Raise SemvizError if it is unreadable or does not validate as ``kind``."""
    if not path.exists():
        raise SemvizError(f"{path}: no such file; name the TOML that describes a model")
    raw = read_toml(path)
    try:
        return kind.model_validate(raw)
    except ValidationError as error:
        raise SemvizError(f"{path}: {first_error(error)}; repair it") from None


def first_error(error: ValidationError) -> str:
    """Return place and message of the first error, for people."""
    first = error.errors()[0]
    message = first["msg"].removeprefix("Value error, ")
    where = ".".join(str(part) for part in first["loc"])
    return first_line(f"{where}: {message}" if where else message)


Maps = NDArray[np.float32]
"""(k, height, width) one number for each pixel and class."""
LEAST_SIDE, LARGEST_SIDE = 16, 8192
"""Limits of a model's input, in pixels."""
_PAD = 114
"""Grey value beside a letterboxed image, as in YOLO."""


class ImagePlacement(NamedTuple):
    """Scale and offset of an image in a model's input.

    Pixel (0, 0) of both is the centre of the first pixel, so
    ``input + 0.5 = scale (image + 0.5) + offset``.
    """

    image_size: tuple[int, int]
    """Width and height."""
    input_size: tuple[int, int]
    scale: FloatArray
    """(2,) of width and height."""
    offset: FloatArray
    """(2,) of the image's corner, pixels of the input."""

    def boxes_px(self, edges: FloatArray) -> FloatArray:
        """Return (n, 4) left, top, right, bottom in the image, clipped to it.

        ``edges`` are those in the input, measured from its corner.
        """
        box_px = (edges.reshape(-1, 2, 2) - self.offset) / self.scale - 0.5
        last = np.array(self.image_size) - 1.0
        return np.asarray(np.clip(box_px, 0.0, last).reshape(-1, 4))

    def maps(self, maps: Maps) -> Maps:
        """Return maps (k, height, width) of the image from maps of the input, bilinearly.

        The input's maps may have any resolution. Values are 0 where the input lacks the image.
        """
        import cv2

        width, height = self.image_size
        in_image = np.empty((len(maps), height, width), np.float32)
        if self._is_stretched:  # a third of the time, with the same centres of pixels
            for channel, target in zip(maps, in_image, strict=True):
                cv2.resize(channel, self.image_size, target, interpolation=cv2.INTER_LINEAR)
            return in_image
        shrunk = np.array([maps.shape[2], maps.shape[1]]) / self.input_size
        scale = self.scale * shrunk
        shift = (0.5 * self.scale + self.offset) * shrunk - 0.5
        matrix = np.column_stack([np.diag(scale), shift])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        for channel, target in zip(maps, in_image, strict=True):
            cv2.warpAffine(
                channel, matrix, self.image_size, target, flags, borderMode=cv2.BORDER_REPLICATE
            )
        columns, rows = (self._shown(axis) for axis in (0, 1))
        in_image[:, ~rows] = 0.0
        in_image[:, :, ~columns] = 0.0
        return in_image

    @property
    def _is_stretched(self) -> bool:
        """Whether the image fills the input."""
        filled = np.abs(self.scale * self.image_size - self.input_size).max() < 1e-6
        return bool(filled and not self.offset.any())

    def _shown(self, axis: int) -> BoolArray:
        """Return which columns (0) or rows (1) of the image the input shows."""
        place = self.scale[axis] * (np.arange(self.image_size[axis]) + 0.5) + self.offset[axis]
        return np.asarray((place >= 0.0) & (place <= self.input_size[axis]))


def check_image(image: ByteImage) -> None:
    """Raise SemvizError if ``image`` is not (height, width, 3) bytes."""
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
        raise SemvizError(
            f"an image of shape {image.shape} and type {image.dtype}: give (height, width, 3) "
            "bytes, sRGB"
        )


class ModelInput(BaseModel):
    """A model's input: (1, 3, height, width) numbers ``(scale pixel - mean) / std``."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    width: int = Field(ge=LEAST_SIDE, le=LARGEST_SIDE)
    height: int = Field(ge=LEAST_SIDE, le=LARGEST_SIDE)
    resize: Literal["stretch", "letterbox"] = "letterbox"
    """``letterbox`` keeps proportions, with the image centred on grey."""
    colors: Literal["rgb", "bgr"] = "rgb"
    scale: float = Field(default=1.0 / 255.0, gt=0.0, allow_inf_nan=False)
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def model_post_init(self, _: Any) -> None:
        if not (np.isfinite([*self.mean, *self.std]).all() and min(self.std) > 0.0):
            raise ValueError("mean and std must be finite numbers, and std above 0")

    def placement(self, image: ByteImage) -> ImagePlacement:
        """Return the image's placement. Raise SemvizError if it is not (height, width, 3) bytes."""
        check_image(image)
        height, width = image.shape[:2]
        size, input_size = np.array([width, height]), np.array([self.width, self.height])
        scale = input_size / size
        if self.resize == "letterbox":
            scale = np.maximum(np.round(size * scale.min()), 1.0) / size
        offset = (input_size - np.round(size * scale)) // 2
        return ImagePlacement(
            (width, height), (self.width, self.height), scale, offset.astype(np.float64)
        )

    def tensor(self, image: ByteImage, placement: ImagePlacement) -> NDArray[np.float32]:
        """(1, 3, height, width)."""
        columns, rows = np.round(np.array(placement.image_size) * placement.scale).astype(int)
        left, top = placement.offset.astype(int)
        canvas = np.full((self.height, self.width, 3), _PAD, np.uint8)
        canvas[top : top + rows, left : left + columns] = _resized(image, int(columns), int(rows))
        ordered = canvas if self.colors == "rgb" else canvas[..., ::-1]
        mean, std = np.array([self.mean, self.std], np.float32)
        values = (ordered.astype(np.float32) * np.float32(self.scale) - mean) / std
        return np.ascontiguousarray(values.transpose(2, 0, 1)[None])


def _resized(image: ByteImage, columns: int, rows: int) -> ByteImage:
    """Resize by means where a side shrinks, so thin poles stay, and bilinearly where it grows.

    One side at a time, since OpenCV averages only if both shrink.
    """
    import cv2

    for size in ((columns, image.shape[0]), (columns, rows)):
        shrinks = size[0] < image.shape[1] or size[1] < image.shape[0]
        method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        image = np.asarray(cv2.resize(image, size, interpolation=method), np.uint8)
    return image


FILE = "preprocessor_config.json"


@dataclass(frozen=True, eq=False)
class ProcessorInput:
    """A model's input, like ``ModelInput``, made by the image processor of the model's folder."""

    path: Path
    """The processor's configuration file."""
    processor: Any
    size: tuple[int, int] | None = None
    """Width and height to which images are stretched; default: the processor's."""
    _placements: dict[tuple[int, int], ImagePlacement] = field(default_factory=dict)

    @classmethod
    def load(cls, folder: Path, size: tuple[int, int] | None = None) -> "ProcessorInput":
        """Load the processor of a model's folder, without downloads or the model's own code.

        Raise SemvizError if the file is missing, or transformers cannot read it.
        """
        path = folder / FILE
        if not path.is_file():
            raise SemvizError(f"{path}: cannot be read; it describes the model's input")
        require_extra(str(path), "transformers", "transformers")
        from transformers import AutoImageProcessor

        try:  # Pillow's resizing is the same on every machine
            processor = AutoImageProcessor.from_pretrained(
                folder, backend="pil", local_files_only=True, trust_remote_code=False
            )
        except Exception as error:  # its errors are of many kinds
            raise SemvizError(f"{path}: {_line(error)}") from None
        return cls(path, processor, size)

    def placement(self, image: ByteImage) -> ImagePlacement:
        """Return the image's placement, from the processor's response to probe images.

        Raise SemvizError if the image is not (height, width, 3) bytes, or if the processor does
        more than resize, crop and pad it.
        """
        check_image(image)
        height, width = image.shape[:2]
        if (width, height) not in self._placements:
            probe = _ResponseProbe.of(self, width, height)
            sides = probe.side(0), probe.side(1)
            if None in sides:
                raise SemvizError(
                    f"{self.path}: does more than resize, crop and pad images; use another model"
                )
            scale, offset = np.array(sides, np.float64).T
            self._placements[width, height] = ImagePlacement(
                (width, height), (probe.black.shape[1], probe.black.shape[0]), scale, offset
            )
        return self._placements[width, height]

    def tensor(
        self, image: ByteImage, _placement: ImagePlacement | None = None
    ) -> NDArray[np.float32]:
        """(1, 3, height, width)."""
        options: dict[str, Any] = {}
        if self.size is not None:
            size = dict(zip(("width", "height"), self.size, strict=True))
            options = {"do_resize": True, "size": size, "do_center_crop": False}
        try:
            processed = self.processor(
                image, return_tensors="np", input_data_format="channels_last", **options
            )
            tensor = np.asarray(processed["pixel_values"], np.float32)
        except Exception as error:  # its errors are of many kinds
            raise SemvizError(f"{self.path}: {_line(error)}") from None
        fits = all(LEAST_SIDE <= side <= LARGEST_SIDE for side in tensor.shape[2:])
        if tensor.shape[:2] != (1, 3) or not fits:
            raise SemvizError(
                f"{self.path}: an image of shape {image.shape} would become {tensor.shape}; give a "
                f"size of {LEAST_SIDE} to {LARGEST_SIDE} pixels"
            )
        return tensor


@dataclass(frozen=True, eq=False)
class _ResponseProbe:
    """The response of a processor to probe images of one size."""

    model_input: ProcessorInput
    image_size: tuple[int, int]
    """Width and height."""
    black: FloatArray
    """(height, width) response to a black image, the mean of its channels."""
    span: FloatArray
    """(height, width) white minus black; 0 where the input does not show the image."""

    @classmethod
    def of(cls, model_input: ProcessorInput, width: int, height: int) -> "_ResponseProbe":
        nothing = np.zeros((height, width), np.uint8)
        black, white = _gray(model_input, nothing), _gray(model_input, nothing + 255)
        span = np.where(np.isclose(white, black), 0.0, white - black)
        return cls(model_input, (width, height), black, span)

    def side(self, axis: int) -> tuple[float, float] | None:
        """Return scale and offset along the columns (0) or the rows (1); see ``ImagePlacement``.

        The image is assumed to fill a whole number of pixels from a whole pixel on. None if that
        does not explain the response.
        """
        pixel, length = np.flatnonzero(self.span.any(axis=axis)), self.image_size[axis]
        if len(pixel) < LEAST_SIDE:
            return None
        place = self._shares(axis, np.linspace(0.0, 255.0, length).round(), pixel) * (length - 1)
        slope, first = np.polyfit(pixel - pixel[0], place, 1)
        if not slope > 0.0:
            return None
        low, high = np.clip([first, first + slope * len(pixel)], 0.0, length)
        edges = np.round([0.9 * low + 0.1 * high, 0.1 * low + 0.9 * high]).astype(int)
        found = [pixel[0] + self._edge(axis, int(edge), pixel) for edge in edges]
        scale = round(length * (found[1] - found[0]) / (edges[1] - edges[0])) / length
        offset = float(round(np.mean(found - scale * edges)))
        off = (pixel + 0.5 - offset) / scale - 0.5 - place
        allowed = 1.0 + 1.0 / scale + length / 255.0  # of kernels, and of brightness in bytes
        return (scale, offset) if scale > 0.0 and np.abs(off).max() <= allowed else None

    def _edge(self, axis: int, at: int, pixel: IntArray) -> float:
        """Return how many of ``pixel`` (k,) show the image before ``at``, to 0.01 of a pixel."""
        length = self.image_size[axis]
        return float(self._shares(axis, np.where(np.arange(length) < at, 255.0, 0.0), pixel).sum())

    def _shares(self, axis: int, brightness: FloatArray, pixel: IntArray) -> FloatArray:
        """Return (k,) the brightness (0 to 1) of each ``pixel`` (k,), for an image with this
        ``brightness`` along an axis and constant across it."""
        shown = brightness.astype(np.uint8)[:, None] if axis else brightness.astype(np.uint8)
        width, height = self.image_size
        seen = _gray(self.model_input, np.broadcast_to(shown, (height, width))) - self.black
        return np.asarray(seen.sum(axis=axis)[pixel] / self.span.sum(axis=axis)[pixel])


def _gray(model_input: ProcessorInput, gray: NDArray[np.uint8]) -> FloatArray:
    """Return the input (height, width) of a grey image: the mean of its channels."""
    image = np.repeat(gray[..., None], 3, axis=2)
    return np.asarray(model_input.tensor(image)[0].mean(axis=0), np.float64)


def _line(error: Exception) -> str:
    """Return the beginning of the library's message, which may be long."""
    return shorten(str(error), 240, placeholder=" ...") or type(error).__name__
