"""Read comma2k19's ``global_pose``: a pose for each frame of its video, in earth-centred metres.

``frame_orientations`` are quaternions, w first, from ECEF to axes ahead, right, down; the camera
looks ahead. The arrays are .npy files without that ending. Nothing is unpickled.
"""

from io import BytesIO
from pathlib import Path
from tokenize import TokenError

import numpy as np

from semviz_core.common.arrays import FloatArray, float_array
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import first_line, read_limited
from semviz_core.datasets.own_drive.conventions import NAMED_EXTRINSICS
from semviz_core.datasets.own_drive.recorded_poses import RecordedPoses, rotations_of

_MOST_BYTES = 2**27


def is_comma(path: Path) -> bool:
    """Whether a path is a folder ``global_pose``."""
    return (path / "frame_positions").is_file()


def read_comma_poses(path: Path) -> RecordedPoses:
    """Return a pose of the camera for each frame, in order. Raise SemvizError if damaged."""
    positions = _array(path / "frame_positions", 3)
    quaternions = _array(path / "frame_orientations", 4)
    if len(positions) != len(quaternions):
        raise SemvizError(
            f"{path}: {len(positions)} positions, but {len(quaternions)} orientations; copy again"
        )
    rotations = rotations_of(quaternions, "wxyz", path) @ NAMED_EXTRINSICS["frd"].rotation
    matrices = np.concatenate([rotations, positions[:, :, None]], axis=2)
    return RecordedPoses(path, "comma2k19", matrices, quaternion="wxyz")


def _array(path: Path, width: int) -> FloatArray:
    data = BytesIO(read_limited(path, _MOST_BYTES))
    try:
        values = np.lib.format.read_array(data, allow_pickle=False)
        return float_array(values, (None, width), str(path))
    except (ValueError, TypeError, EOFError, MemoryError, SyntaxError, TokenError) as error:
        raise SemvizError(f"{path}: not an array of numbers ({first_line(error)})") from None
