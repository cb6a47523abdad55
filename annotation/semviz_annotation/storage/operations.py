"""The entries of the operation log, and their hash chain.

The hash of an operation covers its content and the hash of the operation before it.
"""

import hashlib
import json
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal, NamedTuple, TypeAlias

from pydantic import ConfigDict, Field, TypeAdapter

from semviz_annotation.labels.rows import STRICT, Id, RowChange
from semviz_core.common.errors import SemvizError

Origin: TypeAlias = Literal["human", "machine"]
Number: TypeAlias = Annotated[int, Field(ge=1, lt=2**53)]

NO_HASH = ""
"""The hash before the first operation."""


@dataclass(frozen=True)
class Operation:
    """One durable entry of the log."""

    number: Number
    """1, 2, 3, ... without gaps."""
    request_id: Id
    author: str
    origin: Origin
    time: str
    """UTC, ISO 8601, by the writer's clock; the order is by number."""
    kind: str
    """The edit's kind, or ``undo``, ``redo``, ``restore`` or ``name``."""
    changes: tuple[RowChange, ...]
    undoes: Number | None = None
    """Number of the edit that this operation undoes."""
    redoes: Number | None = None
    """Number of the edit that this operation redoes."""
    text: str = ""
    """The given name, the restored state, or the edit that an undo skipped."""
    hash: str = NO_HASH
    """SHA-256 (hex) of the previous hash and this operation; see ``sealed``."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT


CHANGES: TypeAdapter[tuple[RowChange, ...]] = TypeAdapter(tuple[RowChange, ...])
_OPERATION = TypeAdapter(Operation)


class LogEnd(NamedTuple):
    """The last operation of a log. No other log has both."""

    number: int
    hash: str


@dataclass(frozen=True)
class EditBase:
    """What the author of an edit had seen: the operations up to one, and some later requests.

    Fields that other operations wrote are not the edit's to overwrite.
    """

    operation: Annotated[int, Field(ge=0, lt=2**53)]
    known: tuple[Id, ...] = ()
    """Later requests that the author knows, for example one's own."""
    hash: Annotated[str, Field(pattern=r"^([0-9a-f]{64})?$")] = NO_HASH
    """Of that operation: after a backup was restored, its number may be another's. Empty:
    unknown."""

    __pydantic_config__: ClassVar[ConfigDict] = STRICT

    @classmethod
    def at(cls, end: LogEnd) -> "EditBase":
        """Return the base of an author who has seen all operations up to ``end``."""
        return cls(end.number, hash=end.hash)


class Writer(NamedTuple):
    """The operation that last wrote a row."""

    number: int
    author: str
    origin: Origin
    time: str
    kind: str


def sealed(operation: Operation, hash_before: str) -> Operation:
    """Return ``operation`` with its hash; ``hash_before`` is that of the operation before it.

    The input of the hash is ``hash_before`` and the operation's JSON without ``hash``: keys sorted,
    no spaces, ASCII, numbers as Python writes them.
    """
    content = _OPERATION.dump_python(operation, mode="json", exclude={"hash"})
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return replace(operation, hash=hashlib.sha256((hash_before + text).encode()).hexdigest())


class ReplacedLogError(SemvizError):
    """An edit was begun on labels that are no longer there: a backup was restored since."""

    def __init__(self) -> None:
        super().__init__("a backup replaced the labels on which this edit was made")


class BrokenOperationError(SemvizError):
    """An operation of a log does not follow from those before it."""

    def __init__(self, number: int, why: object) -> None:
        super().__init__(f"operation {number}: {why}")
        self.number = number


class ConflictError(SemvizError):
    """An edit would overwrite what its author had not seen."""

    def __init__(
        self, why: str, overwritten: tuple[str, ...], is_deleted: bool, last: Operation
    ) -> None:
        super().__init__(why)
        self.overwritten = overwritten
        """Requests of the operations that the edit would overwrite; known, it is applied."""
        self.is_deleted = is_deleted
        """Whether the edited observation no longer exists."""
        self.last = last
        """The last of these operations."""
