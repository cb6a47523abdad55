"""Store a training's state in one file, and its losses as lines of JSON.

The file is complete at any moment, and the training resumes from it exactly. A loss line is a
mean over some hundred steps. Both may come from others: what they hold is checked when read.
"""

import json
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, ClassVar

import safetensors.torch
import torch
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter
from safetensors import SafetensorError, safe_open
from torch import Tensor

from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.common.limits import (
    MOST_TENSOR_BYTES,
    MOST_TEXT_BYTES,
    check_file,
    parsed_json,
    read_limited,
    shown,
)

WINDOW_STEPS = 200
Count = Annotated[int, Field(ge=0, le=2**53)]
Finite = int | Annotated[float, Field(allow_inf_nan=False)]
"""Whole numbers stay whole, so that a file that is read and written again stays the same."""
Window = dict[str, tuple[Finite, Count]]
"""Sum and count of each value's finite occurrences."""


class _Loaded(BaseModel):
    """A base of what is read from JSON."""

    model_config = ConfigDict(extra="forbid", strict=True)


class _LossLine(_Loaded):
    samples: Count = 0
    losses: dict[str, Finite] = {}
    held_out: dict[str, Finite] = {}


class LossLog:
    """A file of lines ``{"samples": 2400, "losses": {...}}`` and ``{..., "held_out": {...}}``."""

    def __init__(self, path: Path, samples: int) -> None:
        """Drop the lines after ``samples``, which a resumed training writes again."""
        self.path = path
        kept = [line for line in read_history(path) if line["samples"] <= samples]
        with replacing(path) as temporary:
            temporary.write_text("".join(json.dumps(line) + "\n" for line in kept))

    def write(self, samples: int, **facts: Mapping[str, float]) -> None:
        """Append one line."""
        with self.path.open("a") as file:
            file.write(json.dumps({"samples": samples, **facts}) + "\n")


def read_history(path: Path) -> list[dict[str, Any]]:
    """Return the complete lines of the file, none if it does not exist."""
    if not path.is_file():
        return []
    content = read_limited(path, MOST_TEXT_BYTES)
    lines = content[: content.rfind(b"\n") + 1].split(b"\n")[:-1]  # the last may be incomplete
    try:
        parsed = [_LossLine.model_validate_json(line) for line in lines]
        return [{"samples": line.samples} | line.model_dump(exclude_unset=True) for line in parsed]
    except ValueError:
        raise SemvizError(f"{path}: not the losses of a training; move it away") from None


def add(window: Window, values: Mapping[str, float], weight: int = 1) -> None:
    """Add values to ``window``, each the mean of ``weight`` occurrences."""
    for name, value in values.items():
        if isfinite(value):
            total, number = window.get(name, (0.0, 0))
            window[name] = (total + value * weight, number + weight)


def means(window: Window) -> dict[str, float]:
    """Return the mean of each value, to six digits."""
    return {name: float(f"{total / number:.6g}") for name, (total, number) in window.items()}


FORMAT = 1
_KEY = "semviz training"


@dataclass
class TrainingProgress:
    """The course of a training so far."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")
    samples: Count = 0
    skipped: Count = 0
    """Number of steps not made because a loss or gradient was not finite."""
    plans: list[tuple[Count, Count]] = field(default_factory=list)
    """(sample, total): the planned total from that sample on; several if the plan changed."""
    seconds: dict[str, Finite] = field(default_factory=dict)
    """Wall time on each machine."""
    held_out: dict[str, Finite] = field(default_factory=dict)
    """The last validation figures."""
    window: Window = field(default_factory=dict)
    """Losses since the last line of the loss log."""

    @property
    def of(self) -> int:
        """Planned number of samples."""
        return self.plans[-1][1]


class _Identity(_Loaded):
    """What a file of weights is named by, and its card made from."""

    task: Annotated[str, Field(pattern=r"^[a-z0-9-]{1,100}$")]
    options: dict[str, Any]
    seed: Count
    batch: Annotated[int, Field(ge=1, le=2**31)]


_PROGRESS = TypeAdapter(TrainingProgress)


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """The state of a training."""

    identity: dict[str, Any]
    """Settings that must stay the same, as JSON: task, its options, seed, batch."""
    progress: TrainingProgress
    tensors: dict[str, Tensor]
    """``Learner.state()``."""

    def save(self, path: Path) -> None:
        """Replace ``path``. Raise SemvizError if that fails; the previous file then stays."""
        header = {"format": FORMAT, "identity": self.identity, "course": asdict(self.progress)}
        header["crc32"] = _checksum(header, self.tensors)
        content = safetensors.torch.save(self.tensors, metadata={_KEY: json.dumps(header)})
        with replacing(path) as temporary:
            temporary.write_bytes(content)

    @classmethod
    def load(cls, path: Path) -> "Checkpoint":
        """Raise SemvizError if the file is no checkpoint, or of another version of semviz."""
        check_file(path, MOST_TENSOR_BYTES)
        try:
            with safe_open(path, framework="pt") as file:
                header = parsed_json((file.metadata() or {})[_KEY])
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            if (form := header["format"]) == FORMAT:
                return cls._checked(header, tensors)
        except (OSError, SafetensorError, LookupError, TypeError, ValueError, RuntimeError):
            raise SemvizError(f"{path}: not a checkpoint of semviz, or damaged") from None
        raise SemvizError(
            f"{path}: a checkpoint of format {shown(form)}; this semviz has {FORMAT}: use the "
            "version that it was made with, or give another --out"
        )

    @classmethod
    def _checked(cls, header: dict[str, Any], tensors: dict[str, Tensor]) -> "Checkpoint":
        """Raise ValueError or LookupError if a value is not of its type, or not as written."""
        recorded = header.pop("crc32", None)  # earlier versions wrote none
        if recorded not in (None, _checksum(header, tensors)):
            raise ValueError("its checksum differs")
        identity = _Identity.model_validate_json(json.dumps(header["identity"]))
        progress = _PROGRESS.validate_json(json.dumps(header["course"]), strict=True)
        return cls(identity.model_dump(), progress, tensors)

    def check(self, identity: dict[str, Any], path: Path) -> None:
        """Raise SemvizError if the checkpoint belongs to another training."""
        differing = _differences("", self.identity, json.loads(json.dumps(identity)))
        if differing:
            more = f" and {len(differing) - 2} more" if len(differing) > 2 else ""
            raise SemvizError(
                f"{path}: of another training ({'; '.join(differing[:2])}{more}): "
                "give another --out"
            )


def _checksum(header: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> int:
    """Return the CRC-32 of the header, then of each tensor by its name."""
    checksum = zlib.crc32(json.dumps(header, sort_keys=True).encode())
    for name, tensor in sorted(tensors.items()):
        checksum = zlib.crc32(f"{name} {tensor.dtype} {list(tensor.shape)}\n".encode(), checksum)
        content = tensor.contiguous().reshape(-1).view(torch.uint8).numpy()
        checksum = zlib.crc32(content.data, checksum)
    return checksum


def _differences(name: str, was: Any, now: Any) -> list[str]:
    """Return ``batch was 12, is 24`` for each value that differs."""
    if isinstance(was, dict) and isinstance(now, dict):
        return [
            difference
            for key in {**was, **now}
            for difference in _differences(f"{name} {key}".strip(), was.get(key), now.get(key))
        ]
    return [] if was == now else [f"{shown(name)} was {shown(was)}, is {shown(now)}"]
