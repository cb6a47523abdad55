"""Read poses of cameras or bodies from files of others, without a guess at what they mean.

TUM, KITTI, EuRoC's CSV, KITTI-360's numbered lines, and tables of GNSS with named columns; models
of COLMAP and nerfstudio are read by ``colmap_model`` and ``recorded_cameras``. Poses are returned
as stored, with the conventions of their format; ``conventions`` applies these, or what the user
says instead.

A table of GNSS holds latitude, longitude, height and heading. The body has x ahead, y left and z
up. Its heading is clockwise from north, its pitch is positive with the nose up, its roll with the
right side down, as usual for vehicles; without columns for these, it is level. Positions become
metres east, north and up of the first one.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from semviz_core.base.pose import Pose, nearest_rotation
from semviz_core.common.arrays import BoolArray, FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import shown
from semviz_core.datasets.own_drive.conventions import (
    QuaternionOrder,
    RecordedPoses,
    local_poses,
    rotations_of,
)
from semviz_core.datasets.own_drive.image_files import TimeUnit, in_seconds, is_number
from semviz_core.datasets.trajectory import read_text

_COLUMNS = {
    "latitude": r"lat(itude)?",
    "longitude": r"lon(g|gitude)?",
    "height": r"(ellipsoid_?)?(h|height|alt|altitude)",
    "heading": r"(true_?)?(heading|azimuth|course)",
    "pitch": r"pitch",
    "roll": r"roll",
    "time": r"t|time|timestamp|stamp|utc|gps_?time",
    "name": r"name|image|file|filename",
}
_TIME_UNITS: tuple[TimeUnit, ...] = ("s", "ms", "us", "ns")
_UNIT = r"_?(deg|rad|m|s|ms|us|ns)?"


_LEAST_STEP_M, _LEAST_STEPS = 0.5, 5
"""Steps of a table that tell the direction of travel, and how many are needed."""
_EARTH_M = 6.37e6
_OFF_TRAVEL_RAD, _ALONG_TRAVEL_RAD, _AS_WELL_RAD = np.deg2rad([12.0, 6.0, 2.0])
_HEAD = 1000
"""Characters of a file in which columns are named."""


def is_gnss(columns: Sequence[str]) -> bool:
    """Whether the names of a table's columns include latitude and longitude."""
    known = _columns(columns)
    return "latitude" in known and "longitude" in known


def read_gnss(
    path: Path, columns: Sequence[str], rows: Sequence[Sequence[str]], unit: TimeUnit | None
) -> RecordedPoses:
    """Return poses of the body. Raise SemvizError without heading or height, or if a number is no
    such."""
    known = _columns(columns)
    if "heading" not in known:
        raise SemvizError(
            f"{path}: holds latitude and longitude, and no orientation of a camera; add a column "
            "heading_deg, clockwise from north, or give poses of a SLAM system or of COLMAP"
        )
    if "height" not in known:
        raise SemvizError(f"{path}: no column height_m, above the ellipsoid; add one")
    values = {
        name: _column_numbers(path, columns[place], [row[place] for row in rows])
        for name, place in known.items()
        if name not in ("name", "time")
    }
    for name in ("latitude", "longitude"):
        values[name] = _degrees(columns[known[name]], values[name])
    _refuse_impossible(path, columns, known, values)
    level = np.zeros(len(rows))
    angles = {
        name: _radians(columns[known[name]], values[name]) if name in values else level
        for name in ("heading", "pitch", "roll")
    }
    R = body_axes(np.pi / 2.0 - angles["heading"], -angles["pitch"], angles["roll"])
    matrices = local_poses(values["latitude"], values["longitude"], values["height"], R)
    order = np.arange(len(rows))
    time_s: FloatArray | None = None
    time_unit: TimeUnit | None = None
    if "time" in known:
        place = known["time"]
        written = next((one for one in _TIME_UNITS if columns[place].endswith(f"_{one}")), None)
        time_s, time_unit = in_seconds([row[place] for row in rows], unit or written, path)
        order = np.argsort(time_s, kind="stable")
        time_s = time_s[order]
    names = None
    if "name" in known:
        names = tuple(rows[row][known["name"]] for row in order.tolist())
    where = f"{values['latitude'][0]:.7f}, {values['longitude'][0]:.7f}"
    column, heading = columns[known["heading"]], values["heading"][order]
    latitude, longitude = (np.deg2rad(values[name][order]) for name in ("latitude", "longitude"))
    return RecordedPoses(
        path,
        "GNSS",
        matrices[order],
        of_body=True,
        time_s=time_s,
        time_unit=time_unit,
        names=names,
        note=f"heading clockwise from north, {_tilt(known)}, metres east and north of {where}",
        doubt=_doubt_of_heading(column, heading, latitude, longitude),
    )


def _refuse_impossible(
    path: Path,
    columns: Sequence[str],
    known: Mapping[str, int],
    values: Mapping[str, FloatArray],
) -> None:
    """Raise SemvizError if latitudes or longitudes are none."""
    farthest, widest = np.abs(values["latitude"]).max(), np.abs(values["longitude"]).max()
    if farthest > 90.0 and farthest <= 360.0 and widest <= 90.0:
        latitude, longitude = (columns[known[name]] for name in ("latitude", "longitude"))
        raise SemvizError(
            f"{path}: {latitude} is up to {farthest:.4f} deg, beyond the poles: latitude and "
            f"longitude are exchanged; exchange the names of the columns {latitude} and {longitude}"
        )
    if farthest > 90.0 or widest > 360.0:
        raise SemvizError(f"{path}: latitude and longitude are not degrees; give degrees")


def _doubt_of_heading(
    column: str, heading: FloatArray, latitude_rad: FloatArray, longitude_rad: FloatArray
) -> str:
    """Say that headings (n,) as written are not those of travel, if they are by another meaning.

    A car drives where it heads, or backwards. Empty if it does, or no meaning fits.
    """
    travel, moves = _travel(latitude_rad, longitude_rad)
    if moves.sum() < _LEAST_STEPS:
        return ""
    exchanged, _ = _travel(longitude_rad, latitude_rad)
    written, as_taken = heading[:-1], _radians(column, heading)[:-1]
    less = f"{column} were counterclockwise from"
    meanings = {
        f"{less} east; heading is 90 deg less that": np.pi / 2.0 - as_taken - travel,
        f"{less} north; heading is 360 deg less that": -as_taken - travel,
        f"{column} were in radians; call the column {column}_rad": written - travel,
        f"{column} were in radians, counterclockwise from east; heading is pi/2 less that": (
            np.pi / 2.0 - written - travel
        ),
        "latitude and longitude were exchanged; exchange the names of their columns": (
            as_taken - exchanged
        ),
    }
    apart = {name: _off_travel(angle[moves]) for name, angle in meanings.items()}
    off, least = _off_travel((as_taken - travel)[moves]), min(apart.values())
    if off < _OFF_TRAVEL_RAD or least > _ALONG_TRAVEL_RAD:
        return ""
    fitting = " or if ".join(name for name in apart if apart[name] <= least + _AS_WELL_RAD)
    return (
        f"{column} is {np.rad2deg(off):.0f} deg off the direction of travel; it would fit if "
        f"{fitting}"
    )


def _travel(latitude_rad: FloatArray, longitude_rad: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the direction of each step (n - 1,), clockwise from north, and whether it moves."""
    north_m = _EARTH_M * np.diff(latitude_rad)
    east_m = _EARTH_M * np.diff(longitude_rad) * np.cos(latitude_rad[0])
    return np.arctan2(east_m, north_m), np.hypot(east_m, north_m) > _LEAST_STEP_M


def _off_travel(off_rad: FloatArray) -> float:
    """Return the median angle (rad) of headings off travel, forward or backward."""
    off = np.abs(np.angle(np.exp(1j * off_rad)))
    return float(min(np.median(off), np.median(np.pi - off)))


def body_axes(yaw_rad: FloatArray, pitch_rad: FloatArray, roll_rad: FloatArray) -> FloatArray:
    """Return R_enu_body (n, 3, 3) of bodies with x ahead, y left, z up.

    Yaw is counterclockwise from east; positive pitch is nose down; the order is Rz Ry Rx.
    """
    from scipy.spatial.transform import Rotation

    angles = np.column_stack([yaw_rad, pitch_rad, roll_rad])
    return np.asarray(Rotation.from_euler("ZYX", angles).as_matrix()).reshape(-1, 3, 3)


def _columns(columns: Sequence[str]) -> Mapping[str, int]:
    """Return the place of each known column; the first that fits counts."""
    found: dict[str, int] = {}
    for place, column in enumerate(columns):
        for name, pattern in _COLUMNS.items():
            if re.fullmatch(f"({pattern}){_UNIT}", column.strip().lower()):
                found.setdefault(name, place)
    return found


def _column_numbers(path: Path, column: str, words: Sequence[str]) -> FloatArray:
    wrong = next((word for word in words if not is_number(word)), None)
    if wrong is not None:
        raise SemvizError(f"{path}: {column} {shown(wrong, 40)!r} is not a finite number")
    return np.array([float(word) for word in words])


def _tilt(known: Mapping[str, int]) -> str:
    """Say for people what turns the body out of the level."""
    if not {"pitch", "roll"} & known.keys():
        return "level"
    pitch = "pitch nose up" if "pitch" in known else "pitch 0"
    return f"{pitch}, {'roll right down' if 'roll' in known else 'roll 0'}"


def _radians(column: str, values: FloatArray) -> FloatArray:
    return values if _is_radians(column) else np.deg2rad(values)


def _degrees(column: str, values: FloatArray) -> FloatArray:
    return np.rad2deg(values) if _is_radians(column) else values


def _is_radians(column: str) -> bool:
    return column.strip().lower().endswith("rad")


def read_poses(
    path: Path, quaternion: QuaternionOrder | None = None, unit: TimeUnit | None = None
) -> RecordedPoses:
    """Return the poses of a text file of numbers; its format is recognized by their count.

    ``quaternion`` and ``unit`` replace what the format says. Raise SemvizError with the wrong line.
    """
    if not path.is_file():
        raise SemvizError(f"{path}: no such file of poses; name another with --poses")
    text = read_text(path)
    lines = [
        (number, re.split(r"[\s,;]+", line.strip().strip(",;")))
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    columns: list[str] = []
    if lines and not is_number(lines[0][1][0]):
        columns, lines = lines[0][1], lines[1:]
    if not lines:
        raise SemvizError(f"{path}: holds no poses; name another file with --poses")
    width = len(lines[0][1])
    if is_gnss(columns):
        _check_width(path, lines, len(columns))
        return read_gnss(path, columns, [row for _, row in lines], unit)
    words = [row for _, row in lines]
    values = _line_numbers(path, lines, width)
    if width == 8 and "q_RS_w" in text[:_HEAD]:  # TUM-VI's, without the velocities of EuRoC's
        return _timed(path, "EuRoC", words, values, quaternion or "wxyz", unit, of_body=True)
    if width == 8:
        return _timed(path, "TUM", words, values, quaternion or "xyzw", unit)
    if width in (11, 17) and path.suffix == ".csv":
        return _timed(path, "EuRoC", words, values, quaternion or "wxyz", unit, of_body=True)
    if width == 12:
        return RecordedPoses(path, "KITTI", _checked(path, lines, values.reshape(-1, 3, 4)))
    if width in (13, 17):
        matrices = _checked(path, lines, values[:, 1:13].reshape(-1, 3, 4))
        indices = values[:, 0].astype(np.int64)
        return RecordedPoses(path, "KITTI-360", matrices, of_body=width == 13, indices=indices)
    raise SemvizError(
        f"{path}: {width} numbers a line; TUM has 8, KITTI 12, KITTI-360 13 or 17, EuRoC's CSV 17"
    )


def _check_width(path: Path, lines: list[tuple[int, list[str]]], width: int) -> None:
    for number, row in lines:
        if len(row) != width:
            raise SemvizError(
                f"{path}, line {number}: {len(row)} numbers, but the first line has {width}"
            )


def _line_numbers(path: Path, lines: list[tuple[int, list[str]]], width: int) -> FloatArray:
    _check_width(path, lines, width)
    for number, row in lines:
        wrong = next((word for word in row if not is_number(word)), None)
        if wrong is not None:
            raise SemvizError(f"{path}, line {number}: {shown(wrong, 40)!r} is not a finite number")
    return np.array([[float(word) for word in row] for _, row in lines]).reshape(-1, width)


def _timed(
    path: Path,
    format_: str,
    words: list[list[str]],
    values: FloatArray,
    quaternion: QuaternionOrder,
    unit: TimeUnit | None,
    of_body: bool = False,
) -> RecordedPoses:
    time_s, unit = in_seconds([row[0] for row in words], unit, path)
    rotations = rotations_of(values[:, 4:8], quaternion, path)
    order = np.argsort(time_s, kind="stable")
    matrices = np.concatenate([rotations, values[:, 1:4, None]], axis=2)
    return RecordedPoses(
        path,
        format_,
        matrices[order],
        of_body=of_body,
        time_s=time_s[order],
        time_unit=unit,
        quaternion=quaternion,
    )


def _checked(path: Path, lines: list[tuple[int, list[str]]], matrices: FloatArray) -> FloatArray:
    """Return (n, 3, 4) with the nearest rotations. Raise SemvizError with the wrong line."""
    try:
        rotations = nearest_rotation(matrices[:, :, :3])
    except SemvizError:
        for (number, _), matrix in zip(lines, matrices, strict=True):
            try:
                Pose.from_matrix(matrix)
            except SemvizError as error:
                raise SemvizError(f"{path}, line {number}: {error}") from None
        raise
    return np.concatenate([rotations, matrices[:, :, 3:]], axis=2)
