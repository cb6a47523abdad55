"""The motions of a whole drive, measured from its images, and the file that keeps them.

Motions depend on images and calibration only, so one measurement serves every set of poses.
"""

import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from semviz_core.base.camera import Rig
from semviz_core.base.frame import Dataset, Frame
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.common.limits import MOST_TENSOR_BYTES, check_file, parsed_json
from semviz_core.common.progress import OnProgress, unwatched
from semviz_core.pose_checks.motion import UNKNOWNS, Motion, measure_motion
from semviz_core.pose_checks.tracks import PointTracks, tracks_of

METHOD = 1
"""Changes when the same images give other motions."""
_KEY = "image_motions"
_SHAPES = {
    "rotation": (3, 3),
    "translation_m": (3,),
    "information": (UNKNOWNS, UNKNOWNS),
    "linear": (UNKNOWNS,),
    "points": (),
    "share": (),
    "parallax_px": (),
}


@dataclass(frozen=True, eq=False)
class ImageMotions:
    """The n motions from each of n + 1 frames to the next, ``Motion``'s fields as arrays."""

    frames: IntArray
    """(n + 1,) ``Frame.index``."""
    has_stereo: bool
    """False: lengths are 1 and not measured."""
    rotation: FloatArray
    """(n, 3, 3) of T_now_before."""
    translation_m: FloatArray
    """(n, 3) of T_now_before."""
    information: FloatArray
    """(n, 9, 9)"""
    linear: FloatArray
    """(n, 9)"""
    points: FloatArray
    """(n,) number of inliers; 0 where nothing was measured."""
    share: FloatArray
    """(n,) inliers among all points."""
    parallax_px: FloatArray
    """(n,)"""

    def __len__(self) -> int:
        return len(self.points)

    @property
    def is_measured(self) -> BoolArray:
        """(n,)"""
        return np.asarray(self.points > 0)

    @classmethod
    def of(
        cls, frames: Sequence[Frame], has_stereo: bool, motions: Sequence[Motion]
    ) -> "ImageMotions":
        """Return the motions between consecutive ``frames``."""
        if len(motions) != max(len(frames) - 1, 0):
            raise SemvizError(f"{len(motions)} motions for {len(frames)} frames; give one less")
        n = len(motions)
        columns = {
            "rotation": [motion.T_now_before.rotation for motion in motions],
            "translation_m": [motion.T_now_before.translation for motion in motions],
        } | {
            name: [getattr(motion, name) for motion in motions]
            for name in ("information", "linear", "points", "share", "parallax_px")
        }
        arrays = {
            name: np.array(values, dtype=np.float64).reshape(n, *_SHAPES[name])
            for name, values in columns.items()
        }
        indices = np.array([frame.index for frame in frames], dtype=np.int64)
        return cls(indices, has_stereo, **arrays)


def motions_of(tracks: Sequence[PointTracks], frames: Sequence[Frame], rig: Rig) -> ImageMotions:
    """Return the motions between ``frames`` from the tracks of each to the next."""
    measured = [measure_motion(track, rig) for track in tracks]
    return ImageMotions.of(frames, rig.right is not None, measured)


def measure_motions(
    dataset: Dataset,
    frames: Sequence[Frame],
    on_progress: OnProgress = unwatched,
) -> ImageMotions:
    """Measure the motion from each of ``frames`` to the next from their images.

    ``on_progress`` may raise to stop.
    """
    motions = []
    for tracks in tracks_of(dataset, tuple(frames)):
        motions.append(measure_motion(tracks, dataset.rig))
        on_progress("measuring motion in the images", len(motions), len(frames) - 1)
    return ImageMotions.of(frames, dataset.rig.right is not None, motions)


def save_motions(motions: ImageMotions, source: str, path: Path) -> None:
    """Replace ``path``. ``source`` says what the motions were measured from."""
    tensors = {name: getattr(motions, name) for name in _SHAPES} | {"frames": motions.frames}
    header = {
        "method": METHOD,
        "source": source,
        "has_stereo": motions.has_stereo,
        "crc32": _checksum(tensors, motions.has_stereo),
    }
    content = safetensors.numpy.save(tensors, metadata={_KEY: json.dumps(header)})
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def _checksum(tensors: Mapping[str, NDArray[Any]], has_stereo: object) -> int:
    checksum = zlib.crc32(f"{has_stereo}".encode())
    for name in sorted(tensors):
        checksum = zlib.crc32(np.ascontiguousarray(tensors[name]).data, checksum)
    return checksum


def load_motions(path: Path, source: str) -> ImageMotions | None:
    """Return the motions in ``path``; None if they are of another source or method, or damaged.

    They can always be measured again.
    """
    try:
        check_file(path, MOST_TENSOR_BYTES)
        with safe_open(path, framework="numpy") as file:
            header = parsed_json((file.metadata() or {})[_KEY])
            if (header["method"], header["source"]) != (METHOD, source):
                return None
            arrays = {name: file.get_tensor(name) for name in _SHAPES}
            frames = file.get_tensor("frames")
        tensors, has_stereo = arrays | {"frames": frames}, header["has_stereo"]
        if header.get("crc32") not in (None, _checksum(tensors, has_stereo)):
            return None
    except (OSError, SemvizError, SafetensorError, LookupError, TypeError, ValueError):
        return None
    n = len(frames) - 1
    for name, shape in _SHAPES.items():
        array = arrays[name]
        if array.shape != (n, *shape) or array.dtype != np.float64 or not np.isfinite(array).all():
            return None
    return ImageMotions(frames, bool(has_stereo), **arrays)
