"""Read the records of a JSON file as a table with named columns, as exports of data sets have them.

Records are a list, alone or under the only name, or stand one a line. The names of nested values
are joined: ``position.x``. Three numbers in a list are x, y and z, four are w, x, y and z.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import first_line, parsed_json
from semviz_core.datasets.trajectory import MOST_LINES, read_text

_AXES = {3: "xyz", 4: "wxyz"}
_MOST_DEPTH, _MOST_COLUMNS = 6, 200


def json_cells(path: Path) -> tuple[list[str], list[list[str]]]:
    """Return the names of columns and the cells of each record; a missing value is empty.

    Raise SemvizError if the file is no list of records.
    """
    records = [dict(_values(record)) for record in _records(path)]
    head = list(dict.fromkeys(name for record in records for name in record))
    if not head:
        raise SemvizError(f"{path}: holds no records with names; name another file")
    if len(head) > _MOST_COLUMNS:
        raise SemvizError(f"{path}: more than {_MOST_COLUMNS} names; keep those of the poses")
    return head, [[record.get(name, "") for name in head] for record in records]


def _records(path: Path) -> list[dict[str, Any]]:
    text = read_text(path)
    try:
        content = parsed_json(text)
    except ValueError as error:
        content = _of_lines(text)
        if content is None:
            raise SemvizError(f"{path}: not JSON ({first_line(error)}); repair it") from None
    if isinstance(content, dict) and len(content) == 1:
        (content,) = content.values()
    if not isinstance(content, list) or not all(isinstance(one, dict) for one in content):
        raise SemvizError(f"{path}: no list of records, such as [{{'position': ...}}, ...]")
    if len(content) > MOST_LINES:
        raise SemvizError(f"{path}: more than {MOST_LINES} records; split the drive")
    return content


def _of_lines(text: str) -> list[Any] | None:
    """Return the values of JSON lines; None if there is only one, or they are none."""
    lines = [line for line in text.splitlines() if line.strip()]
    try:
        return [parsed_json(line) for line in lines] if len(lines) > 1 else None
    except ValueError:
        return None


def _values(value: Any, name: str = "", depth: int = 0) -> Iterator[tuple[str, str]]:
    """Yield names and texts of the numbers and texts in a record."""
    if isinstance(value, dict) and depth < _MOST_DEPTH:
        for key, inner in value.items():
            yield from _values(inner, f"{name}.{key}" if name else str(key), depth + 1)
    elif isinstance(value, list) and len(value) in _AXES and all(map(_is_number, value)):
        for axis, number in zip(_AXES[len(value)], value, strict=True):
            yield f"{name}.{axis}", repr(number)
    elif isinstance(value, str) or _is_number(value):
        yield name, value if isinstance(value, str) else repr(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
