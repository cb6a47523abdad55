"""Run the steps of a training, store its state in one file, and its losses as lines of JSON.

The file is complete at any moment, and the training resumes from it exactly. A loss line is a
mean over some hundred steps. Both may come from others: what they hold is checked when read.

Adam is fused: one call for all parameters. Under torchrun the processes average their gradients
(DDP). bfloat16 is used where it is faster: on GPUs, and on processors with AMX or AVX-512 BF16.
"""

import json
import os
import sys
import zlib
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import safetensors.torch
import torch
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter
from safetensors import SafetensorError, safe_open
from torch import Tensor, distributed, nn

from semviz_core.common import limits
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.research.training.batch import Progress, TrainingTask

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
    content = limits.read_limited(path, limits.MOST_TEXT_BYTES)
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
        limits.check_file(path, limits.MOST_TENSOR_BYTES)
        try:
            with safe_open(path, framework="pt") as file:
                header = limits.parsed_json((file.metadata() or {})[_KEY])
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            if (form := header["format"]) == FORMAT:
                return cls._checked(header, tensors)
        except (OSError, SafetensorError, LookupError, TypeError, ValueError, RuntimeError):
            raise SemvizError(f"{path}: not a checkpoint of semviz, or damaged") from None
        raise SemvizError(
            f"{path}: a checkpoint of format {limits.shown(form)}; this semviz has {FORMAT}: use "
            "the version that it was made with, or give another --out"
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
    return (
        []
        if was == now
        else [f"{limits.shown(name)} was {limits.shown(was)}, is {limits.shown(now)}"]
    )


@dataclass(frozen=True)
class ProcessGroup:
    """This process among those that train together."""

    rank: int
    world: int
    device: torch.device

    @property
    def leads(self) -> bool:
        """Whether this process writes files and prints."""
        return self.rank == 0

    def share(self, module: nn.Module) -> nn.Module:
        """Return ``module`` with gradients averaged over all processes."""
        if self.world == 1:
            return module
        return nn.parallel.DistributedDataParallel(module)

    def any(self, condition: bool) -> bool:
        """Return whether ``condition`` is True in any process; all must call at the same step."""
        if self.world == 1:
            return condition
        number = torch.tensor(float(condition), device=self.device)
        distributed.all_reduce(number, op=distributed.ReduceOp.MAX)
        return bool(number)

    def leave(self, status: int = 0) -> None:
        """Wait for the other processes, if any, and exit: gloo's threads occasionally abort while
        Python shuts down."""
        if self.world > 1:
            distributed.barrier()
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)


def init_process_group() -> ProcessGroup:
    """Join the other processes if torchrun's variables name any.

    GPUs, one for each process, communicate by NCCL, CPUs by gloo.
    """
    world = _number("WORLD_SIZE", 1)
    device = torch.device("cpu")
    if torch.cuda.is_available():
        device = torch.device("cuda", _number("LOCAL_RANK", 0))
        torch.cuda.set_device(device)
    if world > 1 and not distributed.is_initialized():
        distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    return ProcessGroup(_number("RANK", 0) if world > 1 else 0, world, device)


def _number(variable: str, otherwise: int) -> int:
    try:
        return int(os.environ.get(variable, otherwise))
    except ValueError:
        raise SemvizError(f"{variable} is no number; torchrun sets it") from None


Precision = Literal["float32", "bf16"]
NETWORK = "network."
"""Prefix of the names of weights in a learner's state."""
LONGEST_GRADIENT = 10.0
"""Gradients are clipped to this norm, so that a single batch cannot do much harm."""


class Learner:
    """The task's network with Adam."""

    def __init__(
        self,
        task: TrainingTask[Any, Any],
        process_group: ProcessGroup,
        precision: Precision = "float32",
    ) -> None:
        self._task = task
        self._process_group = process_group
        self._precision = precision
        task.network.to(process_group.device).train()
        self._losses = process_group.share(_Losses(task))
        self._adam = torch.optim.Adam(task.network.parameters(), fused=True)

    def step(self, batch: Any, progress: Progress) -> tuple[dict[str, float], bool]:
        """Return the losses before the step, and whether it was made: not if one is not finite."""
        self._seed(progress.samples + self._process_group.rank)
        self._adam.param_groups[0]["lr"] = self._task.learning_rate(progress)
        self._adam.zero_grad()
        with self._lower_precision():
            losses: dict[str, Tensor] = self._losses(self._on_device(batch), progress)
        loss = losses["loss"]
        (loss / loss.isfinite()).backward()  # type: ignore[no-untyped-call]  # by 0: all gradients
        norm = nn.utils.clip_grad_norm_(self._task.network.parameters(), LONGEST_GRADIENT)
        done = bool(norm.isfinite())  # of the mean over all processes, so all agree
        if done:
            self._adam.step()
        return _numbers(losses | {"gradient": norm}), done

    def measure(self, batch: Any) -> dict[str, float]:
        """Return the figures of a validation batch."""
        self._task.network.eval()
        with torch.no_grad(), self._lower_precision():
            figures = _numbers(self._task.figures(self._on_device(batch)))
        self._task.network.train()
        return figures

    def state(self) -> dict[str, Tensor]:
        """Return the weights under ``NETWORK`` and Adam's moments under ``adam.``, on the CPU."""
        network = self._task.network
        state = {f"{NETWORK}{name}": value for name, value in network.state_dict().items()}
        for name, parameter in network.named_parameters():
            for moment, value in self._adam.state[parameter].items():
                state[f"adam.{moment}.{name}"] = value
        return {name: value.detach().cpu().contiguous() for name, value in state.items()}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Restore what ``state`` returned. Raise KeyError or RuntimeError for another network."""
        network = self._task.network
        network.load_state_dict({name: state[f"{NETWORK}{name}"] for name in network.state_dict()})
        moments = {
            number: {
                "step": state[f"adam.step.{name}"].reshape(()).float(),
                "exp_avg": _laid_out_as(parameter, state[f"adam.exp_avg.{name}"]),
                "exp_avg_sq": _laid_out_as(parameter, state[f"adam.exp_avg_sq.{name}"]),
            }
            for number, (name, parameter) in enumerate(network.named_parameters())
            if f"adam.step.{name}" in state
        }
        groups = self._adam.state_dict()["param_groups"]
        self._adam.load_state_dict({"state": moments, "param_groups": groups})

    def _seed(self, number: int) -> None:
        """Seed dropout, so that it does not depend on where the training resumed."""
        torch.default_generator.manual_seed(number)  # torch.manual_seed takes long
        if self._process_group.device.type == "cuda":
            torch.cuda.manual_seed(number)

    def _on_device(self, batch: Any) -> Any:
        device = self._process_group.device
        return batch if device.type == "cpu" else batch.to(device)

    def _lower_precision(self) -> Any:
        if self._precision == "float32":
            return nullcontext()
        return torch.autocast(self._process_group.device.type, torch.bfloat16)


class _Losses(nn.Module):
    """The task as a module: DDP wraps a module that holds the parameters and computes the loss."""

    def __init__(self, task: TrainingTask[Any, Any]) -> None:
        super().__init__()
        self.network = task.network
        self._task = task

    def forward(self, batch: Any, progress: Progress) -> dict[str, Tensor]:
        return self._task.losses(batch, progress)


def _laid_out_as(parameter: Tensor, moment: Tensor) -> Tensor:
    """Return ``moment`` with the parameter's memory format (such as channels last), which fused
    Adam requires."""
    return torch.empty_like(parameter, requires_grad=False).copy_(moment)


def has_bf16(device: torch.device) -> bool:
    """Return whether the device has instructions for bfloat16, which make training faster."""
    supported = torch.cpu._is_amx_tile_supported() or torch.cpu._is_avx512_bf16_supported()
    return device.type != "cpu" or supported


def _numbers(values: dict[str, Tensor]) -> dict[str, float]:
    """Return the values as floats, synchronizing with the device once."""
    batch = torch.stack([value.detach().double() for value in values.values()])
    return dict(zip(values, batch.tolist(), strict=True))
