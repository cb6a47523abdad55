"""What people can do to labels, as values.

Every edit computes its row changes from the state alone; nothing here touches a file or a clock.
An edit that makes no sense raises SemvizError and changes nothing.
"""

import json
from collections.abc import Iterator
from typing import Annotated, Any, Protocol, TypeAlias

from pydantic import Field, TypeAdapter, ValidationError

from semviz_annotation.editing.drawing import (
    AddMany,
    AddObservation,
    DeleteMany,
    DeleteObservation,
    MoveObservation,
    SetKnown,
    SwapEnds,
)
from semviz_annotation.editing.identity import DeleteElement, Link, SetClass, Unlink
from semviz_annotation.editing.verdicts import Dismiss, Judge, ReviewFrame, TakeBack
from semviz_annotation.labels import Labels
from semviz_annotation.rows import Change
from semviz_annotation.rules import Rules
from semviz_core.errors import SemvizError

__all__ = [
    "AddMany",
    "AddObservation",
    "AnyEdit",
    "DeleteElement",
    "DeleteMany",
    "DeleteObservation",
    "Dismiss",
    "Edit",
    "Judge",
    "Link",
    "MoveObservation",
    "ReviewFrame",
    "SetClass",
    "SetKnown",
    "SwapEnds",
    "TakeBack",
    "Unlink",
    "edit_from_json",
    "edit_to_json",
    "first_fault",
]


class AnyEdit(Protocol):
    """What a store can apply: an ``Edit``, or one that no page sends, such as an import."""

    @property
    def kind(self) -> str:
        """What the log calls it."""
        ...

    def changes(self, labels: Labels, rules: Rules) -> Iterator[Change]:
        """The rows that change; SemvizError where it makes no sense in ``labels``."""
        ...


Edit: TypeAlias = (
    AddObservation
    | AddMany
    | Dismiss
    | MoveObservation
    | SetKnown
    | SwapEnds
    | DeleteObservation
    | DeleteMany
    | DeleteElement
    | Link
    | Unlink
    | SetClass
    | ReviewFrame
    | Judge
    | TakeBack
)

_EDIT: TypeAdapter[Edit] = TypeAdapter(Annotated[Edit, Field(discriminator="kind")])


def edit_from_json(data: object) -> Edit:
    """An edit from parsed JSON, such as ``{"kind": "delete", "observation_id": "..."}``.

    Raises SemvizError naming the field that is wrong.
    """
    try:
        return _EDIT.validate_json(json.dumps(data))
    except (ValidationError, TypeError, ValueError) as error:
        raise SemvizError(f"not an edit: {first_fault(error)}") from None


def edit_to_json(edit: Edit) -> dict[str, Any]:
    """What ``edit_from_json`` reads."""
    result: dict[str, Any] = _EDIT.dump_python(edit, mode="json")
    return result


def first_fault(error: Exception) -> str:
    """The first thing that pydantic found wrong, on one line."""
    if not isinstance(error, ValidationError):
        return str(error)
    fault = error.errors(include_url=False, include_input=False)[0]
    where = ".".join(str(part) for part in fault["loc"])
    return f"{where}: {fault['msg']}" if where else fault["msg"]
