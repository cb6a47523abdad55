"""Read a table of measurements with named columns; cells may be empty.

Units are in the names: ``heading_deg``, ``time_ns``. Angles become radians, times seconds.
"""

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import shown
from semviz_core.datasets.own_drive.image_files import TimeUnit, in_seconds, is_number
from semviz_core.datasets.trajectory import read_text

_COLUMNS = {
    "time": r"(t|time|timestamp|stamp|utc|gps_?time)(_(s|ms|us|ns))?",
    "received": r"received(_(s|ms|us|ns))?",
    "latency": r"latency(_s)?",
    "frame": r"frame(_?(index|number))?",
    "name": r"name|image|file|filename",
    "x": r"x(_m)?",
    "y": r"y(_m)?",
    "z": r"z(_m)?",
    "latitude": r"lat(itude)?(_(deg|rad))?",
    "longitude": r"lon(g|gitude)?(_(deg|rad))?",
    "height": r"(ellipsoid_?)?(h|height|alt|altitude)(_m)?",
    "heading": r"(true_?)?(heading|yaw|azimuth|course)(_(deg|rad))?",
    "pitch": r"pitch(_(deg|rad))?",
    "roll": r"roll(_(deg|rad))?",
    **{f"q{axis}": rf"q_?{axis}" for axis in "xyzw"},
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
_LABELS = {"time", "frame", "name"}
"""Columns that measure nothing; EuRoC's files of poses have no other that is known."""
_UNITS: tuple[TimeUnit, ...] = ("ms", "us", "ns", "s")


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

    def rows(self, rows: Sequence[int]) -> "SensorTable":
        """Return some rows."""
        values = {name: column[list(rows)] for name, column in self.values.items()}
        names = None if self.names is None else tuple(self.names[row] for row in rows)
        return SensorTable(self.path, values, names, self.ignored)


def read_table(path: Path) -> SensorTable | None:
    """Return the table in a CSV file; None if its first line has no names of columns.

    Raise SemvizError with the wrong line.
    """
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    if not lines:
        raise SemvizError(f"{path}: is empty; name another file")
    head = next(csv.reader([lines[0].lstrip("# ")], delimiter=_delimiter(lines[0])))
    places = _places([name.strip().lower() for name in head])
    if not places.keys() - _LABELS:
        return None
    delimiter = _delimiter(lines[0])
    rows = list(csv.reader((line for line in lines[1:] if line[0] != "#"), delimiter=delimiter))
    if not rows:
        raise SemvizError(f"{path}: has names of columns, and no line below; name another file")
    for number, row in enumerate(rows, 2):
        if len(row) != len(head):
            raise SemvizError(f"{path}, line {number}: {len(row)} cells, expected {len(head)}")
    values, names = {}, None
    for name, place in places.items():
        cells = [row[place].strip() for row in rows]
        if name == "name":
            names = tuple(cells)
        elif name in _TEXTS:
            values[name] = _times(path, head[place], cells)
        else:
            values[name] = _numbers(path, name, head[place], cells)
    if not values:
        raise SemvizError(f"{path}: no column of it holds a measurement; see docs/priors.md")
    ignored = tuple(column for place, column in enumerate(head) if place not in places.values())
    return SensorTable(path, values, names, ignored)


def _delimiter(line: str) -> str:
    return next((mark for mark in ";\t," if mark in line), ",")


def _places(columns: list[str]) -> dict[str, int]:
    """Return the place of each known column; the first that fits counts."""
    found: dict[str, int] = {}
    for place, column in enumerate(columns):
        for name, pattern in _COLUMNS.items():
            if re.fullmatch(pattern, column):
                found.setdefault(name, place)
    return found


def _times(path: Path, column: str, cells: list[str]) -> FloatArray:
    unit = next((one for one in _UNITS if column.strip().lower().endswith(f"_{one}")), None)
    if "" in cells:
        raise SemvizError(f"{path}, line {cells.index('') + 2}: {column} is empty; delete the line")
    return in_seconds(cells, unit, path)[0]


def _numbers(path: Path, name: str, column: str, cells: list[str]) -> FloatArray:
    """Return (n,) numbers, angles in radians; NaN for empty cells and for NaN."""
    for number, cell in enumerate(cells, 2):
        if cell and cell.lower() != "nan" and not is_number(cell):
            raise SemvizError(
                f"{path}, line {number}: {column} {shown(cell, 40)!r} is not a finite number"
            )
    values = np.array([float(cell or "nan") for cell in cells])
    is_angle = name in _ANGLES and "rad" not in column.lower()
    return np.deg2rad(values) if is_angle else values
