"""Run a training from the command line: progress, plots, and the final weights with a card.

Tasks are created by name, only when needed, because torch loads slowly. Weights are written as
TASK.safetensors with the model card TASK.json. A training of the detector that forgot what its
initial weights found on streets is refused: recall on held-out images is compared at a fixed number
of false positives an image, so that thresholds do not matter.
"""

import hashlib
import json
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from math import isfinite
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from semviz.presentation.plots import add_grid, add_legend, line_style, new_figure, save_png
from semviz.presentation.terminal import Table
from semviz.workspace.outputs import PNG, check_outputs, contains, never, starts_with
from semviz_core.base.classes import ClassSet
from semviz_core.base.weights import NetworkWeights
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.detection.network import HeatmapModel, load_shipped_model
from semviz_core.research.point_matching.methods import POINT_MODELS
from semviz_core.research.training import simulated_samples
from semviz_core.research.training.checkpoint import NETWORK, Checkpoint
from semviz_core.research.training.detector import DetectorTask, threshold_sweep
from semviz_core.research.training.detector_images import LabelledImages
from semviz_core.research.training.trainer import CHECKPOINT

if TYPE_CHECKING:
    from semviz_core.research.training.batch import SampleSource, TrainingTask
    from semviz_core.research.training.checkpoint import Precision, TrainingProgress
    from semviz_core.research.training.trainer import TrainerEvent, TrainingOptions


CHECK_IMAGES = 20
"""Number of held-out images of each source."""
CHECK_FALSE = 0.5
"""False positives per image at which recall is compared."""
MOST_LOSS = 0.05
"""A larger loss of recall is not chance."""
KEPT_ASIDE = "forgot.safetensors"
"""The checkpoint of a refused training, in its folder."""
REPLAYED = "streets"


@dataclass(frozen=True)
class HeldOutRecall:
    """Recall of poles and of signs on held-out images; None if there are none."""

    pole: float | None
    sign: float | None

    @classmethod
    def of(cls, model: HeatmapModel, source: LabelledImages, classes: ClassSet) -> "HeldOutRecall":
        """Detect in the first held-out images of a source."""
        count = min(source.held_out_count, CHECK_IMAGES)
        sweep = threshold_sweep(model, (source.held_out(row) for row in range(count)), classes)
        false = np.sort(sweep.score[~sweep.is_right])[::-1]
        allowed = int(CHECK_FALSE * count)
        above = sweep.score > false[allowed] if len(false) > allowed else sweep.score >= 0.0
        lines = {class_.id for class_ in classes if class_.kind == "line"}
        is_line = np.isin(sweep.class_id, list(lines))
        recall = []
        for rows, ids in ((is_line, lines), (~is_line, set(sweep.there) - lines)):
            there = sum(sweep.there.get(id_, 0) for id_ in ids)
            found = int((rows & above & sweep.is_right).sum())
            recall.append(found / there if there else None)
        return cls(*recall)

    def losses(self, after: "HeldOutRecall") -> Sequence[str]:
        """Return what was lost by more than ``MOST_LOSS``: ``poles fell from 92 to 5 %``."""
        pairs = {"poles": (self.pole, after.pole), "signs": (self.sign, after.sign)}
        return [
            f"{name} fell from {100.0 * old:.0f} to {100.0 * new:.0f} %"
            for name, (old, new) in pairs.items()
            if old is not None and new is not None and new < old - MOST_LOSS
        ]


@dataclass(frozen=True)
class ForgettingCheck:
    """Compares a finished training with the weights that it began with."""

    folder: Path
    start: Path
    sources: Mapping[str, LabelledImages]
    """Sources of held-out images by name; ``REPLAYED`` are those that must not be forgotten."""
    allow_loss: bool

    def resume(self) -> None:
        """Take a refused training back, or refuse to begin a new one over it."""
        aside = self.folder / KEPT_ASIDE
        if not aside.exists():
            return
        if not self.allow_loss:
            raise SemvizError(
                f"{aside}: a training that forgot; accept it with --allow-loss, or name another "
                "--out"
            )
        aside.replace(self.folder / CHECKPOINT)

    def run(self, task: DetectorTask) -> None:
        """Print recall before and after.

        Raise SemvizError, and keep the weights aside, if streets lost some and that is not allowed.
        """
        before = load_shipped_model(self.start, task.classes)
        recalls = {
            name: (
                HeldOutRecall.of(before, source, task.classes),
                HeldOutRecall.of(task.model, source, task.classes),
            )
            for name, source in self.sources.items()
        }
        print(_table(recalls).as_text())
        old, new = recalls[REPLAYED]
        losses = old.losses(new)
        if losses and not self.allow_loss:
            (self.folder / CHECKPOINT).replace(self.folder / KEPT_ASIDE)
            raise SemvizError(
                f"on held-out streets {' and '.join(losses)}; the weights are kept aside in "
                f"{self.folder / KEPT_ASIDE}: train with more --streets, or give --allow-loss"
            )


def _table(recalls: Mapping[str, tuple[HeldOutRecall, HeldOutRecall]]) -> Table:
    rows = tuple(
        (name, *(_percent(value) for part in ("pole", "sign") for value in
                 (getattr(old, part), getattr(new, part))))
        for name, (old, new) in recalls.items()
    )  # fmt: skip
    title = f"Held-out recall at {CHECK_FALSE:g} false an image"
    header = ("", "poles before", "after", "signs before", "after")
    return Table(title, header, rows, words=1)


def _percent(recall: float | None) -> str:
    return "-" if recall is None else f"{100.0 * recall:.0f} %"


INTERRUPTED = 130
PLOT = "losses.png"
EVERY_S = 0.5
"""Interval at which the progress bar is redrawn; steps take milliseconds."""
SMOOTH = 0.02
"""Weight of a step in the displayed loss."""


class TrainArguments(Protocol):
    """The arguments of every training command; ``out`` is the training's folder."""

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


class TrainingBar:
    """Shows the progress of a training; use in a ``with`` statement.

    On a terminal it is a bar with loss and speed. Validation figures are printed as lines anywhere.
    """

    def __init__(self, name: str, progress: "TrainingProgress") -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        console = Console(stderr=True)
        columns = TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn()
        self._bar = Progress(
            *columns, console=console, disable=not console.is_terminal, refresh_per_second=1
        )
        self._task = self._bar.add_task(name, total=progress.of, completed=progress.samples)
        self._what, self._first, self._loss = name, progress.samples, float("nan")
        self._start_s = self._shown_s = perf_counter()

    def __enter__(self) -> "TrainingBar":
        self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()

    def show(self, event: "TrainerEvent") -> None:
        """Show the state after a step."""
        if isfinite(event.loss):
            before = self._loss if isfinite(self._loss) else event.loss
            self._loss = before + SMOOTH * (event.loss - before)
        now = perf_counter()
        if now - self._shown_s > EVERY_S:
            self._shown_s = now
            self._bar.update(self._task, completed=event.samples, description=self._told(event))
        if event.held_out:
            figures = "  ".join(f"{name} {value:.4g}" for name, value in event.held_out.items())
            print(f"{self._told(event)}  held out: {figures}", file=sys.stderr)

    def _told(self, event: "TrainerEvent") -> str:
        speed = (event.samples - self._first) / (perf_counter() - self._start_s)
        seen = f"{self._what} {event.samples}/{event.of}"
        return f"{seen}  loss {self._loss:.4g}  {speed:.0f} a second"


def check_training_folder(folder: Path, force: bool, reads: Iterable[Path]) -> None:
    """Raise SemvizError if a file in ``folder`` would be overwritten that is of no training."""
    from semviz_core.research.training.trainer import HISTORY, LOCK

    files = {
        CHECKPOINT: contains(b'"semviz training"'),
        HISTORY: starts_with(b'{"samples": '),
        PLOT: PNG,
    }
    for name, is_ours in files.items():
        check_outputs(folder / name, is_ours, force=force, reads=reads)
    check_outputs(folder / LOCK, never, can_force=False, reads=reads)


def train(
    task: "TrainingTask[Any, Any]",
    arguments: TrainArguments,
    held_out: int,
    next_commands: Sequence[str],
    check: Callable[[], None] | None = None,
) -> int:
    """Train until finished or stopped, with ``held_out`` validation items; return the exit status.

    ``next_commands`` are printed after a finished training, which ``check`` may refuse before.
    """
    from semviz_core.research.training.trainer import Trainer

    folder = arguments.out
    training = Trainer(task, folder, _options(arguments, held_out))
    if training.process_group.leads:
        with TrainingBar(task.name, training.progress) as bar:
            ending = training.run(lambda event: _tell(event, bar, task.name, folder))
        if ending == "finished" and check is not None:
            check()
        print(_told(folder, training.progress, ending, next_commands))
    else:
        ending = training.run()
    status = INTERRUPTED if ending == "interrupted" else 0
    training.process_group.leave(status)
    return status


def training_summary(folder: Path) -> dict[str, object]:
    """Return a training's folder and its last losses, for scripts."""
    from semviz_core.research.training.checkpoint import read_history
    from semviz_core.research.training.trainer import HISTORY

    history = read_history(folder / HISTORY)
    return {"path": str(folder), "last": history[-1] if history else None}


def _options(arguments: TrainArguments, held_out: int) -> "TrainingOptions":
    from semviz_core.research.training.trainer import TrainingOptions

    return TrainingOptions(
        samples=arguments.samples,
        batch=arguments.batch,
        seed=arguments.seed,
        workers=arguments.workers,
        precision=arguments.precision,
        held_out=held_out,
        stop_after_s=float("inf") if arguments.stop_after_s is None else arguments.stop_after_s,
    )


def _tell(event: "TrainerEvent", bar: TrainingBar, name: str, folder: Path) -> None:
    """Update the bar, and the plot after each validation."""
    from semviz_core.research.training.checkpoint import read_history
    from semviz_core.research.training.trainer import HISTORY

    bar.show(event)
    if event.held_out:
        draw_training_plot(read_history(folder / HISTORY), name, folder / PLOT)


def _told(
    folder: Path, progress: "TrainingProgress", ending: str, next_commands: Sequence[str]
) -> str:
    figures = ", ".join(f"{name} {value:.3g}" for name, value in progress.held_out.items())
    lines = [
        f"{folder}: {ending} after {progress.samples} of {progress.of} samples, "
        f"{sum(progress.seconds.values()):.0f} s in all",
        *([f"held out: {figures}"] if figures else []),
        "next: " + "; ".join(next_commands)
        if ending == "finished"
        else "next: the same command goes on",
    ]
    return "\n".join(lines)


COLUMNS = 3
KINDS = {"losses": "training, mean of 200 steps", "held_out": "held out"}
NO_FIGURES = ("items",)


def draw_training_plot(history: Sequence[dict[str, Any]], title: str, path: Path) -> None:
    """Draw a small plot for each loss and figure over the samples; none if there are none.

    Raise SemvizError if matplotlib is not installed or ``path`` cannot be written.
    """
    recorded = (name for kind in KINDS for line in history for name in line.get(kind, {}))
    names = [name for name in dict.fromkeys(recorded) if name not in NO_FIGURES]
    if not names:
        return
    from matplotlib.ticker import EngFormatter, MaxNLocator

    columns = min(COLUMNS, len(names))
    rows = -(-len(names) // columns)
    figure = new_figure(3.6 * columns + 0.4, 2.5 * rows + 0.7, title)
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
    for axis, name in zip(axes, names, strict=False):
        for number, (kind, label) in enumerate(KINDS.items()):
            lines = [line for line in history if name in line.get(kind, {})]
            samples = [line["samples"] for line in lines]
            values = [line[kind][name] for line in lines]
            axis.plot(samples, values, label=label, marker=".", **line_style(number))
        axis.set_title(name, fontsize="medium")
        axis.xaxis.set_major_locator(MaxNLocator(5))
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        add_grid(axis)
    for axis in axes[max(len(names) - columns, 0) : len(names)]:
        axis.set_xlabel("samples")
        axis.tick_params(labelbottom=True)
    for axis in axes[len(names) :]:
        axis.remove()
    add_legend(figure)
    save_png(figure, path, dpi=110)


TASKS: dict[str, tuple[str, simulated_samples.SimulatedSamples | None]] = {
    "paper": ("paper.training", simulated_samples.PAPER_DISTRIBUTION),
    "paper-no-semantics": ("paper.training", simulated_samples.PAPER_DISTRIBUTION),
    "bpnpnet": ("paper.training", simulated_samples.PAPER_DISTRIBUTION),
    "bpnpnet-semantic": ("paper.training", simulated_samples.PAPER_DISTRIBUTION),
    **dict.fromkeys(
        POINT_MODELS, ("point_matching.training", simulated_samples.PAPER_20M_DISTRIBUTION)
    ),
    "deepi2p-pixels": ("point_matching.pixel_training", None),
    "matcher": ("pair_matcher.training", simulated_samples.LEARNED_DISTRIBUTION),
    "verifier": ("training.verifier", simulated_samples.HARD_DISTRIBUTION),
}
"""Name -> module of ``semviz_core.research`` with ``make_task(name, source)``, default samples;
None if it trains on samples of its own alone."""

SUITES = {"paper-20m": simulated_samples.PAPER_20M_DISTRIBUTION}
"""Suites of the benchmark with samples of their own."""


def training_samples(name: str, suite: str | None) -> simulated_samples.SimulatedSamples | None:
    """Return a task's samples of ``suite``, or its default ones; None if it has its own alone.

    Raise SemvizError for an unknown name.
    """
    if name not in TASKS:
        raise SemvizError(f"nothing called {name} can be trained; there are {', '.join(TASKS)}")
    samples = TASKS[name][1]
    return samples if samples is None or suite is None else SUITES[suite]


def make_training_task(
    name: str, source: "SampleSource | None" = None, seed: int = 0
) -> "TrainingTask[Any, Any]":
    """Return a task with new weights, drawn from ``seed`` (default source: its own samples).

    Raise SemvizError for an unknown name.
    """
    samples = training_samples(name, None)
    import torch

    torch.manual_seed(seed)
    module = import_module(f"semviz_core.research.{TASKS[name][0]}")
    task: TrainingTask[Any, Any] = module.make_task(name, source or samples)
    return task


FORMAT = 1


def write_weights(training: Path, folder: Path, *, force: bool = False) -> Path:
    """Write the last checkpoint's weights to ``folder``/TASK.safetensors, with a card TASK.json.

    Raise SemvizError if ``training`` holds no checkpoint, or the files cannot be written; also if
    they exist and are of another kind, unless ``force``.
    """
    if not (training / CHECKPOINT).is_file():
        raise SemvizError(f"{training}: no training; 'semviz train' makes one with --out")
    checkpoint = Checkpoint.load(training / CHECKPOINT)
    identity = checkpoint.identity
    path = folder / f"{identity['task']}.safetensors"
    check_outputs(path, contains(b'"semviz weights"'), force=force, reads=[training])
    is_card = starts_with(b'{\n  "format": 1,\n  "semviz": "')
    check_outputs(path.with_suffix(".json"), is_card, force=force, reads=[training])
    tensors = {
        name.removeprefix(NETWORK): value.float().numpy()
        for name, value in checkpoint.tensors.items()
        if name.startswith(NETWORK) and value.is_floating_point()  # batch counters are no weights
    }
    NetworkWeights(identity["task"], identity["options"], tensors).save(path)
    card = {
        **_model_card(checkpoint),
        "parameters": sum(value.size for value in tensors.values()),
        "bytes": path.stat().st_size,
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
    }
    with replacing(path.with_suffix(".json")) as temporary:
        temporary.write_text(json.dumps(card, indent=2, ensure_ascii=False) + "\n")
    return path


def _model_card(checkpoint: Checkpoint) -> dict[str, Any]:
    """Return the model card of a checkpoint: its training, data and validation figures."""
    identity, progress = checkpoint.identity, checkpoint.progress
    return {
        "format": FORMAT,
        "semviz": version("semviz"),
        "task": identity["task"],
        "options": identity["options"],
        "seed": identity["seed"],
        "batch": identity["batch"],
        "samples": progress.samples,
        "planned_samples": [list(plan) for plan in progress.plans],
        "steps": progress.samples // identity["batch"],
        "skipped_steps": progress.skipped,
        "wall_s": round(sum(progress.seconds.values()), 1),
        "machines": {name: round(seconds, 1) for name, seconds in progress.seconds.items()},
        "held_out": progress.held_out,
    }
