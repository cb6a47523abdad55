"""Read YAML of others as plain values: no tags but OpenCV's matrix, no aliases, limited size."""

from math import prod
from pathlib import Path
from typing import Any

import yaml

from semviz_core.common.arrays import FloatArray, float_array
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import first_line, read_limited

MOST_YAML_BYTES = 2**18
"""A calibration has some kB; PyYAML reads about 1 MB in ten seconds."""
_MOST_DEPTH = 40
_BROKEN = (
    *(yaml.YAMLError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError),
    RecursionError,
)
"""What PyYAML raises: other than its own errors for a value that does not fit its explicit tag."""


class _PlainLoader(yaml.SafeLoader):  # type: ignore[misc]
    """A few lines of aliases unpack to gigabytes, so there are none; nothing is unpickled."""

    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("an alias (*name); write the value itself")
        self.depth += 1
        if self.depth > _MOST_DEPTH:
            raise yaml.YAMLError(f"more than {_MOST_DEPTH} levels")
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


def _whole_number(loader: _PlainLoader, node: Any) -> int:
    """Numbers of more digits are no calibration, and Python refuses to print them."""
    number = int(loader.construct_yaml_int(node))
    if abs(number) >= 2**63:
        raise yaml.YAMLError("a number beyond 64 bits")
    return number


_PlainLoader.add_constructor("tag:yaml.org,2002:int", _whole_number)
_PlainLoader.add_constructor(
    "tag:yaml.org,2002:opencv-matrix",
    lambda loader, node: loader.construct_mapping(node, deep=True),
)


def read_yaml(path: Path) -> dict[str, Any]:
    """Return a file's mapping. Raise SemvizError if it is none, or not plain YAML."""
    try:
        text = read_limited(path, MOST_YAML_BYTES).decode("utf-8-sig")
        if text.startswith("%YAML:"):  # OpenCV's first line is not YAML
            text = text.partition("\n")[2]
        content = yaml.load(text, _PlainLoader)
    except _BROKEN as error:
        fault = first_line(getattr(error, "problem", None) or error)
        line = getattr(getattr(error, "problem_mark", None), "line", None)
        where = "" if line is None else f", line {line + 1}"
        raise SemvizError(f"{path}{where}: not readable as YAML ({fault}); repair it") from None
    if not isinstance(content, dict):
        raise SemvizError(
            f"{path}: no calibration that is read; write its numbers into a TOML file, as "
            "docs/own-drive.md shows"
        )
    return {str(key): value for key, value in content.items()}


def numbers_of(value: Any, shape: tuple[int | None, ...], where: str) -> FloatArray:
    """Return a list of numbers, or OpenCV's matrix with ``data``, as an array of ``shape``.

    YAML reads ``1e-5`` as text, which is a number here. Raise SemvizError, with ``where``.
    """
    data = value.get("data") if isinstance(value, dict) else value
    try:
        flat = [float(number) for row in _listed(data) for number in _listed(row)]
    except (TypeError, ValueError, OverflowError):
        raise SemvizError(f"{where}: not numbers; repair it") from None
    array = float_array(flat, (None,), where)
    if None not in shape and array.size != prod(side or 0 for side in shape):
        count = prod(side or 0 for side in shape)
        raise SemvizError(f"{where}: {array.size} numbers, expected {count}")
    return array.reshape([-1 if side is None else side for side in shape])


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]
