"""Recorded poses from tables with named columns: in metres, or on Earth as GNSS gives them.

A table in metres holds positions with quaternions, of the camera as TUM's files, or with headings
anticlockwise from x, of a body with x ahead, y left and z up. A table of GNSS holds latitude,
longitude, height, and a heading clockwise from north of such a body; positions become metres east,
north and up of the first one. A table with metres north, east and down, as Oxford RobotCar's, has
such headings, in radians unless its columns say degrees. Pitch is positive with the nose up, roll
with the right side down; without them, the body is level.
"""

from dataclasses import replace

import numpy as np

from semviz_core.common.arrays import BoolArray, FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.poses.conventions import (
    QuaternionOrder,
    RecordedPoses,
    body_axes,
    local_poses,
    matrices_of,
)
from semviz_core.datasets.own_drive.poses.sensor_table import SensorTable, is_in_radians, row_name

_LEAST_STEP_M, _LEAST_STEPS = 0.5, 5
"""Steps of a table that tell the direction of travel, and how many are needed."""
_EARTH_M = 6.37e6
_OFF_TRAVEL_RAD, _ALONG_TRAVEL_RAD, _AS_WELL_RAD = np.deg2rad([12.0, 6.0, 2.0])
_QUATERNION = ("qx", "qy", "qz", "qw")


def poses_of_columns(
    table: SensorTable, quaternion: QuaternionOrder | None
) -> RecordedPoses | None:
    """Return the poses of a table; None if its names are not those of whole poses.

    ``quaternion`` takes columns for others than their names say. Raise SemvizError if something
    lacks in a table of GNSS, or a cell that is needed is empty.
    """
    if table.has("northing", "easting", "down", "heading"):
        return _sorted(table, _of_north_east_down(table))
    if table.has("latitude", "longitude"):
        return _sorted(table, _of_gnss(table))
    if not table.has("x", "y", "z"):
        return None
    if table.has(*_QUATERNION):
        return _sorted(table, _of_quaternions(table, quaternion))
    return _sorted(table, _of_headings(table)) if "heading" in table else None


def _sorted(table: SensorTable, poses: RecordedPoses) -> RecordedPoses:
    """Return poses with what assigns them to images, in order of time if there is one."""
    ordered = table.rows(table.order)
    frame = ordered.values.get("frame")
    return replace(
        poses,
        matrices=poses.matrices[table.order],
        time_s=ordered.values.get("time"),
        time_unit=table.time_unit,
        names=ordered.names,
        indices=None if frame is None else frame.astype(np.int64),
    )


def _of_quaternions(table: SensorTable, order: QuaternionOrder | None) -> RecordedPoses:
    names: tuple[str, ...] = _QUATERNION
    if order is not None:  # of the columns as they stand
        written = list(table.written)
        names = tuple(sorted(_QUATERNION, key=written.index))
    position_m, quaternions = _whole(table, "x", "y", "z"), _whole(table, *names)
    matrices = matrices_of(position_m, quaternions, order or "xyzw", table.path)
    return RecordedPoses(table.path, "table", matrices, quaternion=order)


def _of_headings(table: SensorTable) -> RecordedPoses:
    (heading,) = _whole(table, "heading").T
    matrices = np.concatenate(
        [_body_axes(table, heading), _whole(table, "x", "y", "z")[:, :, None]], axis=2
    )
    note = f"{table.written['heading']} anticlockwise from x, {_tilt(table)}"
    return RecordedPoses(table.path, "table", matrices, of_body=True, note=note)


def _of_north_east_down(table: SensorTable) -> RecordedPoses:
    angles = [name for name in ("heading", "pitch", "roll") if name in table]
    in_radians = {  # were taken for degrees
        name: np.rad2deg(table.values[name])
        for name in angles
        if not is_in_radians(table.written[name]) and "deg" not in table.written[name].lower()
    }
    table = replace(table, values={**table.values, **in_radians})
    north, east, down, heading = _whole(table, "northing", "easting", "down", "heading").T
    place = np.stack([east, north, -down], axis=1)
    matrices = np.concatenate([_body_axes(table, np.pi / 2.0 - heading), place[:, :, None]], axis=2)
    unit = "rad" if "heading" in in_radians or is_in_radians(table.written["heading"]) else "deg"
    note = f"{table.written['heading']} in {unit} clockwise from north, {_tilt(table)}"
    return RecordedPoses(table.path, "table", matrices, of_body=True, note=note)


def _of_gnss(table: SensorTable) -> RecordedPoses:
    path, written = table.path, table.written
    if "heading" not in table or "yaw" in written["heading"].lower():
        raise SemvizError(
            f"{path}: holds latitude and longitude, and no orientation of a camera; add a column "
            "heading_deg, clockwise from north, or give poses of a SLAM system or of COLMAP"
        )
    if "height" not in table:
        raise SemvizError(f"{path}: no column height_m, above the ellipsoid; add one")
    latitude, longitude, height, heading = _whole(
        table, "latitude", "longitude", "height", "heading"
    ).T
    degrees = np.rad2deg(latitude), np.rad2deg(longitude)
    _refuse_impossible(table, *degrees)
    R = _body_axes(table, np.pi / 2.0 - heading)
    note = f"heading clockwise from north, {_tilt(table)}, metres east and north of "
    rows = table.order
    return RecordedPoses(
        path,
        "GNSS",
        local_poses(*degrees, height, R),
        of_body=True,
        note=f"{note}{degrees[0][0]:.7f}, {degrees[1][0]:.7f}",
        doubt=_doubt_of_heading(written["heading"], heading[rows], latitude[rows], longitude[rows]),
    )


def _whole(table: SensorTable, *names: str) -> FloatArray:
    """Return columns (n, len(names)). Raise SemvizError if a cell of them has no number."""
    values = table.columns(*names)
    empty = np.argwhere(~np.isfinite(values))
    if len(empty):
        row, column = empty[0].tolist()
        name = table.written[names[column]]
        raise SemvizError(
            f"{table.path}, {row_name(table.path, row)}: no number in {name}; delete it"
        )
    return values


def _body_axes(table: SensorTable, yaw_rad: FloatArray) -> FloatArray:
    """Return R_world_body (n, 3, 3), with yaw anticlockwise from x, or east."""
    pitch, roll = (
        _whole(table, name)[:, 0] if name in table else np.zeros(len(table))
        for name in ("pitch", "roll")
    )
    return body_axes(yaw_rad, -pitch, roll)


def _tilt(table: SensorTable) -> str:
    """Say for people what turns the body out of the level."""
    if not ("pitch" in table or "roll" in table):
        return "level"
    pitch = "pitch nose up" if "pitch" in table else "pitch 0"
    return f"{pitch}, {'roll right down' if 'roll' in table else 'roll 0'}"


def _refuse_impossible(
    table: SensorTable, latitude_deg: FloatArray, longitude_deg: FloatArray
) -> None:
    """Raise SemvizError if latitudes or longitudes are none."""
    path = table.path
    farthest, widest = np.abs(latitude_deg).max(), np.abs(longitude_deg).max()
    if farthest > 90.0 and farthest <= 360.0 and widest <= 90.0:
        latitude, longitude = (table.written[name] for name in ("latitude", "longitude"))
        raise SemvizError(
            f"{path}: {latitude} is up to {farthest:.4f} deg, beyond the poles: latitude and "
            f"longitude are exchanged; exchange the names of the columns {latitude} and {longitude}"
        )
    if farthest > 90.0 or widest > 360.0:
        raise SemvizError(f"{path}: latitude and longitude are not degrees; give degrees")


def _doubt_of_heading(
    column: str, heading_rad: FloatArray, latitude_rad: FloatArray, longitude_rad: FloatArray
) -> str:
    """Say that headings (n,) are not those of travel, if they are by another meaning.

    A car drives where it heads, or backwards. Empty if it does, or no meaning fits.
    """
    travel, moves = _travel(latitude_rad, longitude_rad)
    if moves.sum() < _LEAST_STEPS:
        return ""
    exchanged, _ = _travel(longitude_rad, latitude_rad)
    as_taken = heading_rad[:-1]
    written = as_taken if is_in_radians(column) else np.rad2deg(as_taken)
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
