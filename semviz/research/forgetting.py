"""Refuse a training of the detector that forgot what its initial weights found on streets."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from semviz.presentation.tables import Table
from semviz_core.common.errors import SemvizError
from semviz_core.detection.network import load_shipped_model
from semviz_core.research.training.detector import DetectorTask
from semviz_core.research.training.detector_check import CHECK_FALSE, HeldOutRecall
from semviz_core.research.training.detector_images import LabelledImages
from semviz_core.research.training.trainer import CHECKPOINT

KEPT_ASIDE = "forgot.safetensors"
"""The checkpoint of a refused training, in its folder."""
REPLAYED = "streets"


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
