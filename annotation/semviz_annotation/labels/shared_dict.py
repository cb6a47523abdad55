"""A dictionary that is copied on write, shard by shard: a copy takes a microsecond at any size."""

from collections.abc import Iterator, Mapping, MutableMapping, ValuesView
from itertools import chain
from typing import Any, TypeVar
from zlib import crc32

SHARDS = 256
"""Number of shards: a few hundred entries each at 100,000."""

K = TypeVar("K", bound=str | int)
V = TypeVar("V")
_EMPTY: dict[Any, Any] = {}


class SharedDict(MutableMapping[K, V]):
    """A copy-on-write dictionary, copied by its constructor.

    Iteration goes by shard, then by insertion: the same order in every process.
    """

    __slots__ = ("_own", "_shards")

    def __init__(self, entries: Mapping[K, V] = _EMPTY) -> None:
        self._own: set[int] = set()
        """Shards that no copy shares, so they can change in place."""
        self._shards: list[dict[K, V]] = [_EMPTY] * SHARDS
        if isinstance(entries, SharedDict):
            entries._own.clear()
            self._shards = entries._shards.copy()
        elif entries:
            shards: list[dict[K, V]] = [{} for _ in range(SHARDS)]
            for key, value in entries.items():
                shards[_index(key)][key] = value
            self._shards = shards

    @classmethod
    def of(cls, entries: Mapping[K, V]) -> "SharedDict[K, V]":
        """Return ``entries``, converted unless they are a ``SharedDict`` already."""
        return entries if isinstance(entries, cls) else cls(entries)

    def __getitem__(self, key: K) -> V:
        return self._shards[_index(key)][key]

    def __setitem__(self, key: K, value: V) -> None:
        self._shard_to_change(key)[key] = value

    def __delitem__(self, key: K) -> None:
        del self._shard_to_change(key)[key]

    def __iter__(self) -> Iterator[K]:
        return chain.from_iterable(self._shards)

    def values(self) -> ValuesView[V]:
        return _Values(self)

    def __len__(self) -> int:
        return sum(map(len, self._shards))

    def __repr__(self) -> str:
        return repr(dict(self))

    def differing(self, other: "SharedDict[K, V]") -> set[K]:
        """Return the keys whose values are different objects, or that only one dictionary has."""
        pairs = zip(self._shards, other._shards, strict=True)
        return {
            key
            for first, second in pairs
            if first is not second
            for key in first.keys() | second.keys()
            if first.get(key) is not second.get(key)
        }

    def _shard_to_change(self, key: K) -> dict[K, V]:
        index = _index(key)
        if index not in self._own:
            self._shards[index] = self._shards[index].copy()
            self._own.add(index)
        return self._shards[index]


class _Values(ValuesView[V]):
    """Iterates over the shards without looking up each key."""

    _mapping: SharedDict[Any, V]

    def __iter__(self) -> Iterator[V]:
        return chain.from_iterable(shard.values() for shard in self._mapping._shards)


def _index(key: str | int) -> int:
    return (key if isinstance(key, int) else crc32(key.encode())) % SHARDS
