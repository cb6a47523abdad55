"""Read a table of GNSS poses: latitude, longitude, height and heading, with the names of columns.

The body has x ahead, y left and z up. Its heading is clockwise from north, its pitch is positive
with the nose up, its roll with the right side down, as usual for vehicles; without columns for
these, it is level. Positions become metres east, north and up of the first one.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import shown
from semviz_core.datasets.own_drive.geodesy import local_poses
from semviz_core.datasets.own_drive.image_files import TimeUnit, in_seconds, is_number
from semviz_core.datasets.own_drive.recorded_poses import RecordedPoses

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
        name: _numbers(path, columns[place], [row[place] for row in rows])
        for name, place in known.items()
        if name not in ("name", "time")
    }
    for name in ("latitude", "longitude"):
        values[name] = _degrees(columns[known[name]], values[name])
    if np.abs(values["latitude"]).max() > 90.0 or np.abs(values["longitude"]).max() > 360.0:
        raise SemvizError(f"{path}: latitude and longitude are not degrees; give degrees")
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
    return RecordedPoses(
        path,
        "GNSS",
        matrices[order],
        of_body=True,
        time_s=time_s,
        time_unit=time_unit,
        names=names,
        note=f"heading clockwise from north, {_tilt(known)}, metres east and north of {where}",
    )


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


def _numbers(path: Path, column: str, words: Sequence[str]) -> FloatArray:
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
