"""All kinds of change, and sets of them as JSON and in words."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, fields
from typing import Any

from semviz.trying.change import Change
from semviz.trying.map_changes import AddElement, DropElement, ElementClass
from semviz.trying.pair_changes import ForbidPair, ForcePair, ForceTruePairs
from semviz.trying.prior_changes import CropRadius, MovePrior, PriorAtTruth, PriorSigma
from semviz.trying.seen_changes import (
    DetectionClass,
    DropDetection,
    IgnoreClasses,
    LeastScore,
    NoiseFactor,
)
from semviz.trying.solver_changes import StartAtTruth, UseMethod
from semviz_core.errors import SemvizError
from semviz_core.semantic_map import SemanticMap

KINDS: dict[str, type[Change]] = {
    "drop element": DropElement,
    "add element": AddElement,
    "element class": ElementClass,
    "drop detection": DropDetection,
    "detection class": DetectionClass,
    "least score": LeastScore,
    "noise": NoiseFactor,
    "ignore classes": IgnoreClasses,
    "force pair": ForcePair,
    "forbid pair": ForbidPair,
    "true pairs": ForceTruePairs,
    "move prior": MovePrior,
    "prior at truth": PriorAtTruth,
    "prior sigma": PriorSigma,
    "crop radius": CropRadius,
    "method": UseMethod,
    "start at truth": StartAtTruth,
}
_NAMES = {kind: name for name, kind in KINDS.items()}


def to_json(change: Change) -> dict[str, Any]:
    """``{"change": NAME, ...}`` with the change's own values."""
    return {"change": _NAMES[type(change)], **asdict(change)}


def from_json(value: object) -> Change:
    """The change that ``to_json`` made. SemvizError for anything else."""
    told = dict(value) if isinstance(value, dict) else {}
    name = str(told.pop("change", None))
    if name not in KINDS:
        raise SemvizError(f"there is no change '{name}'; there are {', '.join(KINDS)}")
    kind = KINDS[name]
    if told.keys() != {one.name for one in fields(kind)}:
        wanted = ", ".join(one.name for one in fields(kind)) or "nothing else"
        raise SemvizError(f"change '{name}' is told by {wanted}, not by {', '.join(told)}")
    return kind(**{one.name: _value(one.name, one.type, told[one.name]) for one in fields(kind)})


def as_text(changes: Iterable[Change]) -> str:
    """A small JSON file of changes."""
    return json.dumps({"changes": [to_json(one) for one in changes]}, indent=1) + "\n"


def in_words(changes: Sequence[Change], semantic_map: SemanticMap) -> str:
    """As it follows 'Trying'; empty without changes."""
    *most, last = [one.words(semantic_map) for one in changes] or [""]
    return f"{', '.join(most)} and {last}" if most else last


def _value(name: str, kind: object, value: object) -> object:
    """A value of one field, of the type that it says."""
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if type(value) is kind:
        return value
    raise SemvizError(f"change: {name} is {value!r}; give a value of another type")
