"""The operation log as JSON lines: a header, then one operation a line, oldest first."""

import json
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from semviz_annotation.edits import first_fault
from semviz_annotation.storing.operations import NO_HASH, BrokenOperationError, Operation, sealed
from semviz_annotation.storing.store import LabelStore
from semviz_core.errors import SemvizError
from semviz_core.files import replacing

FORMAT = "semviz-operations"
VERSION = 3
"""Version 1 had neither hashes nor texts, version 2 no judgements."""
_OPERATION = TypeAdapter(Operation)


def export_operations(store: LabelStore, path: Path) -> None:
    """Write the whole log of ``store`` to ``path``, whole or not at all."""
    header = json.dumps({"format": FORMAT, "version": VERSION})
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(header + "\n")
        for operation in store.operations():
            file.write(_OPERATION.dump_json(operation).decode() + "\n")


def import_operations(path: Path, store: LabelStore) -> int:
    """Append to ``store`` what ``path`` has more than it; return how many operations.

    The store's log must be the beginning of the file's, as it is when the store is new. Raises
    SemvizError, naming the line, where it is not or a line is broken; then nothing is imported.
    """
    theirs = _read(path)
    mine = store.operations()
    for number, one in enumerate(mine, 1):
        if number > len(theirs) or theirs[number - 1] != one:
            raise SemvizError(
                f"{path}, line {number + 1}: not operation {number} of {store.path}, which has "
                "labels of its own; import into a new workspace"
            )
    try:
        store.extend(theirs[len(mine) :])
    except BrokenOperationError as error:
        raise SemvizError(f"{path}, line {error.number + 1}: {error}; nothing imported") from None
    return len(theirs) - len(mine)


def _read(path: Path) -> list[Operation]:
    try:
        lines = path.read_bytes().splitlines()
    except OSError as error:
        raise SemvizError(f"{path}: cannot be read ({error.strerror})") from None
    version = _read_header(path, lines[0] if lines else b"")
    operations: list[Operation] = []
    for number, line in enumerate(lines[1:], 1):
        try:
            operation = _OPERATION.validate_json(line)
            if operation.number != number:
                raise SemvizError(f"number {operation.number} where {number} follows")
        except (ValidationError, SemvizError) as error:
            raise SemvizError(
                f"{path}, line {number + 1}: {first_fault(error)}; nothing imported"
            ) from None
        if version == 1:
            operation = sealed(operation, operations[-1].hash if operations else NO_HASH)
        operations.append(operation)
    return operations


def _read_header(path: Path, line: bytes) -> int:
    """The version of the log."""
    try:
        header = json.loads(line)
        known = header["format"] == FORMAT
        version = int(header["version"])
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
        known = False
    if not known:
        raise SemvizError(f"{path}, line 1: not a log of label operations of semviz")
    if version > VERSION:
        raise SemvizError(
            f"{path}: log version {version}, this semviz reads up to {VERSION}; update"
        )
    return version
