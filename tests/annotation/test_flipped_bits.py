"""A flipped bit is never taken for a label: it is refused when opening, or found by the check."""

import sqlite3
from pathlib import Path

import numpy as np
import pytest
from random_edits import random_edit

from semviz_annotation.labels.labels import Labels
from semviz_annotation.storage.backup import check_labels
from semviz_annotation.storage.operations import Operation
from semviz_annotation.storage.store import LabelStore
from semviz_core.common.errors import SemvizError

OPERATIONS = 16
STEP, BITS = 17, (1, 7)
CHUNKS = 8
"""The sweep is cut into parts, so that tests in parallel share it."""


def make(path: Path, with_digest: bool) -> tuple[Labels, tuple[Operation, ...]]:
    rng = np.random.default_rng(5)
    with LabelStore.open(path) as store:
        while store.last_operation < OPERATIONS:
            try:
                store.apply(random_edit(store.labels, rng), "ann")
            except SemvizError:
                continue
        if not with_digest:  # as an earlier version of semviz wrote it
            store._file.connection.execute("DELETE FROM counters WHERE name LIKE '%digest%'")
            store._file.connection.execute("VACUUM")
        return store.labels, store.operations()


def sites(content: bytes) -> list[int]:
    """Every 17th byte that is not in a long run of zeros: those are unused."""
    return [
        at for at in range(0, len(content), STEP) if any(content[at - 8 if at > 8 else 0 : at + 8])
    ]


def opened(path: Path) -> "tuple[Labels, tuple[Operation, ...]] | None":
    """What a store gives; None if it refuses in one line."""
    for end in ("-wal", "-shm"):
        Path(f"{path}{end}").unlink(missing_ok=True)
    try:
        with LabelStore.open(path) as store:
            return store.labels, store.operations()
    except SemvizError as error:
        check_line(error)
        return None


def check_line(error: SemvizError) -> None:
    if "\n" in str(error):
        raise AssertionError(f"several lines: {error}")


def is_sound(path: Path) -> bool:
    try:
        check_labels(path)
    except SemvizError as error:
        check_line(error)
        return False
    return True


@pytest.mark.parametrize("with_digest", [True, False])
@pytest.mark.parametrize("chunk", range(CHUNKS))
def test_no_flipped_bit_gives_other_labels_in_silence(tmp_path, chunk, with_digest):
    """Without the digest, files of earlier versions, other labels are found by the check."""
    path = tmp_path / "labels.db"
    expected = make(path, with_digest)
    content = path.read_bytes()
    refused = found = 0
    for at in sites(content)[chunk :: CHUNKS * (1 if with_digest else 5)]:
        for bit in BITS:
            flipped = bytearray(content)
            flipped[at] ^= 1 << bit
            path.write_bytes(flipped)
            sound, got = is_sound(path), opened(path)
            refused += got is None
            found += not sound
            if got is not None and with_digest:
                assert got[0] == expected[0], f"byte {at}, bit {bit}: other labels"
            assert not sound or got is None or got == expected, f"byte {at}, bit {bit}: in silence"
    assert found >= refused > 0


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE elements SET number = number + 0.5",
        "UPDATE observations SET side = 'lefu' WHERE side = 'left'",
        "UPDATE observations SET anchor_u = 'x'",
        "UPDATE writers SET row_tag = 'elemenu'",
        "UPDATE writers SET row_id = 'x' || row_id WHERE row_tag = 'review'",
        "UPDATE reviews SET state = x'ff'",
        "UPDATE dismissals SET why = CAST(x'80' AS TEXT)",
        "UPDATE operations SET author = CAST(x'80' AS TEXT) WHERE number = 1",
        "UPDATE counters SET value = 'x'",
    ],
)
def test_a_value_of_another_kind_is_named_and_no_traceback(tmp_path, statement):
    path = tmp_path / "labels.db"
    make(path, with_digest=False)
    connection = sqlite3.connect(path, isolation_level=None)
    connection.execute("PRAGMA ignore_check_constraints = ON")
    connection.execute("DROP TRIGGER operations_stay")
    connection.execute(statement)
    connection.close()
    assert not is_sound(path)
    opened(path)
