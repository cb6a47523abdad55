"""The processes that train together: one alone, or those that torchrun started."""

import os
import sys
from dataclasses import dataclass

import torch
from torch import distributed, nn

from semviz_core.errors import SemvizError


@dataclass(frozen=True)
class Crew:
    """This process among them."""

    rank: int
    world: int
    device: torch.device

    @property
    def leads(self) -> bool:
        """Whether it is the one that writes files and talks to people."""
        return self.rank == 0

    def share(self, module: nn.Module) -> nn.Module:
        """``module`` with gradients that are the mean over all processes."""
        if self.world == 1:
            return module
        return nn.parallel.DistributedDataParallel(module)

    def any(self, mine: bool) -> bool:
        """Whether it is true of one of the processes; all ask at the same step."""
        if self.world == 1:
            return mine
        number = torch.tensor(float(mine), device=self.device)
        distributed.all_reduce(number, op=distributed.ReduceOp.MAX)
        return bool(number)

    def leave(self, status: int = 0) -> None:
        """Wait for the others and end the process, if there are others: gloo's threads now and
        then abort while Python tears them down."""
        if self.world > 1:
            distributed.barrier()
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)


def join() -> Crew:
    """Meet the other processes, where torchrun's variables say that there are some.

    NCCL between GPUs, one for each process; gloo between CPUs.
    """
    world = _number("WORLD_SIZE", 1)
    device = torch.device("cpu")
    if torch.cuda.is_available():
        device = torch.device("cuda", _number("LOCAL_RANK", 0))
        torch.cuda.set_device(device)
    if world > 1 and not distributed.is_initialized():
        distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    return Crew(_number("RANK", 0) if world > 1 else 0, world, device)


def _number(variable: str, otherwise: int) -> int:
    try:
        return int(os.environ.get(variable, otherwise))
    except ValueError:
        raise SemvizError(f"{variable} is no number; torchrun sets it") from None
