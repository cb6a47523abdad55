"""The entries of the label log, and the chain of hashes that binds them together."""

import hashlib
import json
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal, NamedTuple, TypeAlias

from pydantic import ConfigDict, Field, TypeAdapter

from semviz_annotation.rows import STRICT, Change, Id, Observation
from semviz_core.errors import SemvizError

Origin: TypeAlias = Literal["human", "machine"]
Number: TypeAlias = Annotated[int, Field(ge=1, lt=2**53)]

NO_HASH = ""
"""What the first operation follows."""


@dataclass(frozen=True)
class Operation:
    """One durable entry of the log."""

    number: Number
    """1, 2, 3, ... without gaps."""
    request_id: Id
    author: str
    origin: Origin
    time: str
    """UTC, ISO 8601, of the writer's clock; order is by number."""
    kind: str
    """The edit's kind, or ``undo``, ``redo``, ``restore`` or ``name``."""
    changes: tuple[Change, ...]
    undoes: Number | None = None
    """Number of the edit that this operation takes back."""
    redoes: Number | None = None
    """Number of the edit that this operation does once more."""
    text: str = ""
    """The name that is given, what is restored, or which edits an undo had to leave."""
    hash: str = NO_HASH
    """SHA-256 (hex) over the hash of the operation before and all of this one; see ``sealed``."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT


CHANGES: TypeAdapter[tuple[Change, ...]] = TypeAdapter(tuple[Change, ...])
_OPERATION = TypeAdapter(Operation)


class Writer(NamedTuple):
    """The operation that last wrote a row."""

    number: int
    author: str
    origin: Origin
    time: str
    kind: str


def sealed(operation: Operation, hash_before: str) -> Operation:
    """``operation`` with its hash, given that of the operation before (``NO_HASH`` for the first).

    Hashed are the hash before and the operation's JSON without ``hash``: keys sorted, no spaces,
    ASCII, numbers as Python writes them.
    """
    content = _OPERATION.dump_python(operation, mode="json", exclude={"hash"})
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return replace(operation, hash=hashlib.sha256((hash_before + text).encode()).hexdigest())


class BrokenOperationError(SemvizError):
    """An operation does not follow from those before it."""

    def __init__(self, number: int, why: object) -> None:
        super().__init__(f"operation {number}: {why}")
        self.number = number


class ConflictError(SemvizError):
    """An observation is no longer as the author of an edit saw it."""

    def __init__(self, why: str, current: Observation | None) -> None:
        super().__init__(why)
        self.current = current
        """As it is now; None where it is deleted."""
