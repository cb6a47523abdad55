"""Digest of all label rows, stored with them, so that opening a file finds altered rows.

It is the sum of the hashes of all rows: an edit updates it without reading other rows. An earlier
version of semviz writes rows without it. The number of its operation shows that it is out of date.
"""

import hashlib
import sqlite3
from collections.abc import Iterable

from semviz_annotation.labels.rows import Row, RowChange
from semviz_annotation.storage.tables import row_values

_MODULUS = 2**62
"""SQLite's integers have 63 bits."""
_DIGEST, _NUMBER = "digest of all rows", "operation of the digest"


def digest_of(rows: Iterable[Row]) -> int:
    """Return the digest of ``rows``, in any order."""
    return sum(map(_row_digest, rows)) % _MODULUS


def digest_after(digest: int, changes: Iterable[RowChange]) -> int:
    """Return the digest after ``changes`` to the rows of ``digest``."""
    for change in changes:
        if change.before is not None:
            digest -= _row_digest(change.before)
        if change.after is not None:
            digest += _row_digest(change.after)
    return digest % _MODULUS


def _row_digest(row: Row) -> int:
    text = f"{type(row).__name__} {row_values(row)!r}"
    return int.from_bytes(hashlib.blake2b(text.encode(errors="replace"), digest_size=8).digest())


def write_digest(connection: sqlite3.Connection, digest: int, number: int) -> None:
    """Store the digest after operation ``number``, within the open transaction."""
    connection.executemany(
        "INSERT INTO counters VALUES (?, ?) ON CONFLICT DO UPDATE SET value = excluded.value",
        [(_DIGEST, digest), (_NUMBER, number)],
    )


def read_digest(connection: sqlite3.Connection, number: int) -> int | None:
    """Return the stored digest after operation ``number``; None if there is none."""
    stored = dict(
        connection.execute(
            "SELECT name, value FROM counters WHERE name IN (?, ?)", (_DIGEST, _NUMBER)
        )
    )
    return stored.get(_DIGEST) if stored.get(_NUMBER) == number else None
