"""What can be trained, by name; made only when asked for, because torch loads slowly."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from semviz_core.errors import SemvizError
from semviz_core.learning.drills import LEARNED_DRILLS, PAPER_DRILLS, PUZZLES, Drills

if TYPE_CHECKING:
    from semviz_core.learning.task import SampleSource, Task

TASKS = {
    "paper": ("paper_task", PAPER_DRILLS),
    "paper-no-semantics": ("paper_task", PAPER_DRILLS),
    "bpnpnet": ("paper_task", PAPER_DRILLS),
    "bpnpnet-semantic": ("paper_task", PAPER_DRILLS),
    "matcher": ("matcher_task", LEARNED_DRILLS),
    "verifier": ("verifier_task", PUZZLES),
}
"""Name -> module of ``semviz_core.learning`` with ``make_task(name, source)``, and what it trains
on unless people say otherwise."""


def own_drills(name: str) -> Drills:
    """What a task trains on. Raises SemvizError where nothing of that name can be trained."""
    if name not in TASKS:
        raise SemvizError(f"nothing called {name} can be trained; there are {', '.join(TASKS)}")
    return TASKS[name][1]


def make_task(name: str, source: "SampleSource | None" = None, seed: int = 0) -> "Task[Any, Any]":
    """A task with fresh weights, drawn from ``seed``; on its own drills if no source is given.

    Raises SemvizError where nothing of that name can be trained.
    """
    drills = own_drills(name)
    import torch

    torch.manual_seed(seed)
    module = import_module(f"semviz_core.learning.{TASKS[name][0]}")
    task: Task[Any, Any] = module.make_task(name, source or drills)
    return task
