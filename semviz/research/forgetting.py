"""Refuse a training of the detector that forgot what its initial weights found on streets.

Recall on held-out images is compared at a fixed number of false positives an image, so that
thresholds do not matter.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semviz.presentation.tables import Table
from semviz_core.base.classes import ClassSet
from semviz_core.common.errors import SemvizError
from semviz_core.detection.network import HeatmapModel, load_shipped_model
from semviz_core.research.training.detector import DetectorTask, threshold_sweep
from semviz_core.research.training.detector_images import LabelledImages
from semviz_core.research.training.trainer import CHECKPOINT

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
