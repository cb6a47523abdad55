"""Cameras whose numbers a file names one by one, wherever it puts them, or lists in a known order.

Names are those of ORB-SLAM (``Camera1.fx``), VINS-Fusion (``projection_parameters: fx``), Basalt
and other JSON: fx, fy, cx, cy; k1 to k6, p1, p2; a width and a height. Lists are a matrix K of 3x3,
DROID-SLAM's ``fx fy cx cy`` with or without ``k1 k2 p1 p2 k3``, and the first two lines of DSO's
``camera.txt``. Without a size, that of the images counts if their middle is near the principal
point.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.cameras.calibration import (
    CalibrationFile,
    camera_of_numbers,
    focal_and_center,
    lens_model,
)
from semviz_core.datasets.own_drive.cameras.lens import LensModel
from semviz_core.datasets.own_drive.cameras.yaml_files import numbers_of
from semviz_core.datasets.own_drive.images.image_files import is_number
from semviz_core.datasets.trajectory import read_text

Size: TypeAlias = tuple[int, int]
_PINHOLE = ("fx", "fy", "cx", "cy")
_BROWN = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE = ("k1", "k2", "k3", "k4")
_SIZES = (("width", "height"), ("image_width", "image_height"), ("w", "h"), ("cols", "rows"))
_MODEL_NAMES = ("type", "model", "model_type", "camera_type", "camera_model", "distortion_model")
_OF_RECORDED = ("LEFT", "RIGHT")
"""Where ORB-SLAM2 keeps the recording cameras; its ``Camera`` is of rectified images then."""
_MOST_OFF_CENTER = 0.2
"""Of the size of images: farther off, a principal point is that of images of another size."""


def named_camera(
    path: Path, content: Mapping[str, Any], size: Size | None
) -> CalibrationFile | None:
    """Return the camera whose numbers a file names; None if it names none.

    ``size`` of the images counts if the file has none. Raise SemvizError if there are several
    cameras, their lens model is not read, or no size is known.
    """
    groups = _groups(content)
    found = [place for place, names in groups.items() if set(_PINHOLE) <= names.keys()]
    if not found:
        return None
    if len(found) > 1 or any(key.split(".")[0] in _OF_RECORDED for key in content):
        raise SemvizError(
            f"{path}: the numbers of several cameras ({', '.join(found) or 'Camera, LEFT'}); write "
            "those of the recorded images into a TOML file, as docs/own-drive.md shows"
        )
    (place,) = found
    terms = dict(groups[place])
    for other, names in groups.items():  # VINS-Fusion has them beside
        if other.rpartition(".")[2].startswith("distortion"):
            terms |= names
    model, distortion = _lens(path, groups, terms)
    numbers = numbers_of([terms[name] for name in _PINHOLE], (4,), f"{path}, {place or 'fx'}")
    size_px = _size_in(path, groups) or _taken(path, size, numbers)
    values = numbers_of(distortion, (None,), f"{path}, distortion")
    camera = camera_of_numbers(str(path), model, np.array(size_px, float), numbers, values)
    return CalibrationFile(path, "named numbers", (camera,))


def listed_camera(path: Path, size: Size | None) -> CalibrationFile | None:
    """Return the camera of a text file of numbers; None if it is none that is known."""
    lines = [
        line.split() for line in read_text(path).replace(",", " ").splitlines() if line.strip()
    ]
    if lines and not is_number(lines[0][0]) and len(lines) > 1:
        return _dso(path, lines[0], lines[1])
    words = [word for line in lines for word in line]
    if not words or not all(map(is_number, words)):
        return None
    values = np.array([float(word) for word in words])
    if len(values) == 9 and len(lines) == 3:
        numbers, distortion = focal_and_center(values.tolist(), str(path)), np.zeros(0)
    elif len(lines) == 1 and len(values) in (4, 8, 9):
        numbers, distortion = values[:4], values[4:]
    else:
        return None
    size_px = np.array(_taken(path, size, numbers), float)
    model: LensModel = "brown-conrady" if len(distortion) else "pinhole"
    camera = camera_of_numbers(str(path), model, size_px, numbers, distortion)
    return CalibrationFile(path, "listed numbers", (camera,))


def _dso(path: Path, first: list[str], second: list[str]) -> CalibrationFile | None:
    """Read a lens model with its numbers, then the size of images."""
    name, *words = first
    if len(words) not in (5, 8) or len(second) != 2 or not all(map(is_number, words + second)):
        return None
    values = np.array([float(word) for word in words])
    if values[2] < 1.0 and values[3] < 1.0:
        raise SemvizError(
            f"{path}: numbers relative to the size of images are not read; write a TOML file, as "
            "docs/own-drive.md shows"
        )
    if len(values) == 5 and values[4]:
        raise SemvizError(f"{path}: the lens model FOV is not read; calibrate with another one")
    distortion = values[4:] if len(values) == 8 else np.zeros(0)
    size = numbers_of(second, (2,), str(path))
    camera = camera_of_numbers(str(path), lens_model(path, name), size, values[:4], distortion)
    return CalibrationFile(path, "DSO", (camera,))


def _groups(content: Any) -> dict[str, dict[str, Any]]:
    """Return numbers and texts by their names, by the dotted path of what holds them."""
    groups: dict[str, dict[str, Any]] = {}
    for path, value in _leaves(content, ""):
        place, _, name = path.rpartition(".")
        groups.setdefault(place, {})[name] = value
    return groups


def _leaves(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _leaves(inner, f"{path}.{name}" if path else str(name))
    elif isinstance(value, list) and any(isinstance(inner, dict) for inner in value):
        for place, inner in enumerate(value):
            yield from _leaves(inner, f"{path}.{place}")
    elif not isinstance(value, list):
        yield path, value


def _lens(
    path: Path, groups: Mapping[str, Mapping[str, Any]], terms: Mapping[str, Any]
) -> tuple[LensModel, list[Any]]:
    """Return the lens model and its coefficients. Raise SemvizError if the names do not tell."""
    named = [names[key] for names in groups.values() for key in _MODEL_NAMES if key in names]
    models = {lens_model(path, name) for name in named}
    has_terms = any(terms.get(name) for name in _BROWN)
    if "fisheye" in models:
        return "fisheye", [terms.get(name, 0.0) for name in _FISHEYE]
    if not has_terms:
        return "pinhole", []
    if not models and not {"p1", "p2"} <= terms.keys():
        raise SemvizError(f"{path}: k1 without p1 and p2, and no lens model; name it as model")
    return "brown-conrady", [terms.get(name, 0.0) for name in _BROWN]


def _size_in(path: Path, groups: Mapping[str, Mapping[str, Any]]) -> Size | None:
    for width, height in _SIZES:
        for names in groups.values():
            if width in names and height in names:
                size = numbers_of([names[width], names[height]], (2,), f"{path}, {width}")
                return int(size[0]), int(size[1])
    return None


def _taken(path: Path, size: Size | None, numbers: FloatArray) -> Size:
    """Return the size of the images. Raise SemvizError if they cannot be those calibrated."""
    if size is None:
        raise SemvizError(f"{path}: no size of images; give it as width and height")
    off = np.abs(numbers[2:] / size - 0.5)
    if off.max() > _MOST_OFF_CENTER:
        raise SemvizError(
            f"{path}: the principal point {numbers[2]:g}, {numbers[3]:g} is far from the middle of "
            f"images of {size[0]}x{size[1]}: calibrated at another size? Write a TOML file with "
            "size_px, as docs/own-drive.md shows"
        )
    return size
