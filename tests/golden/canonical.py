"""Canonical text of values, equal if they are equal to the last bit, and its hash."""

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

MASKED_FIELDS = frozenset({"time_ms", "version", "created", "made_by"})
"""Fields of recorded classes with times, versions or durations. ``made_by`` holds the version and
the options as Python text, for people."""

NEWER_FIELDS = frozenset({"attributes", "camera"})
"""Fields that recorded classes have got since, left out while they are empty."""

_ID = re.compile(r"\b[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}\b")


def sha(data: bytes | str) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256."""
    return hashlib.sha256(data.encode() if isinstance(data, str) else data).hexdigest()[:16]


def plain(value: Any) -> Any:
    """Return a value as JSON: dataclasses by field names, floats and arrays to the last bit.

    Class names are left out, because they may change. The sign of NaN is ignored.
    """
    match value:
        case None | bool() | int() | str():
            return value
        case float():
            return value.hex()
        case bytes():
            return sha(value)
        case np.generic():
            return plain(value.item())
        case np.ndarray():
            return [value.dtype.name, list(value.shape), _array(value)]
        case Path():
            return value.as_posix()
        case Mapping():
            return {str(name): plain(item) for name, item in value.items()}
    if is_dataclass(value):
        names = (field.name for field in fields(value) if field.name not in MASKED_FIELDS)
        values = {name: plain(getattr(value, name)) for name in names}
        return {name: item for name, item in values.items() if item or name not in NEWER_FIELDS}
    if isinstance(value, Iterable):
        return [plain(item) for item in value]
    raise TypeError(f"a golden value cannot hold {type(value).__name__}")


def digest(value: Any) -> str:
    """Return the hash of a value."""
    return sha(json.dumps(plain(value), sort_keys=True))


def numbered_ids(text: str) -> str:
    """Replace every UUID by its number, in the order of first appearance."""
    numbers: dict[str, int] = {}
    return _ID.sub(lambda match: f"<id {numbers.setdefault(match[0], len(numbers))}>", text)


def _array(value: np.ndarray) -> str:
    if value.dtype.kind == "f":
        value = np.where(np.isnan(value), np.array(np.nan, value.dtype), value)
    return sha(np.ascontiguousarray(value).tobytes())
