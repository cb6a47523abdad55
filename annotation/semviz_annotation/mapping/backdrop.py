"""A dense coloured backdrop of a drive, what it was made from, and its file.

The file is safetensors: its header holds the settings, the tensors are points, colours and the
poses that were used. So whoever shows it can tell whether it still fits the drive.
"""

import json
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from semviz_annotation.mapping.depth_fusion import Cloud, FusionOptions
from semviz_core.base.camera import Rig
from semviz_core.base.frame import Frame
from semviz_core.base.semantic_map import MapFrame
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.common.limits import MOST_TENSOR_BYTES, check_file, parsed_json
from semviz_core.datasets.validation import Calibration

FORMAT = 1
METHOD = 1
"""Goes up where the same images give other points."""
SAME_POSE = 1e-6
"""Numbers of a pose, in metres and of its rotation, that differ by less are the same."""
_KEY = "semviz backdrop"


@dataclass(frozen=True, eq=False)
class BackdropSource:
    """What a backdrop is made from."""

    map_frame: str
    calibration: str
    """Hash of the rig; see ``Calibration``."""
    frames: IntArray
    """(k,) numbers of the frames whose images were used."""
    poses: FloatArray
    """(k, 3, 4) their ``T_map_camera``."""
    options: FusionOptions
    method: int = METHOD

    @classmethod
    def of(
        cls, map_frame: MapFrame, rig: Rig, frames: Iterable[Frame], options: FusionOptions
    ) -> "BackdropSource":
        """Return the source with these ``frames``, which have poses."""
        known = {
            frame.index: frame.T_map_camera.as_matrix()[:3]
            for frame in frames
            if frame.T_map_camera
        }
        numbers, poses = np.array([*known], dtype=np.int64), np.array([*known.values()])
        return cls(map_frame.name, Calibration.of(rig).hash, numbers, poses, options)

    def change(self, map_frame: MapFrame, rig: Rig, frames: Iterable[Frame]) -> str:
        """Return what of a drive has changed since, as part of a sentence; empty if nothing has.

        Frames without a pose, and those that were not used, are not compared.
        """
        if self.method != METHOD:
            return "another version of semviz made it"
        if self.map_frame != map_frame.name:
            return f"it is in the map frame {self.map_frame}, not {map_frame.name}"
        if self.calibration != Calibration.of(rig).hash:
            return "the calibration has changed"
        now = {
            frame.index: frame.T_map_camera for frame in frames if frame.T_map_camera is not None
        }
        for number, pose in zip(self.frames.tolist(), self.poses, strict=True):
            pose_now = now.get(number)
            if pose_now is not None and np.abs(pose_now.as_matrix()[:3] - pose).max() > SAME_POSE:
                return f"the pose of frame {number} has changed"
        return ""

    def is_same(self, other: "BackdropSource") -> bool:
        """Return whether both give the same backdrop."""
        return (
            (self.map_frame, self.calibration, self.options, self.method)
            == (other.map_frame, other.calibration, other.options, other.method)
            and np.array_equal(self.frames, other.frames)
            and np.abs(self.poses - other.poses).max() <= SAME_POSE
        )


@dataclass(frozen=True, eq=False)
class Backdrop:
    """Coloured points of a drive's surfaces."""

    points_m: NDArray[np.float32]
    """(n, 3) in the map frame."""
    colors: NDArray[np.uint8]
    """(n, 3) sRGB."""
    spacing_m: float
    """From point to point, about."""
    source: BackdropSource

    @classmethod
    def of(cls, cloud: Cloud, source: BackdropSource) -> "Backdrop":
        colors = np.rint(255.0 * cloud.colors).clip(0, 255).astype(np.uint8)
        return cls(cloud.points_m.astype(np.float32), colors, cloud.voxel_m, source)

    def __len__(self) -> int:
        return len(self.points_m)


class _Tensors(NamedTuple):
    """What the file holds, by name."""

    points_m: NDArray[np.float32]
    colors: NDArray[np.uint8]
    frames: IntArray
    poses: FloatArray


def save_backdrop(backdrop: Backdrop, path: Path) -> None:
    """Replace ``path``; the same backdrop gives the same bytes. SemvizError where that fails."""
    source = backdrop.source
    header = {
        "format": FORMAT,
        "method": source.method,
        "map_frame": source.map_frame,
        "calibration": source.calibration,
        "options": asdict(source.options),
        "spacing_m": backdrop.spacing_m,
    }
    tensors = _Tensors(backdrop.points_m, backdrop.colors, source.frames, source.poses)
    header["crc32"] = _checksum(header, tensors)
    content = safetensors.numpy.save(tensors._asdict(), metadata={_KEY: json.dumps(header)})
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def load_backdrop(path: Path) -> Backdrop:
    """Return the backdrop in a file. SemvizError if it is missing, damaged or of another format."""
    try:
        check_file(path, MOST_TENSOR_BYTES)
        with safe_open(path, framework="numpy") as file:
            header = parsed_json((file.metadata() or {})[_KEY])
            if header["format"] != FORMAT:
                raise SemvizError(f"{path}: a backdrop of another version of semviz; make it again")
            tensors = _Tensors(*(file.get_tensor(name) for name in _Tensors._fields))
        if header.pop("crc32", None) not in (None, _checksum(header, tensors)):  # earlier: none
            raise ValueError("its checksum differs")
        options = FusionOptions(**header["options"])
        names, spacing_m = (header["map_frame"], header["calibration"]), float(header["spacing_m"])
        source = BackdropSource(*names, tensors.frames, tensors.poses, options, header["method"])
        _check(tensors, source, spacing_m)
    except SemvizError as error:
        raise SemvizError(f"{str(error).removesuffix('; make it again')}; make it again") from None
    except (OSError, SafetensorError, LookupError, TypeError, ValueError, ArithmeticError):
        raise SemvizError(f"{path}: no backdrop of semviz, or damaged; make it again") from None
    return Backdrop(tensors.points_m, tensors.colors, spacing_m, source)


def _checksum(header: Mapping[str, Any], tensors: _Tensors) -> int:
    """Return the CRC-32 of the header, then of each tensor."""
    checksum = zlib.crc32(json.dumps(header, sort_keys=True).encode())
    for tensor in tensors:
        checksum = zlib.crc32(np.ascontiguousarray(tensor).data, checksum)
    return checksum


def _check(tensors: _Tensors, source: BackdropSource, spacing_m: float) -> None:
    """Raise ValueError if the parts of a file are not those of ``save_backdrop``."""
    count, poses = len(tensors.points_m), len(tensors.frames)
    expected = {
        "points_m": ((count, 3), np.float32), "colors": ((count, 3), np.uint8),
        "frames": ((poses,), np.int64), "poses": ((poses, 3, 4), np.float64),
    }  # fmt: skip
    for name, (shape, dtype) in expected.items():
        array = getattr(tensors, name)
        if array.shape != shape or array.dtype != dtype:
            raise ValueError(f"{name} are {array.dtype} {array.shape}")
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"{name} are not finite")
    if not 0.0 < spacing_m < np.inf:
        raise ValueError(f"a spacing of {spacing_m}")
    if not isinstance(source.map_frame, str) or not isinstance(source.calibration, str):
        raise ValueError("a name that is no text")
