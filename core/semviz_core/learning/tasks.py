"""What can be trained, by name; made only when asked for, because torch loads slowly."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from semviz_core.errors import SemvizError

if TYPE_CHECKING:
    from semviz_core.learning.task import SampleSource, Task

TASKS = {
    "paper": "models",
    "paper-no-semantics": "models",
    "bpnpnet": "models",
    "bpnpnet-semantic": "models",
    "matcher": "matcher_task",
    "verifier": "verifier_task",
}
"""Name -> module of ``semviz_core.learning`` with ``make_task(name, source)``."""


def make_task(name: str, source: "SampleSource | None" = None, seed: int = 0) -> "Task[Any, Any]":
    """A task with fresh weights, drawn from ``seed``; the samples are the task's own if none.

    Raises SemvizError where nothing of that name can be trained.
    """
    if name not in TASKS:
        raise SemvizError(f"nothing called {name} can be trained; there are {', '.join(TASKS)}")
    import torch

    torch.manual_seed(seed)
    module = import_module(f"semviz_core.learning.{TASKS[name]}")
    task: Task[Any, Any] = module.make_task(name, source)
    return task
