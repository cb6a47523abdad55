"""Read tables with named columns: positions, rotations, gravity and speeds at times or in frames.

Names have units (``heading_deg``, ``x [m]``), and may be those that exports of ROS give them
(``pose.position.x``), or records of JSON. Cells may be empty. Angles become radians, times seconds.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import shown, table_rows
from semviz_core.datasets.own_drive.images.image_files import TimeUnit, in_seconds, is_number
from semviz_core.datasets.own_drive.poses.json_table import json_cells
from semviz_core.datasets.trajectory import read_text

_COLUMNS = {
    "time": r"(header_)?(t|u?time|time_?stamp|stamp|utc|gps_?time)(_(s|ms|us|ns))?",
    "received": r"received(_(s|ms|us|ns))?",
    "latency": r"latency(_s)?",
    "frame": r"frame(_?(index|number))?",
    "frame_id": r"frame_id",
    "name": r"name|image|file|filename",
    **{axis: rf"((t|p|pos|position|trans|translation)_?)?{axis}(_m)?" for axis in "xyz"},
    "latitude": r"lat(itude)?(_(deg|rad))?",
    "longitude": r"lon(g|gitude)?(_(deg|rad))?",
    "northing": r"north(ing)?(_m)?",
    "easting": r"east(ing)?(_m)?",
    "down": r"down(_m)?",
    "height": r"(ellipsoid_?)?(h|height|alt|altitude)(_m)?",
    "heading": r"(true_?)?(heading|yaw|azimuth|course)(_(deg|rad))?",
    "pitch": r"pitch(_(deg|rad))?",
    "roll": r"roll(_(deg|rad))?",
    **{
        f"q{axis}": rf"(q|quat|quaternion|rot|rotation|orientation|heading)_?{axis}"
        for axis in "xyzw"
    },
    **{f"up_{axis}": rf"up_{axis}" for axis in "xyz"},
    "horizontal_sigma": r"(horizontal_sigma|h_?acc(uracy)?|sigma)(_m)?",
    "vertical_sigma": r"(vertical_sigma|v_?acc(uracy)?)(_m)?",
    "heading_sigma": r"heading_(sigma|acc(uracy)?)(_(deg|rad))?",
    "up_sigma": r"(up|gravity)_sigma(_(deg|rad))?",
    "speed": r"speed(_(mps|m_s))?",
    "yaw_rate": r"yaw_rate(_(deg|rad|degps|radps|deg_s|rad_s))?",
    "translation_sigma": r"translation_sigma(_m)?",
    "rotation_sigma": r"rotation_sigma(_(deg|rad))?",
}
_ANGLES = {
    "latitude", "longitude", "heading", "pitch", "roll", "heading_sigma", "up_sigma", "yaw_rate",
    "rotation_sigma",
}  # fmt: skip
"""In degrees, unless the name of the column says radians."""
_TEXTS = {"time", "received", "name"}
_LABELS = {"time", "frame", "frame_id", "name"}
"""Columns that measure nothing; EuRoC's files of poses have no other that is known."""
_UNITS: tuple[TimeUnit, ...] = ("ms", "us", "ns", "s")
_UNIT = re.compile(r"\s*[\[(]\s*([a-z/]*)\s*[\])]")
_TITLE = re.compile(r"^#?\s*\w+:\s")
"""Of a table, before the name of its first column."""
_LEAST_TIME = 1e12
"""Numbers of frames from here on are times since 1970."""


@dataclass(frozen=True, eq=False)
class SensorTable:
    """n rows by the names of known columns."""

    path: Path
    values: Mapping[str, FloatArray]
    """(n,) in seconds, metres and radians; NaN for an empty cell."""
    names: tuple[str, ...] | None
    """(n,) images, if there is a column of them."""
    ignored: tuple[str, ...]
    """Columns whose names are not known."""
    written: Mapping[str, str]
    """Names of the known columns as the file has them."""
    time_unit: TimeUnit | None = None

    def __len__(self) -> int:
        return len(next(iter(self.values.values())))

    def __contains__(self, name: str) -> bool:
        return name in self.values

    def has(self, *names: str) -> bool:
        """Whether there are all of these columns."""
        return all(name in self.values for name in names)

    def columns(self, *names: str) -> FloatArray:
        """Return (n, len(names)); NaN where a column is missing."""
        missing = np.full(len(self), np.nan)
        return np.column_stack([self.values.get(name, missing) for name in names])

    @property
    def order(self) -> list[int]:
        """Rows in order of time; as they stand without times."""
        if "time" not in self:
            return list(range(len(self)))
        return [int(row) for row in np.argsort(self.values["time"], kind="stable")]

    def rows(self, rows: Sequence[int]) -> "SensorTable":
        """Return some rows."""
        values = {name: column[list(rows)] for name, column in self.values.items()}
        names = None if self.names is None else tuple(self.names[row] for row in rows)
        return replace(self, values=values, names=names)


def row_name(path: Path, row: int) -> str:
    """Return how people find a row of the table in a file."""
    return f"record {row + 1}" if path.suffix == ".json" else f"line {row + 2}"


def read_table(path: Path, unit: TimeUnit | None = None) -> SensorTable | None:
    """Return the table in a file; None if it has no names of columns that are known.

    ``unit`` replaces what the name of the column of times says. Raise SemvizError with the wrong
    line.
    """
    head, rows = json_cells(path) if path.suffix == ".json" else _text_cells(path)
    places = _places(head)
    return _of_cells(path, head, places, rows, unit) if places.keys() - _LABELS else None


def _text_cells(path: Path) -> tuple[list[str], list[list[str]]]:
    """Return the names of columns and the cells of each line; no lines without known names."""
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    if not lines:
        raise SemvizError(f"{path}: is empty; name another file")
    delimiter = _delimiter(lines[0])
    first = _TITLE.sub("", lines[0]).lstrip("# ")
    (head,) = table_rows([_squeezed(first) if delimiter == " " else first], path, delimiter) or [[]]
    if not _places(head).keys() - _LABELS:
        return head, []
    body = (line for line in lines[1:] if line[0] != "#")
    rows = table_rows(map(_squeezed, body) if delimiter == " " else body, path, delimiter)
    if not rows:
        raise SemvizError(f"{path}: has names of columns, and no line below; name another file")
    for number, row in enumerate(rows, 2):
        if len(row) != len(head):
            raise SemvizError(f"{path}, line {number}: {len(row)} cells, expected {len(head)}")
    return head, rows


def _of_cells(
    path: Path,
    head: list[str],
    places: dict[str, int],
    rows: list[list[str]],
    unit: TimeUnit | None,
) -> SensorTable:
    values: dict[str, FloatArray] = {}
    names, time_unit = None, None
    for name, place in places.items():
        cells = [row[place].strip() for row in rows]
        if name == "name":
            names = tuple(cells)
        elif name == "time":
            values[name], time_unit = _times(path, head[place], cells, unit)
        elif name in _TEXTS:
            values[name], _ = _times(path, head[place], cells, None)
        elif name != "frame_id":
            values[name] = _numbers(path, name, head[place], cells)
        elif all(map(is_number, cells)):  # of ROS it is the name of an axis system
            if "time" not in places and float(cells[0]) >= _LEAST_TIME:
                values["time"], time_unit = in_seconds(cells, unit, path)
            else:
                values.setdefault("frame", _numbers(path, name, head[place], cells))
    if not values:
        raise SemvizError(f"{path}: no column of it holds a measurement; see docs/priors.md")
    written = {name: head[place].strip() for name, place in places.items()}
    ignored = tuple(column for place, column in enumerate(head) if place not in places.values())
    return SensorTable(path, values, names, ignored, written, time_unit)


def _delimiter(line: str) -> str:
    """Return what separates cells: spaces only in a line that is no comment."""
    marks = ";\t," if line.lstrip().startswith("#") else ";\t, "
    return next((mark for mark in marks if mark in line.strip()), ",")


def _squeezed(line: str) -> str:
    return " ".join(line.split())


def _places(head: list[str]) -> dict[str, int]:
    """Return the place of each known column; the first that fits counts."""
    found: dict[str, int] = {}
    for place, column in enumerate(head):
        whole = _UNIT.sub(r"_\1", column.strip().lstrip("%").lower()).rstrip("_")
        last = "_".join(whole.split(".")[-2:])  # of a path in a message of ROS
        for name, pattern in _COLUMNS.items():
            if re.fullmatch(pattern, whole) or re.fullmatch(pattern, last):
                found.setdefault(name, place)
    return found


def _times(
    path: Path, column: str, cells: list[str], unit: TimeUnit | None
) -> tuple[FloatArray, TimeUnit]:
    name = _UNIT.sub(r"_\1", column.strip().lower())
    written = next((one for one in _UNITS if name.endswith(f"_{one}")), None)
    if "" in cells:
        where = row_name(path, cells.index(""))
        raise SemvizError(f"{path}, {where}: {column} is empty; delete it")
    return in_seconds(cells, unit or written, path)


def _numbers(path: Path, name: str, column: str, cells: list[str]) -> FloatArray:
    """Return (n,) numbers, angles in radians; NaN for empty cells and for NaN."""
    for row, cell in enumerate(cells):
        if cell and cell.lower() != "nan" and not is_number(cell):
            where = f"{path}, {row_name(path, row)}"
            raise SemvizError(f"{where}: {column} {shown(cell, 40)!r} is not a finite number")
    values = np.array([float(cell or "nan") for cell in cells])
    return np.deg2rad(values) if name in _ANGLES and not is_in_radians(column) else values


def is_in_radians(column: str) -> bool:
    """Whether the name of a column of angles says that they are not in degrees."""
    return "rad" in column.lower()
