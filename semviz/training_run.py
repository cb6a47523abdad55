"""A training as people see it: bar, plot, and what to do next."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from semviz.progress import TrainingBar
    from semviz_core.learning.checkpoint import Course
    from semviz_core.learning.learner import Precision
    from semviz_core.learning.task import Task
    from semviz_core.learning.training import Moment, TrainingOptions

INTERRUPTED = 130
PLOT = "losses.png"


class Asked(Protocol):
    """What every command that trains is told; its ``out`` is the training's folder."""

    @property
    def out(self) -> Path: ...
    @property
    def samples(self) -> int | None: ...
    @property
    def batch(self) -> int: ...
    @property
    def seed(self) -> int: ...
    @property
    def workers(self) -> int: ...
    @property
    def precision(self) -> "Precision": ...
    @property
    def stop_after_s(self) -> float | None: ...


def train(task: "Task[Any, Any]", asked: Asked, held_out: int, then: Sequence[str]) -> int:
    """Train until it is done or stopped, measured on ``held_out`` items; the exit status. ``then``
    is what finished weights are for, as commands."""
    from semviz.progress import TrainingBar
    from semviz_core.learning.training import Training

    folder = asked.out
    training = Training(task, folder, _options(asked, held_out))
    if training.crew.leads:
        with TrainingBar(task.name, training.course) as bar:
            ending = training.run(lambda moment: _tell(moment, bar, task.name, folder))
        print(_told(folder, training.course, ending, then))
    else:
        ending = training.run()
    status = INTERRUPTED if ending == "interrupted" else 0
    training.crew.leave(status)
    return status


def _options(asked: Asked, held_out: int) -> "TrainingOptions":
    from semviz_core.learning.training import TrainingOptions

    return TrainingOptions(
        samples=asked.samples,
        batch=asked.batch,
        seed=asked.seed,
        workers=asked.workers,
        precision=asked.precision,
        held_out=held_out,
        stop_after_s=float("inf") if asked.stop_after_s is None else asked.stop_after_s,
    )


def _tell(moment: "Moment", bar: "TrainingBar", name: str, folder: Path) -> None:
    """The bar, and the plot whenever there is something new to see in it."""
    from semviz.training_plot import draw
    from semviz_core.learning.history import read_history
    from semviz_core.learning.training import HISTORY

    bar.show(moment)
    if moment.held_out:
        draw(read_history(folder / HISTORY), name, folder / PLOT)


def _told(folder: Path, course: "Course", ending: str, then: Sequence[str]) -> str:
    figures = ", ".join(f"{name} {value:.3g}" for name, value in course.held_out.items())
    lines = [
        f"{folder}: {ending} after {course.samples} of {course.of} samples, "
        f"{sum(course.seconds.values()):.0f} s in all",
        *([f"held out: {figures}"] if figures else []),
        "next: " + "; ".join(then) if ending == "finished" else "next: the same command goes on",
    ]
    return "\n".join(lines)
