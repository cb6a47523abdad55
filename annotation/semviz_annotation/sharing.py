"""A dictionary whose copies share what neither has changed."""

from collections.abc import Iterator, Mapping, MutableMapping, ValuesView
from itertools import chain
from typing import Any, TypeVar
from zlib import crc32

SHARDS = 256
"""Parts that are copied alone: a few hundred entries each at 100,000."""

K = TypeVar("K", bound=str | int)
V = TypeVar("V")
_EMPTY: dict[Any, Any] = {}


class SharingDict(MutableMapping[K, V]):
    """Copying takes a microsecond at any size; the first change of a shard then copies that shard.

    Iteration is in the order of shards, and within one as inserted: the same in every process.
    """

    __slots__ = ("_own", "_shards")

    def __init__(self, entries: Mapping[K, V] = _EMPTY) -> None:
        self._own: set[int] = set()
        """Shards that no copy shares."""
        self._shards: list[dict[K, V]] = [_EMPTY] * SHARDS
        if isinstance(entries, SharingDict):
            entries._own.clear()
            self._shards = entries._shards.copy()
        elif entries:
            shards: list[dict[K, V]] = [{} for _ in range(SHARDS)]
            for key, value in entries.items():
                shards[_index(key)][key] = value
            self._shards = shards

    @classmethod
    def of(cls, entries: Mapping[K, V]) -> "SharingDict[K, V]":
        """``entries`` themselves where they are a sharing dictionary, else one of them."""
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

    def differing(self, other: "SharingDict[K, V]") -> set[K]:
        """Keys whose values are other objects here and there, or that only one has."""
        pairs = zip(self._shards, other._shards, strict=True)
        return {
            key
            for here, there in pairs
            if here is not there
            for key in here.keys() | there.keys()
            if here.get(key) is not there.get(key)
        }

    def _shard_to_change(self, key: K) -> dict[K, V]:
        index = _index(key)
        if index not in self._own:
            self._shards[index] = self._shards[index].copy()
            self._own.add(index)
        return self._shards[index]


class _Values(ValuesView[V]):
    """Without looking up each key."""

    _mapping: SharingDict[Any, V]

    def __iter__(self) -> Iterator[V]:
        return chain.from_iterable(shard.values() for shard in self._mapping._shards)


def _index(key: str | int) -> int:
    return (key if isinstance(key, int) else crc32(key.encode())) % SHARDS
