"""Give each image the pose of its time, its name or its number."""

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import shown
from semviz_core.datasets.own_drive.image_files import SUFFIXES

MOST_GAP_S = 0.25
"""Default of the longest time between two poses across which one is interpolated."""
SAME_TIME_S = 0.005
"""A pose and an image so close are of one time; clocks are written with few digits."""


def poses_at_times(
    poses: Sequence[Pose], pose_time_s: FloatArray, time_s: FloatArray, most_gap_s: float
) -> list[Pose | None]:
    """Return the pose at each of the times (n,), interpolated between the two around it.

    Positions linearly, rotations along the shorter arc. None where these two are more than
    ``most_gap_s`` apart, and before the first and behind the last; but a pose within
    ``SAME_TIME_S`` counts always. ``pose_time_s`` is in order.
    """
    from scipy.spatial.transform import Rotation, Slerp

    after = np.searchsorted(pose_time_s, time_s).clip(1, max(len(poses) - 1, 1))
    found: list[Pose | None] = []
    for moment, row in zip(time_s.tolist(), after.tolist(), strict=True):
        rows = [row - 1, row] if len(poses) > 1 else [0, 0]
        before_s, after_s = pose_time_s[rows].tolist()
        nearest = rows[0] if abs(moment - before_s) <= abs(moment - after_s) else rows[1]
        if before_s < moment < after_s and after_s - before_s <= most_gap_s:
            share = (moment - before_s) / (after_s - before_s)
            ends = Rotation.from_matrix(np.array([poses[end].rotation for end in rows]))
            t_before, t_after = (poses[end].translation for end in rows)
            rotation = Slerp([0.0, 1.0], ends)(share).as_matrix()
            found.append(Pose(rotation, t_before + share * (t_after - t_before)))
        elif abs(pose_time_s[nearest] - moment) <= SAME_TIME_S:
            found.append(poses[nearest])
        else:
            found.append(None)
    return found


def why_without_pose(pose_time_s: FloatArray, moment_s: float, most_gap_s: float) -> str:
    """Say why ``poses_at_times`` gives no pose at a time, for people."""
    first_s, last_s = float(pose_time_s[0]), float(pose_time_s[-1])
    if moment_s < first_s:
        return f"taken {first_s - moment_s:.3f} s before the first pose"
    if moment_s > last_s:
        return f"taken {moment_s - last_s:.3f} s after the last pose"
    after = int(np.searchsorted(pose_time_s, moment_s))
    gap_s = float(pose_time_s[after] - pose_time_s[after - 1])
    return f"taken between poses {gap_s:.3f} s apart, --most-gap is {most_gap_s:g} s"


def rows_of_names(images: Sequence[Path], names: Sequence[str]) -> list[int | None]:
    """Return the row of ``names`` that each image has, by as much of its path as is unique.

    ``left/000.jpg`` is the image of that name in a folder ``left``. A name without ending is that
    of an image with any ending. Raise SemvizError if no image is named.
    """
    by_end: dict[tuple[str, ...], list[int]] = {}
    for row, name in enumerate(names):
        parts = _parts(name)
        for start in range(len(parts)):
            by_end.setdefault(parts[start:], []).append(row)
    rows = [_row_of(_parts(str(image)), by_end) for image in images]
    if all(row is None for row in rows):
        raise SemvizError(
            f"the poses are of other images: they name {shown(names[0], 80)}, the images are "
            f"called like {images[0].parent.name}/{images[0].name}"
        )
    return rows


def _row_of(parts: tuple[str, ...], by_end: Mapping[tuple[str, ...], Sequence[int]]) -> int | None:
    """Return the row whose name agrees with most of a path; None if there is none, or several."""
    for start in range(len(parts)):
        rows = by_end.get(parts[start:])
        if rows is not None:
            return rows[0] if len(rows) == 1 else None
    return None


def _parts(name: str) -> tuple[str, ...]:
    path = PurePosixPath(name.replace("\\", "/"))
    if path.suffix.lower() in SUFFIXES:
        path = path.with_suffix("")
    return tuple(part for part in path.parts if part not in (".", "..", "/"))
