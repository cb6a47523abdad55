"""What the classes of other people's models are to us."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semviz_core.arrays import IntArray
from semviz_core.classes import ClassSet
from semviz_core.errors import SemvizError

SIGN = -1
"""A sign whose shape the model does not tell,"""
IGNORED = -2
"""and what is no element."""
_WORDS = {"sign": SIGN, "ignore": IGNORED}

_POLES = ("pole", "utility pole", "street light", "streetlight")
_SIGNS = ("traffic sign", "traffic sign front", "street sign", "stop sign")
_BEFORE = ("object ", "support ")
"""As in Mapillary's ``object--support--utility-pole``."""


@dataclass(frozen=True, eq=False)
class ModelClasses:
    """The classes of a model, in its order."""

    target: IntArray
    """(c,) ids of ours, ``SIGN`` or ``IGNORED``."""
    lines: frozenset[int]
    """Those of the targets that are lines: poles."""

    def __len__(self) -> int:
        return len(self.target)

    @property
    def wanted(self) -> tuple[int, ...]:
        """The targets without ``IGNORED``, in order."""
        return tuple(int(one) for one in np.unique(self.target) if one != IGNORED)


def model_classes(
    labels: Sequence[str], told: Mapping[str, str], classes: ClassSet, path: Path
) -> ModelClasses:
    """From the names of a model's classes (or numbers as words) to ours; the rest is ignored.

    ``path`` is the file that tells. Raises SemvizError where it names what is not there, or
    nothing that we look for.
    """
    target = np.full(len(labels), IGNORED)
    ours = _WORDS | {one.name: one.id for one in classes}
    for label, name in told.items():
        if name not in ours:
            raise SemvizError(
                f"{path}: classes: {label!r} cannot be {name!r}; known are {', '.join(ours)}"
            )
        target[_index(labels, label, path)] = ours[name]
    if (target == IGNORED).all():
        raise SemvizError(f"{path}: classes: no class of the model is a pole or a sign; name one")
    return ModelClasses(target, frozenset(one.id for one in classes if one.kind == "line"))


def usual_classes(labels: Sequence[str]) -> dict[str, str]:
    """What labels of street scenes usually mean: those of Cityscapes, Mapillary, ADE20K, COCO."""
    means = dict.fromkeys(_POLES, "pole") | dict.fromkeys(_SIGNS, "sign")
    found = {label: means.get(_plain(label)) for label in labels}
    return {label: name for label, name in found.items() if name is not None}


def _plain(label: str) -> str:
    words = " ".join(re.findall("[a-z]+", label.lower()))
    for one in _BEFORE:
        words = words.removeprefix(one)
    return words


def _index(labels: Sequence[str], label: str, path: Path) -> int:
    if label in labels:
        return labels.index(label)
    if label.isdecimal() and int(label) < len(labels):
        return int(label)
    some = ", ".join(labels[:20]) + (", ..." if len(labels) > 20 else "")
    raise SemvizError(f"{path}: classes: the model has no class {label!r}; it has {some}")
