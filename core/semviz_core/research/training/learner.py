"""Run one optimizer step of a network, alone or with other processes.

Adam is fused: one call for all parameters. Under torchrun the processes average their gradients
(DDP). bfloat16 is used where it is faster: on GPUs, and on processors with AMX or AVX-512 BF16.
"""

import os
import sys
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, distributed, nn

from semviz_core.common.errors import SemvizError
from semviz_core.research.training.batch import Progress, TrainingTask


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
