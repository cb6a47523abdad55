"""Frozen dataclasses to one JSON structure and a pool of numbers per dtype, and back, bit for bit.

The structure repeats the value's tree: an object for a dataclass, null for None, a list for a
tuple, and for an array its shape. The numbers of the arrays follow one another in the pool of
their dtype, in the tree's order. Decoding goes by the type hints of the class asked for, so a
file can never make anything else than that. What an older file lacks takes its default.
"""

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Any, Final, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

Pools = dict[str, NDArray[Any]]
"""Numbers (n,) by the name of their dtype."""
Value = TypeVar("Value")

DTYPES: Final = ("float64", "int64", "bool")


def encode(value: object) -> tuple[Any, Pools]:
    """The JSON structure and the pools of a dataclass value; all of DTYPES are there.

    Raises TypeError where an array has another dtype than its type hint says.
    """
    parts: dict[str, list[NDArray[Any]]] = {name: [np.zeros(0, name)] for name in DTYPES}
    structure = _encode(value, type(value), parts)
    return structure, {name: np.concatenate(arrays) for name, arrays in parts.items()}


def decode(kind: type[Value], structure: Any, pools: Mapping[str, NDArray[Any]]) -> Value:
    """The value of class ``kind`` that ``encode`` took apart; its arrays are views of the pools.

    Raises KeyError, TypeError, ValueError or SemvizError where the parts don't fit together.
    """
    return cast(Value, _decode(structure, kind, _Supply(pools)))


class _Supply:
    """Hands out pools piece by piece."""

    def __init__(self, pools: Mapping[str, NDArray[Any]]) -> None:
        self._pools = pools
        self._used: Counter[str] = Counter()

    def take(self, dtype: str, shape: list[int]) -> NDArray[Any]:
        start = self._used[dtype]
        self._used[dtype] = end = start + math.prod(shape)
        return self._pools[dtype][start:end].reshape(shape)


def _encode(value: Any, hint: Any, parts: dict[str, list[NDArray[Any]]]) -> Any:
    match _kind(hint):
        case "optional", inner:
            return None if value is None else _encode(value, inner, parts)
        case "dataclass", members:
            return {name: _encode(getattr(value, name), one, parts) for name, one in members}
        case "array", dtype:
            if value.dtype != dtype:
                raise TypeError(f"an array of {dtype} is expected here, not {value.dtype}")
            parts[dtype].append(value.reshape(-1))
            return list(value.shape)
        case "tuple", inner:
            return [_encode(one, inner, parts) for one in value]
        case "dict", inner:
            return {key: _encode(one, inner, parts) for key, one in value.items()}
        case "float", _:
            return float(value) if math.isfinite(value) else str(float(value))  # JSON has no NaN
        case "plain", _:
            return hint(value)  # JSON does not take numpy's scalars
        case _:
            return value


def _decode(node: Any, hint: Any, supply: _Supply) -> Any:
    match _kind(hint):
        case "optional", inner:
            return None if node is None else _decode(node, inner, supply)
        case "dataclass", members:
            there = [(name, one) for name, one in members if name in node]
            return hint(**{name: _decode(node[name], one, supply) for name, one in there})
        case "array", dtype:
            return supply.take(dtype, node)
        case "tuple", inner:
            return tuple(_decode(one, inner, supply) for one in node)
        case "dict", inner:
            return {key: _decode(one, inner, supply) for key, one in node.items()}
        case "float", _:
            return float(node)
        case _:
            return node


@cache
def _kind(hint: Any) -> tuple[str, Any]:
    """What a type hint asks for, and what is inside it."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        (kind,) = (one for one in inner if one is not NoneType)
        return "optional", kind
    if is_dataclass(hint):
        hints = get_type_hints(hint)
        return "dataclass", tuple((one.name, hints[one.name]) for one in fields(hint))
    if origin is np.ndarray:
        return "array", np.dtype(get_args(inner[1])[0]).name
    if origin is tuple and len({one for one in inner if one is not Ellipsis}) == 1:
        return "tuple", inner[0]
    if origin in (dict, Mapping):
        return "dict", inner[1]
    if hint is float:
        return "float", None
    if hint in (int, str, bool):
        return "plain", None
    if hint is Any or origin is Literal:
        return "as it is", None
    raise TypeError(f"the codec does not know {hint}")
