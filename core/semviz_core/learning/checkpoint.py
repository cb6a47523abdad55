"""A training on disk: one file, whole at any moment, from which it goes on exactly."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import safetensors.torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from semviz_core.errors import SemvizError
from semviz_core.files import replacing
from semviz_core.learning.history import Window

FORMAT = 1
_KEY = "semviz training"


@dataclass
class Course:
    """How far a training has come, and how."""

    samples: int = 0
    skipped: int = 0
    """Steps that were not made, because a number was not finite."""
    plans: list[tuple[int, int]] = field(default_factory=list)
    """From which sample on it was to see how many in all: more than one if people changed it."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall time on each machine."""
    held_out: dict[str, float] = field(default_factory=dict)
    """The last figures."""
    window: Window = field(default_factory=dict)
    """Losses since the last line of the history."""

    @property
    def of(self) -> int:
        """Samples in all."""
        return self.plans[-1][1]


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A training's state."""

    identity: dict[str, Any]
    """What must stay the same: task, its options, seed, batch; JSON."""
    course: Course
    tensors: dict[str, Tensor]
    """As ``Learner.state``."""

    def save(self, path: Path) -> None:
        """Replace ``path``. Raises SemvizError where that fails; the former file then stays."""
        told = {"format": FORMAT, "identity": self.identity, "course": asdict(self.course)}
        content = safetensors.torch.save(self.tensors, metadata={_KEY: json.dumps(told)})
        with replacing(path) as temporary:
            temporary.write_bytes(content)

    @classmethod
    def load(cls, path: Path) -> "Checkpoint":
        """Raises SemvizError where it is no checkpoint, or of another version of semviz."""
        try:
            with safe_open(path, framework="pt") as file:
                told = json.loads((file.metadata() or {})[_KEY])
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            if told["format"] == FORMAT:
                return cls(told["identity"], Course(**told["course"]), tensors)
        except (OSError, SafetensorError, KeyError, TypeError, ValueError):
            raise SemvizError(f"{path}: not a checkpoint of semviz, or damaged") from None
        raise SemvizError(
            f"{path}: a checkpoint of format {told['format']}; this semviz has {FORMAT}: use the "
            "version that it was made with, or give another --out"
        )

    def check(self, identity: dict[str, Any], path: Path) -> None:
        """Raises SemvizError where the checkpoint is of another training."""
        differing = _differences("", self.identity, json.loads(json.dumps(identity)))
        if differing:
            more = f" and {len(differing) - 2} more" if len(differing) > 2 else ""
            raise SemvizError(
                f"{path}: of another training ({'; '.join(differing[:2])}{more}): "
                "give another --out"
            )


def _differences(name: str, was: Any, now: Any) -> list[str]:
    """``batch was 12, is 24``, for each number or text that differs."""
    if isinstance(was, dict) and isinstance(now, dict):
        return [
            one
            for key in {**was, **now}
            for one in _differences(f"{name} {key}".strip(), was.get(key), now.get(key))
        ]
    return [] if was == now else [f"{name} was {was}, is {now}"]
