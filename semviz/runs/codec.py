"""Encode frozen dataclasses as one JSON structure and a pool of numbers per dtype, exactly.

The structure has the value's tree: an object for a dataclass, null for None, a list for a tuple,
and the shape for an array. The pool of a dtype holds the numbers of its arrays in tree order.
Decoding follows the type hints of the requested class, so a file can never create anything else.
Fields missing in an older file take their defaults. Checksums are of a run's rows: of its head, of
each frame with its images, of its end.
"""

import math
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Any, Final, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from semviz.runs import run
from semviz_core.common.errors import SemvizError

Pools = dict[str, NDArray[Any]]
"""Numbers (n,) by the name of their dtype."""
Value = TypeVar("Value")

DTYPES: Final = ("float64", "int64", "bool")


def encode(value: object) -> tuple[Any, Pools]:
    """Return the JSON structure of a dataclass value, and a pool for each of DTYPES.

    Raise TypeError if the dtype of an array differs from its type hint.
    """
    parts: dict[str, list[NDArray[Any]]] = {name: [np.zeros(0, name)] for name in DTYPES}
    structure = _encode(value, type(value), parts)
    return structure, {name: np.concatenate(arrays) for name, arrays in parts.items()}


def decode(kind: type[Value], structure: Any, pools: Mapping[str, NDArray[Any]]) -> Value:
    """Return the value of class ``kind`` from the result of ``encode``; arrays are views of pools.

    Raise KeyError, TypeError, ValueError or SemvizError if the parts do not fit together.
    """
    return cast(Value, _decode(structure, kind, _PoolReader(pools)))


class _PoolReader:
    """Reads the arrays of each pool one after the other."""

    def __init__(self, pools: Mapping[str, NDArray[Any]]) -> None:
        self._pools = pools
        self._used: Counter[str] = Counter()

    def take(self, dtype: str, shape: list[int]) -> NDArray[Any]:
        if not isinstance(shape, list) or not all(
            type(side) is int and side >= 0 for side in shape
        ):
            raise ValueError("the shape of an array is not a list of sizes")
        start = self._used[dtype]
        self._used[dtype] = end = start + math.prod(shape)
        return self._pools[dtype][start:end].reshape(shape)


def _encode(value: Any, hint: Any, parts: dict[str, list[NDArray[Any]]]) -> Any:
    match _kind(hint):
        case "optional", inner:
            return None if value is None else _encode(value, inner, parts)
        case "dataclass", members:
            return {name: _encode(getattr(value, name), inner, parts) for name, inner in members}
        case "array", dtype:
            if value.dtype != dtype:
                raise TypeError(f"an array of {dtype} is expected here, not {value.dtype}")
            parts[dtype].append(value.reshape(-1))
            return list(value.shape)
        case "tuple", inner:
            return [_encode(item, inner, parts) for item in value]
        case (("dict" | "numbered"), inner):
            return {key: _encode(item, inner, parts) for key, item in value.items()}
        case "float", _:
            return float(value) if math.isfinite(value) else str(float(value))  # JSON has no NaN
        case "plain", _:
            return hint(value)  # JSON does not take numpy's scalars
        case _:
            return value


def _decode(node: Any, hint: Any, pools: _PoolReader) -> Any:
    match _kind(hint):
        case "optional", inner:
            return None if node is None else _decode(node, inner, pools)
        case "dataclass", members:
            present = [(name, inner) for name, inner in members if name in node]
            return hint(**{name: _decode(node[name], inner, pools) for name, inner in present})
        case "array", dtype:
            return pools.take(dtype, node)
        case "tuple", inner:
            return tuple(_decode(item, inner, pools) for item in node)
        case "dict", inner:
            return {key: _decode(item, inner, pools) for key, item in node.items()}
        case "numbered", inner:  # JSON makes texts of numbers that are keys
            return {int(key): _decode(item, inner, pools) for key, item in node.items()}
        case "float", _:
            return float(node)
        case _:
            return node


@cache
def _kind(hint: Any) -> tuple[str, Any]:
    """Return the kind of a type hint, and its inner hint, members or dtype."""
    origin, inner = get_origin(hint), get_args(hint)
    if (alias := getattr(origin, "__value__", None)) is not None:  # NDArray, from NumPy 2.5 on
        return _kind(alias[inner])
    if origin in (Union, UnionType):
        (kind,) = (choice for choice in inner if choice is not NoneType)
        return "optional", kind
    if is_dataclass(hint):
        hints = get_type_hints(hint)
        return "dataclass", tuple((field.name, hints[field.name]) for field in fields(hint))
    if origin is np.ndarray:
        return "array", np.dtype(get_args(inner[1])[0]).name
    if origin is tuple and len({item for item in inner if item is not Ellipsis}) == 1:
        return "tuple", inner[0]
    if origin in (dict, Mapping):
        return "numbered" if inner[0] is int else "dict", inner[1]
    if hint is float:
        return "float", None
    if hint in (int, str, bool):
        return "plain", None
    if hint is Any or origin is Literal:
        return "as it is", None
    raise TypeError(f"the codec does not know {hint}")


class DamagedRowError(SemvizError):
    """A row is not as it was written."""


def row_checksum(
    entity: str,
    frame: int,
    row: Mapping[str, NDArray[Any] | str],
    images: Sequence[bytes | None] = (),
) -> int:
    """Return the CRC-32 of a row: its entity, frame number (0 without), components and images.

    Each part is preceded by its name, type and length, so that none can pass for another.
    """
    checksum = zlib.crc32(f"{entity} {frame}\n".encode())
    for name in sorted(row.keys() - {run.CHECKSUM}):
        value = row[name]
        content = value.encode() if isinstance(value, str) else np.ascontiguousarray(value).data
        kind = "text" if isinstance(value, str) else value.dtype.str
        checksum = zlib.crc32(f"{name} {kind} {len(content)}\n".encode(), checksum)
        checksum = zlib.crc32(content, checksum)
    for image in images:
        checksum = zlib.crc32(f"image {-1 if image is None else len(image)}\n".encode(), checksum)
        checksum = zlib.crc32(image or b"", checksum)
    return checksum


def verify_row(
    entity: str, frame: int, row: Mapping[str, Any], images: Sequence[bytes | None] = ()
) -> None:
    """Raise DamagedRowError if the row does not have the checksum that it was written with."""
    try:
        values = {name: value[0] if value.dtype == object else value for name, value in row.items()}
        (recorded,) = values[run.CHECKSUM].tolist()
        is_sound = recorded == row_checksum(entity, frame, values, images)
    except (KeyError, IndexError, ValueError, AttributeError):
        is_sound = False
    if not is_sound:
        raise DamagedRowError(f"{entity} of frame {frame} is not as it was written")
