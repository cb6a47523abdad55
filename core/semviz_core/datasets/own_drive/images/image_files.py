"""List the images of a drive and their times, in pairs for stereo."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from semviz_core.base.frame import Side
from semviz_core.common import limits
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.trajectory import MOST_LINES, read_text

_VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".hevc", ".m4v", ".webm")
_EXIF_BYTES = 2**12
_DARK = 2**14
"""Images of 16 bits that are never brighter: of 12 bits or less."""
_OTHERS = (".tif", ".tiff", ".webp", ".bmp", ".pgm", ".ppm", ".jp2", ".heic", ".exr")
_MOST_LOOKED_AT = 2000
SUFFIXES = (".png", ".jpg", ".jpeg")
TimeUnit: TypeAlias = Literal["s", "ms", "us", "ns"]
_SECONDS: dict[TimeUnit, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_UNUSUAL = re.compile(r"[\\\x00-\x1f\x7f\ud800-\udfff]")
"""In names of images: neither files of a drive nor other systems could hold them."""
_LARGEST = 1e25
_JPEG_START, _JPEG_SCAN, _PNG_START = b"\xff\xd8\xff", b"\xda", b"\x89PNG\r\n\x1a\n"
_JPEG_END, _PNG_END = b"\xff\xd9", b"\0\0\0\0IEND\xaeB`\x82"
_HEAD_BYTES, _TAIL_BYTES = 2**16, 2**10
"""Read of an image, to tell whether it is whole."""
MOST_PAIR_S = 0.002
"""Between the images of a stereo pair; a car at 20 m/s moves 4 cm."""
_NAMED_TIME = re.compile(r"(|.*[^\d.])([1-9]\d{9,}(?:\.\d+)?)")
"""A number of ten digits or more, as ``1403715273262142976`` or ``left_1403715273.262143``, is a
time since 1970; one that begins with 0 counts images."""
_SINCE_S, _UNTIL_S = 0.3e9, 4.2e9
"""1979 to 2103."""
_SPLIT_TIME = re.compile(r"(|.*[^\d.])([1-9]\d{9})[-_](\d{9})")
"""Seconds and nanoseconds."""


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


UnusableImages: TypeAlias = tuple[tuple[int, LeftOutImage], ...]
"""Damaged images, and those of another size, each with the row of its name."""


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


def _images_below(folder: Path) -> Path | None:
    """Return the first folder with images within a folder, not deep and not for long."""
    for depth in ("*", "*/*", "*/*/*", "*/*/*/*"):
        for path in islice(folder.glob(depth), _MOST_LOOKED_AT):
            if path.suffix.lower() in SUFFIXES:
                return path.parent
    return None


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
        if folder.suffix.lower() in _VIDEOS:
            raise SemvizError(
                f"{folder}: a video; write its images first, all of them: ffmpeg -i {folder.name} "
                "images/%06d.png"
            )
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
        below = _images_below(folder)
        there = "" if below is None else f"; there are some in {below}: name that one"
        if other := next((o for f in folder.iterdir() if (o := f.suffix.lower()) in _OTHERS), ""):
            there = f"; convert its {other} files: mogrify -format png *{other}"
        raise SemvizError(f"{path}: a folder without images; expected .png or .jpg{there}")
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
    """Return the size that most of three images have, by their headers; in doubt that of the first.

    Raise SemvizError if none is readable.
    """
    sizes, damaged = [], []
    for name in dict.fromkeys((names[0], names[len(names) // 2], names[-1])):
        path = folder / name
        try:
            data = limits.read_limited(path, limits.MOST_IMAGE_BYTES)
            sizes.append(limits.check_image_size(data, path))
        except SemvizError as error:
            damaged.append(error)
    if not sizes:
        raise damaged[0]
    return max(sizes, key=sizes.count)


def unusable_images(folder: Path, names: Sequence[str], size: tuple[int, int]) -> dict[str, str]:
    """Return why images cannot be used, by name: of another size, cut off, or no image at all.

    Only the start and the end of each are read; damage in between shows when it is decoded. Raise
    SemvizError if that is half of the images or more.
    """
    found = {name: why for name in names if (why := _why_unusable(folder / name, size))}
    if 2 * len(found) >= len(names):
        name, why = next(iter(found.items()))
        raise SemvizError(
            f"{folder}: {len(found)} of {len(names)} images cannot be used, such as "
            f"{limits.shown(name, 80)} ({why}); all must be whole, and {size[0]}x{size[1]}"
        )
    return found


def _why_unusable(path: Path, size: tuple[int, int]) -> str:
    """Return why an image cannot be used, for people; empty if it can."""
    try:
        found = size_of_whole_image(path)
    except SemvizError:
        return "not readable"
    if found is None:
        return "damaged or cut off"
    return "" if found == size else f"{found[0]}x{found[1]}, not {size[0]}x{size[1]}"


def size_of_whole_image(path: Path) -> tuple[int, int] | None:
    """Return width and height of a PNG or JPEG that has a header and an end; None without.

    Usually only its start and end are read. Raise SemvizError if ``read_limited`` does.
    """
    data = limits.read_limited(path, limits.MOST_IMAGE_BYTES, _HEAD_BYTES)
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - _TAIL_BYTES, 0))
        tail = file.read(_TAIL_BYTES)
    is_whole = tail.endswith(_PNG_END) if data.startswith(_PNG_START) else _JPEG_END in tail
    # with long metadata, or something behind the image, all of it is read
    if not is_whole or limits.image_size(data) is None:
        data = limits.read_limited(path, limits.MOST_IMAGE_BYTES)
        is_whole = is_whole or _has_jpeg_end(data)
    return limits.image_size(data) if is_whole else None


def _has_jpeg_end(data: bytes) -> bool:
    """Whether a JPEG ends behind the start of its pixels; a preview in front ends, too."""
    place = 2
    while data[place : place + 1] == b"\xff" and data[place + 1 : place + 2] != _JPEG_SCAN:
        place += 2 + int.from_bytes(data[place + 2 : place + 4], "big")
    return data.startswith(_JPEG_START) and data.find(_JPEG_END, place) > 0


def refuse_turned_or_dark(path: Path) -> None:
    """Raise SemvizError if an image is stored turned, or black when its upper 8 bits are shown.

    A calibration may be for turned pixels or not. Usual images are not decoded.
    """
    data = limits.read_limited(path, limits.MOST_IMAGE_BYTES)
    if b"Exif" in data[:_EXIF_BYTES] and limits.is_turned(data, path):
        raise SemvizError(
            f"{path}: is stored turned, with an EXIF orientation; turn the pixels of all images "
            "for good and calibrate these: mogrify -auto-orient *.jpg"
        )
    brightest = limits.brightest_of_16_bits(data, path)
    if brightest is not None and brightest < _DARK:
        raise SemvizError(
            f"{path}: an image of 16 bits whose brightest value is {brightest} of 65535; write all "
            "with 8 bits, from dark to bright: mogrify -normalize -depth 8 *.png"
        )


@dataclass(frozen=True, eq=False)
class ImageTimes:
    """When images were taken, and how that is known."""

    time_s: FloatArray
    source: str
    """For people."""
    unit: TimeUnit | None = None
    """Of the numbers read."""


def times_from_names(names: Sequence[str], unit: TimeUnit | None) -> ImageTimes | None:
    """Return the times in names such as ``1403715273262142976.png``; None if they are no times.

    All may begin with the same text: ``left_1403715273.262143.png``.
    """
    stems = [Path(name).stem for name in names]
    split = [_SPLIT_TIME.fullmatch(stem) for stem in stems]
    found = [_NAMED_TIME.fullmatch(stem) for stem in stems] if None in split else split
    words = [".".join(one.groups()[1:]) for one in found if one is not None]
    heads = {one[1] for one in found if one is not None}
    if len(words) < len(names) or len(heads) > 1:
        return None
    time_s, found_unit = in_seconds(words, unit)
    if unit is None and (time_s.min() < _SINCE_S or time_s.max() > _UNTIL_S):
        return None  # a date without separators
    return ImageTimes(time_s, "names of the images", found_unit)


def read_times(path: Path, names: Sequence[str], unit: TimeUnit | None) -> ImageTimes:
    """Return the times of images from a file with one line for each.

    A line names its image before or behind the time, in any order (``time,name``), or all lines
    are numbers, of which the first is the time of the next image. Raise SemvizError if an image
    has none.
    """
    lines = [
        _fields(line)
        for line in read_text(path).splitlines()
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if lines and not any(map(is_number, lines[0])):
        lines = lines[1:]  # the names of columns
    by_name = {}
    for row in lines:
        texts = [word for word in row if Path(word).suffix.lower() in SUFFIXES]
        numbers = [word for word in row if is_number(word)]
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


def _fields(line: str) -> list[str]:
    """Return the first two fields of a line; a name of an image may hold spaces and commas."""
    words = re.split(r"[\s,;]+", line.strip())
    if Path(words[-1].strip('"')).suffix.lower() in SUFFIXES and is_number(words[0]):
        return [words[0], line.strip().partition(words[0])[2].strip(' \t,;"')]
    named = re.fullmatch(r"(.+\.\w+)[\s,;\"]+(\S+)", line.strip())
    if named is not None and Path(named[1]).suffix.lower() in SUFFIXES and is_number(named[2]):
        return [named[1].lstrip('"'), named[2]]
    return words[:2]


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
