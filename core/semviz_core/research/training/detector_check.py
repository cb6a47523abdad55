"""Compare detectors on held-out images: what a training brought, and what it forgot.

Recall is taken at a fixed number of false positives an image, so that thresholds do not matter.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semviz_core.base.classes import ClassSet
from semviz_core.detection.network import HeatmapModel
from semviz_core.research.training.detector import threshold_sweep
from semviz_core.research.training.detector_images import LabelledImages

CHECK_IMAGES = 20
"""Number of held-out images of each source."""
CHECK_FALSE = 0.5
"""False positives per image at which recall is compared."""
MOST_LOSS = 0.05
"""A larger loss of recall is none of chance."""


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
