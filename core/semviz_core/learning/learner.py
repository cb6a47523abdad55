"""A network while it learns: one step downhill, and its state as tensors."""

from contextlib import nullcontext
from typing import Any, Literal

import torch
from torch import Tensor, nn

from semviz_core.learning.crew import Crew
from semviz_core.learning.task import Progress, Task

Precision = Literal["float32", "bf16"]
NETWORK = "network."
"""Begins the names of weights in a learner's state."""
LONGEST_GRADIENT = 10.0
"""Gradients are shortened to this norm: one odd batch must not undo what others taught."""
_MOMENTS = ("step", "exp_avg", "exp_avg_sq")
"""What Adam keeps of each parameter, by torch's names."""


class Learner:
    """The task's network with Adam (fused: one call for all parameters, not ten for each)."""

    def __init__(self, task: Task[Any, Any], crew: Crew, precision: Precision = "float32") -> None:
        self._task = task
        self._crew = crew
        self._precision = precision
        task.network.to(crew.device).train()
        self._losses = crew.share(_Losses(task))
        self._adam = torch.optim.Adam(task.network.parameters(), fused=True)

    def step(self, together: Any, progress: Progress) -> tuple[dict[str, float], bool]:
        """The losses before the step, and whether it was made: not if a number is not finite."""
        self._seed(progress.samples + self._crew.rank)
        self._adam.param_groups[0]["lr"] = self._task.learning_rate(progress)
        self._adam.zero_grad()
        with self._lower_precision():
            losses: dict[str, Tensor] = self._losses(self._here(together), progress)
        loss = losses["loss"]
        (loss / loss.isfinite()).backward()  # type: ignore[no-untyped-call]  # by 0: all gradients
        norm = nn.utils.clip_grad_norm_(self._task.network.parameters(), LONGEST_GRADIENT)
        done = bool(norm.isfinite())  # of the mean over all processes, so all agree
        if done:
            self._adam.step()
        return _numbers(losses | {"gradient": norm}), done

    def measure(self, together: Any) -> dict[str, float]:
        """Figures of held-out items."""
        self._task.network.eval()
        with torch.no_grad(), self._lower_precision():
            figures = _numbers(self._task.figures(self._here(together)))
        self._task.network.train()
        return figures

    def state(self) -> dict[str, Tensor]:
        """Weights under ``NETWORK``, Adam's moments under ``adam.``, on the CPU."""
        network = self._task.network
        state = {f"{NETWORK}{name}": value for name, value in network.state_dict().items()}
        for name, parameter in network.named_parameters():
            for moment, value in self._adam.state[parameter].items():
                state[f"adam.{moment}.{name}"] = value
        return {name: value.detach().cpu().contiguous() for name, value in state.items()}

    def restore(self, state: dict[str, Tensor]) -> None:
        """What ``state`` returned; KeyError or RuntimeError where it is another network's."""
        network = self._task.network
        network.load_state_dict({name: state[f"{NETWORK}{name}"] for name in network.state_dict()})
        moments = {
            number: {
                moment: _laid_out_as(parameter, state[f"adam.{moment}.{name}"])
                for moment in _MOMENTS
            }
            for number, (name, parameter) in enumerate(network.named_parameters())
            if f"adam.step.{name}" in state
        }
        groups = self._adam.state_dict()["param_groups"]
        self._adam.load_state_dict({"state": moments, "param_groups": groups})

    def _seed(self, number: int) -> None:
        """Of dropout, so that it is the same wherever we went on from."""
        torch.default_generator.manual_seed(number)  # torch.manual_seed takes long
        if self._crew.device.type == "cuda":
            torch.cuda.manual_seed(number)

    def _here(self, together: Any) -> Any:
        device = self._crew.device
        return together if device.type == "cpu" else together.to(device)

    def _lower_precision(self) -> Any:
        if self._precision == "float32":
            return nullcontext()
        return torch.autocast(self._crew.device.type, torch.bfloat16)


class _Losses(nn.Module):
    """The task as a module: what DDP wraps has to hold the parameters and make the loss."""

    def __init__(self, task: Task[Any, Any]) -> None:
        super().__init__()
        self.network = task.network
        self._task = task

    def forward(self, together: Any, progress: Progress) -> dict[str, Tensor]:
        return self._task.losses(together, progress)


def _laid_out_as(parameter: Tensor, moment: Tensor) -> Tensor:
    """In memory as the parameter is, such as channels last: fused Adam goes by that."""
    if moment.shape != parameter.shape:  # the number of steps
        return moment
    return torch.empty_like(parameter, requires_grad=False).copy_(moment)


def has_bf16(device: torch.device) -> bool:
    """Whether it computes faster with 16 bits: GPUs do, and processors with AMX."""
    return device.type != "cpu" or torch.cpu._is_amx_tile_supported()


def _numbers(values: dict[str, Tensor]) -> dict[str, float]:
    """As floats, with one wait for the device."""
    together = torch.stack([value.detach().double() for value in values.values()])
    return dict(zip(values, together.tolist(), strict=True))
