"""List the images of a drive and their times, in pairs for stereo, and read them as a dataset.

A dataset is a folder of images, two for stereo, or the folders of a rig's cameras. Its images are
rectified as they are asked for.
"""

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from semviz_core.base.camera import Rig
from semviz_core.base.frame import Frame, Side
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame
from semviz_core.common import limits
from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.datasets.own_drive.rectification import Rectification, RectifiedRig
from semviz_core.datasets.trajectory import MOST_LINES, read_text

SUFFIXES = (".png", ".jpg", ".jpeg")
TimeUnit: TypeAlias = Literal["s", "ms", "us", "ns"]
_SECONDS: dict[TimeUnit, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_UNUSUAL = re.compile(r"[\\\x00-\x1f\x7f\ud800-\udfff]")
"""In names of images: neither files of a drive nor other systems could hold them."""
_LARGEST = 1e25
MOST_PAIR_S = 0.002
"""Between the images of a stereo pair; a car at 20 m/s moves 4 cm."""
_TIME_DIGITS = 10
"""A name of so many digits is a time since 1970: seconds, or a smaller unit."""


@dataclass(frozen=True)
class LeftOutImage:
    """An image that is left out of a workspace, or of its maps and runs."""

    file: str
    """Its name, in the folder of its side."""
    side: Side
    time_s: float | None
    """None: not known."""
    reason: str
    """For people."""
    camera: str = ""
    """Of a rig."""


@dataclass(frozen=True)
class ImageNames:
    """Images of one or two folders; those of one row belong to one frame."""

    left: tuple[str, ...]
    right: tuple[str, ...] = ()
    """As many as ``left``, or none."""
    unpaired: tuple[LeftOutImage, ...] = ()
    """Images without one on the other side."""
    missing: tuple[LeftOutImage, ...] = ()
    """Images that a recording lists and that are not there."""
    paired: Literal["by name", "in order", "by time"] = "by name"
    """How pairs were made; in order if no names agree, but their count."""


def folder_of(path: Path) -> Path:
    """Return the folder of images that a user names: itself, or ``folder/*_left.png``."""
    return path.parent if "*" in path.name else path


def list_images(left: Path, right: Path | None) -> ImageNames:
    """Return the images of a folder, in the order of the numbers in their names, then names.

    A path may end with a pattern such as ``*_left.png``, for cameras in one folder. Pairs have the
    same name but for the ending, or the same text in the place of the star. If no names agree, but
    their count, images are paired in order. Raise SemvizError if a folder has no images, or no
    pairs can be made.
    """
    names = _names(left)
    if right is None:
        return ImageNames(tuple(names))
    if right.resolve() == left.resolve():
        raise SemvizError(f"{right}: given for --images and --right; name the right camera's one")
    right_names = _names(right)
    others = {_varying(name, right): name for name in right_names}
    keys = [(_varying(name, left), name) for name in names]
    pairs = [(name, others[key]) for key, name in keys if key in others]
    if not pairs and len(names) == len(others):
        return ImageNames(tuple(names), tuple(others.values()), paired="in order")
    if not pairs:
        raise SemvizError(
            f"{right}: {len(others)} images, and none is called like one of the {len(names)} in "
            f"{left}; rename them, or leave out --right"
        )
    paired_left, paired_right = zip(*pairs, strict=True)
    reason = "no match by name in the other camera"
    unpaired = (
        *_unpaired("left", names, paired_left, reason),
        *_unpaired("right", right_names, paired_right, reason),
    )
    return ImageNames(paired_left, paired_right, unpaired)


def _unpaired(
    side: Side,
    names: Sequence[str],
    paired: Iterable[str],
    reason: str,
    time_s: Sequence[float] | None = None,
) -> list[LeftOutImage]:
    used = set(paired)
    times: Sequence[float | None] = [None] * len(names) if time_s is None else time_s
    return [
        LeftOutImage(name, side, moment, reason)
        for name, moment in zip(names, times, strict=True)
        if name not in used
    ]


def _varying(name: str, path: Path) -> str:
    """Return what tells an image from others of its camera: the name, or what a star stands for."""
    head, _, tail = (path.name if "*" in path.name else "*").partition("*")
    varying = name[len(head) : len(name) - len(tail)]
    return Path(varying).stem if Path(varying).suffix.lower() in SUFFIXES else varying


def pairs_by_time(
    left: Sequence[str],
    left_s: FloatArray,
    right: Sequence[str],
    right_s: FloatArray,
    missing: Sequence[LeftOutImage] = (),
    most_apart_s: float = MOST_PAIR_S,
) -> tuple[ImageNames, list[int]]:
    """Pair images that were taken within ``most_apart_s``, each once; both are in order of time.

    Return their names, and their rows in ``left``. Raise SemvizError if there are no pairs.
    """
    pairs: list[tuple[int, int]] = []
    for row, moment in enumerate(left_s.tolist()):
        nearest = int(np.abs(right_s - moment).argmin())
        mutual = int(np.abs(left_s - right_s[nearest]).argmin()) == row
        if mutual and abs(right_s[nearest] - moment) <= most_apart_s:
            pairs.append((row, nearest))
    if not pairs:
        raise SemvizError(
            f"no images of both cameras within {most_apart_s * 1e3:g} ms of each other: no stereo "
            "pair; choose one camera"
        )
    paired_left = tuple(left[row] for row, _ in pairs)
    paired_right = tuple(right[row] for _, row in pairs)
    reason = f"no match in the other camera within {most_apart_s * 1e3:g} ms"
    unpaired = (
        *_unpaired("left", left, paired_left, reason, left_s.tolist()),
        *_unpaired("right", right, paired_right, reason, right_s.tolist()),
    )
    names = ImageNames(paired_left, paired_right, unpaired, tuple(missing), "by time")
    return names, [row for row, _ in pairs]


def _names(path: Path) -> list[str]:
    folder, pattern = folder_of(path), path.name if "*" in path.name else "*"
    if not folder.is_dir():
        raise SemvizError(f"{folder}: no such folder of images; name another")
    if pattern.count("*") > 1:
        raise SemvizError(f"{path}: give one star, for what differs between images of a camera")
    head, _, tail = pattern.partition("*")
    found = [
        file.name
        for file in folder.iterdir()
        if file.suffix.lower() in SUFFIXES
        and not file.name.startswith(".")
        and len(file.name) >= len(head) + len(tail)
        and file.name.startswith(head)
        and file.name.endswith(tail)
    ]
    if not found:
        raise SemvizError(f"{path}: a folder without images; expected .png or .jpg")
    wrong = next((name for name in found if _UNUSUAL.search(name)), None)
    if wrong is not None:
        raise SemvizError(
            f"{folder}: an image is called {limits.shown(wrong, 80)}, with a backslash, a control "
            "character or bytes that are no text; rename it"
        )
    if len(found) > MOST_LINES:
        raise SemvizError(f"{path}: more than {MOST_LINES} images; split the drive")
    return sorted(found, key=lambda name: (_numbers_as_numbers(name), name))


def _numbers_as_numbers(name: str) -> list[tuple[int, int | str]]:
    """Return a key that puts ``image_10`` behind ``image_9``."""
    parts = re.findall(r"\d+|\D+", name)
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in parts]


def size_of_images(folder: Path, names: Sequence[str]) -> tuple[int, int]:
    """Return width and height of the first image, from its header.

    Raise SemvizError if it is not readable, or the middle or the last one has another size.
    """
    sizes = []
    for name in dict.fromkeys((names[0], names[len(names) // 2], names[-1])):
        path = folder / name
        size = limits.check_image_size(limits.read_limited(path, limits.MOST_IMAGE_BYTES), path)
        sizes.append(size)
        if size != sizes[0]:
            raise SemvizError(
                f"{path}: image is {size[0]}x{size[1]}, but {names[0]} is "
                f"{sizes[0][0]}x{sizes[0][1]}; all must be of one size"
            )
    return sizes[0]


@dataclass(frozen=True, eq=False)
class ImageTimes:
    """When images were taken, and how that is known."""

    time_s: FloatArray
    source: str
    """For people."""
    unit: TimeUnit | None = None
    """Of the numbers read."""


def times_from_names(names: Sequence[str], unit: TimeUnit | None) -> ImageTimes | None:
    """Return the times that names such as ``1403715273262142976.png`` are; None if they are not."""
    stems = [Path(name).stem for name in names]
    if not all(re.fullmatch(rf"\d{{{_TIME_DIGITS},}}(\.\d+)?", stem) for stem in stems):
        return None
    time_s, unit = in_seconds(stems, unit)
    return ImageTimes(time_s, "names of the images", unit)


def read_times(path: Path, names: Sequence[str], unit: TimeUnit | None) -> ImageTimes:
    """Return the times of images from a file with one line for each.

    A line names its image before or behind the time, in any order (``time,name``), or all lines
    are numbers, of which the first is the time of the next image. Raise SemvizError if an image
    has none.
    """
    lines = [
        re.split(r"[\s,;]+", line.strip())
        for line in read_text(path).splitlines()
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if lines and not any(map(is_number, lines[0])):
        lines = lines[1:]  # the names of columns
    by_name = {}
    for row in lines:
        texts = [word for word in row[:2] if Path(word).suffix.lower() in SUFFIXES]
        numbers = [word for word in row[:2] if is_number(word)]
        if texts and numbers:
            by_name[Path(texts[0]).name] = numbers[0]
    if by_name:
        missing = [name for name in names if name not in by_name]
        if missing:
            raise SemvizError(
                f"{path}: no time for {limits.shown(missing[0], 80)} and {len(missing) - 1} others "
                f"of {len(names)} images; complete the file"
            )
        words: Iterable[str] = [by_name[name] for name in names]
    elif len(lines) != len(names):
        raise SemvizError(
            f"{path}: {len(lines)} lines for {len(names)} images; give each image's time in its "
            "own line, or its name beside it"
        )
    else:
        words = [row[0] for row in lines]
    time_s, unit = in_seconds(list(words), unit, path)
    if (np.diff(time_s) < 0.0).any() and not by_name:
        raise SemvizError(f"{path}: times go backwards; put the images' names beside them")
    return ImageTimes(time_s, path.name, unit)


def is_number(word: str) -> bool:
    """Whether a word is a number, and not so large that its square would be infinite."""
    try:
        return abs(float(word)) < _LARGEST
    except ValueError:
        return False


def in_seconds(
    words: Sequence[str], unit: TimeUnit | None, where: object = "times"
) -> tuple[FloatArray, TimeUnit]:
    """Return times (n,) in s, and their unit, which the size of the first tells if not given.

    Times since 1970 have 10 digits in s, 13 in ms, 16 in us and 19 in ns.
    """
    wrong = next((word for word in words if not is_number(word)), None)
    if wrong is not None:
        raise SemvizError(f"{where}: {limits.shown(wrong, 40)!r} is not a time; repair it")
    values = np.array([float(word) for word in words])
    if unit is None:
        first = float(np.abs(values).max()) if len(values) else 0.0
        unit = "s" if first < 1e11 else "ms" if first < 1e14 else "us" if first < 1e17 else "ns"
    return values * _SECONDS[unit], unit


_PNG_LEVEL = 1
"""Larger levels take several times as long, for a tenth less space."""


@dataclass(frozen=True, eq=False)
class ImageFolder:
    """A ``Dataset`` of recorded images.

    A rectified image is made when it is first asked for, and kept in ``cache`` as PNG, so that
    labels and measurements of all times see the same pixels. Its file has the recorded image's time
    of change, and is made again if that changes. Images that need no rectification are read as they
    are.
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
        if rectification.is_identity:
            return original
        path = self._rectified_path(index, side)
        changed_ns = original.stat().st_mtime_ns
        if not self.is_rectified(index, side):
            self._check_replaceable(path)
            recorded = rectification.original
            image = _read_image(original, recorded.width, recorded.height)
            _write_png(path, rectification.rectify(image), changed_ns)
        return path

    def is_rectified(self, index: int, side: Side) -> bool:
        """Whether a rectified image is made, or none is needed."""
        if self.rectification(index, side).is_identity:
            return True
        path, original = self._rectified_path(index, side), self.original_path(index, side)
        return path.is_file() and path.stat().st_mtime_ns == original.stat().st_mtime_ns

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
