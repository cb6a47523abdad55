"""Train the detector's network on crops of labelled images, and choose its thresholds.

The heat uses CenterNet's focal loss (Zhou et al. 2019, eq. 1). Thresholds are chosen per class
on tuning images: the highest recall, summed over classes, at a fixed number of false positives
an image.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, smooth_l1_loss

from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.base.elements import Elements2D
from semviz_core.base.weights import read_weights
from semviz_core.common.arrays import BoolArray, ByteImage, FloatArray, IntArray
from semviz_core.detection.detector import Detector
from semviz_core.detection.heatmaps import Channels
from semviz_core.detection.network import (
    EQUALIZED,
    STANDARD,
    TASK,
    DetectorNet,
    HeatmapModel,
    NetworkSize,
    equalized,
    masks_of,
    size_of,
)
from semviz_core.metrics.detection import FALSE_POSITIVE, ImageGroundTruth, match_detections
from semviz_core.research.training.batch import Progress, cosine
from semviz_core.research.training.detector_crops import (
    Targets,
    middle_crop,
    random_crop,
    view_elsewhere,
)
from semviz_core.research.training.detector_images import Crop, LabelledImage, LabelledImages

FALSE_AN_IMAGE = 2.0
"""False positives of all classes per tuning image, in surroundings as hard as real ones. The rate
favours recall: rejecting a proposal takes one key, drawing a missed element several, and mapping
and localization expect false positives."""
LOWEST = 0.05
"""Detections with less heat are ignored."""
PRICES: FloatArray = np.geomspace(0.02, 50.0, 60)
"""Prices, in recall, of a false positive per image; the lowest that keeps the limit is used."""


@dataclass(frozen=True, eq=False)
class ThresholdSweep:
    """The detections of all images, with labels."""

    images: int
    class_id: IntArray
    """(k,)"""
    score: FloatArray
    """(k,)"""
    is_right: BoolArray
    """(k,)"""
    there: dict[int, int]
    """Number of elements by class."""


def chosen_thresholds(
    model: HeatmapModel, images: Iterable[LabelledImage], classes: ClassSet
) -> FloatArray:
    """Return the thresholds (classes,) with the highest total recall at ``FALSE_AN_IMAGE``."""
    sweep = threshold_sweep(model, images, classes)
    for price in PRICES:
        chosen = [_best(sweep, class_.id, float(price)) for class_ in classes]
        if sum(false for _, false in chosen) <= FALSE_AN_IMAGE:
            break
    return np.array([threshold for threshold, _ in chosen])


def _best(sweep: ThresholdSweep, class_id: int, price: float) -> tuple[float, float]:
    """Return the threshold of a class with the highest recall minus price of false positives, and
    their number per image."""
    rows = np.flatnonzero(sweep.class_id == class_id)
    rows = rows[np.argsort(-sweep.score[rows], kind="stable")]
    recall = np.cumsum(sweep.is_right[rows]) / max(sweep.there.get(class_id, 0), 1)
    false = np.cumsum(~sweep.is_right[rows]) / max(sweep.images, 1)
    value = np.concatenate([[0.0], recall - price * false])
    best = int(np.argmax(value))
    if best == 0:
        return 1.0, 0.0
    beyond = sweep.score[rows[best]] if best < len(rows) else LOWEST
    threshold = 0.5 * (sweep.score[rows[best - 1]] + beyond)  # however weights are rounded
    return float(threshold), float(false[best - 1])


def threshold_sweep(
    model: HeatmapModel, images: Iterable[LabelledImage], classes: ClassSet
) -> ThresholdSweep:
    """Return the detections in ``images``, however low their scores."""
    detector = Detector(replace(model, threshold=np.full(len(classes), LOWEST)))
    class_id, score, is_right = [], [], []
    element_count: dict[int, int] = {}
    count = 0
    for labelled in images:
        count += 1
        seen = detector.detect(labelled.image)
        rows = match_detections(seen, ImageGroundTruth.of(labelled.elements))
        counted = (rows >= 0) | ((rows == FALSE_POSITIVE) & ~_in_doubt(seen, labelled))
        class_id.append(seen.class_id[counted])
        score.append(seen.score[counted])
        is_right.append(rows[counted] >= 0)
        for id in labelled.elements.class_id.tolist():
            element_count[id] = element_count.get(id, 0) + 1
    return ThresholdSweep(
        count,
        np.concatenate(class_id),
        np.concatenate(score),
        np.concatenate(is_right),
        element_count,
    )


def _in_doubt(seen: Elements2D, labelled: LabelledImage) -> BoolArray:
    """Return (k,) whether the middle of each detection is ignored in the labels."""
    if labelled.ignored is None:
        return np.zeros(len(seen), bool)
    middle = np.where(seen.is_line[:, None], (seen.anchor_px + seen.end_px) / 2.0, seen.anchor_px)
    height, width = labelled.ignored.shape
    column, row = np.round(middle).astype(int).T
    in_doubt = np.zeros(len(seen), bool)
    for x, y in ((0, 0), (-2, 0), (2, 0), (0, -2), (0, 2)):  # a pixel beside a thin pole counts too
        at = np.clip(row + y, 0, height - 1), np.clip(column + x, 0, width - 1)
        in_doubt |= labelled.ignored[at]
    return in_doubt


RATE = 2e-3
DETECTOR_SAMPLES = 48_000
TUNING_IMAGES = 200
SURELY = 0.999
"""Least heat of a cell that holds an element's middle."""
EVENLY = 0.1
"""Errors of codes above this count linearly, smaller ones by their square."""
WEIGHTS = {
    "heat": 1.0, "middle": 1.0, "size": 0.5, "ends": 1.0, "width": 0.3,
    "known": 0.3, "pixels": 2.0, "mask": 0.5,
}  # fmt: skip
"""Weights of the parts of the loss."""


@dataclass(frozen=True, eq=False)
class CropBatch:
    """b crops with their target maps."""

    image: Tensor  # (b, height, width, 3) uint8
    targets: dict[str, Tensor]  # by the names of ``Targets``

    def to(self, device: torch.device) -> "CropBatch":
        targets = {
            name: target.to(device, non_blocking=True) for name, target in self.targets.items()
        }
        return CropBatch(self.image.to(device, non_blocking=True), targets)


@dataclass(frozen=True, eq=False)
class TrainingCrop:
    """A crop with its target maps."""

    image: ByteImage
    targets: Targets


class DetectorTask:
    """Training of the detector's network on crops of labelled images."""

    name = TASK
    samples = DETECTOR_SAMPLES

    def __init__(
        self,
        source: LabelledImages,
        classes: ClassSet = DEFAULT_CLASSES,
        size: NetworkSize = STANDARD,
    ):
        self.source = source
        self.classes = classes
        self.detector = DetectorNet(len(classes), size)
        self.network: nn.Module = self.detector
        self.options: dict[str, Any] = {
            "classes": [class_.name for class_ in classes],
            "data": source.describe(),
            EQUALIZED: "CLAHE",
        }

    def learning_rate(self, progress: Progress) -> float:
        return cosine(progress, RATE)

    def make(self, number: int) -> TrainingCrop:
        """Return a random crop of a random image."""
        rng = np.random.default_rng([number, 7])
        labelled = self.source.image(int(rng.integers(self.source.count)))
        return self._with_targets(random_crop(labelled, rng))

    def held_out(self, number: int) -> TrainingCrop:
        """Return a crop of the validation images in turn, at another position in each round."""
        rounds, row = divmod(number, self.source.held_out_count)
        share = ((row + rounds) * 0.37) % 1.0
        return self._with_targets(middle_crop(self.source.held_out(row), share))

    def collate(self, items: Sequence[TrainingCrop]) -> CropBatch:
        return CropBatch(
            torch.from_numpy(np.stack([crop.image for crop in items])),
            {
                field.name: torch.from_numpy(
                    np.stack([getattr(item.targets, field.name) for item in items])
                )
                for field in fields(Targets)
            },
        )

    def losses(self, batch: CropBatch, progress: Progress) -> dict[str, Tensor]:
        """Return the weighted sum, and its parts."""
        parts = self.figures(batch)
        loss = torch.stack([WEIGHTS[name] * part for name, part in parts.items()]).sum()
        return {"loss": loss, **parts}

    def figures(self, batch: CropBatch) -> dict[str, Tensor]:
        """Return each part of the loss."""
        channels, targets = Channels(len(self.classes)), batch.targets
        maps: Tensor = self.detector(batch.image)
        sign, size = targets["sign_weight"], targets["size_weight"]
        pole, width = targets["pole_weight"], targets["width_weight"]
        pixels, mask = _mask_losses(masks_of(maps, channels), targets)
        known = binary_cross_entropy_with_logits
        return {
            "heat": focal(maps[:, channels.heat], targets["heat"], targets["counts"]),
            "middle": _mean(_code, maps[:, channels.middle], targets["sign"][:, :2], sign),
            "size": _mean(_code, maps[:, channels.size], targets["sign"][:, 2:], size),
            "ends": _mean(_code, maps[:, channels.ends], targets["pole"][:, :4], pole),
            "width": _mean(_code, maps[:, channels.width], targets["pole"][:, 4:], width),
            "known": _mean(known, maps[:, channels.known], targets["known"], pole),
            "pixels": pixels,
            "mask": mask,
        }

    @property
    def model(self) -> HeatmapModel:
        """The network as a model, with weights of its own."""
        network = DetectorNet(len(self.classes), self.detector.size)
        network.load_state_dict(self.network.state_dict())
        return HeatmapModel.of(network, self.classes)

    def finish(self) -> None:
        """Choose the detection thresholds."""
        rows = range(min(self.source.held_out_count, TUNING_IMAGES))
        threshold = chosen_thresholds(self.model, map(self._tuning_image, rows), self.classes)
        self.detector.threshold.copy_(torch.from_numpy(threshold))

    def _tuning_image(self, row: int) -> LabelledImage:
        """Return a held-out image, in other surroundings if it has masks.

        Streets as rendered are so easy that thresholds chosen on them lose half of what is found on
        real ones.
        """
        image = self.source.held_out(row)
        rng = np.random.default_rng([row, 8])
        return image if image.regions is None else view_elsewhere(image, rng)

    def _with_targets(self, crop: Crop) -> TrainingCrop:
        return TrainingCrop(equalized(crop.image), Targets.of(crop, self.classes))


def make_detector(source: LabelledImages, seed: int = 0, start: Path | None = None) -> DetectorTask:
    """Return the task with new weights, drawn from ``seed``, or with those of a file ``start``.

    Raise SemvizError if the file is missing or holds another network.
    """
    torch.manual_seed(seed)
    if start is None:
        return DetectorTask(source)
    weights = read_weights(start)
    weights.check(TASK, DEFAULT_CLASSES, start)
    task = DetectorTask(source, size=size_of(weights, start))
    weights.load_into(task.network, start)
    task.options["from"] = sha256(start.read_bytes()).hexdigest()
    return task


def focal(logit: Tensor, heat: Tensor, counts: Tensor) -> Tensor:
    """Return CenterNet's focal loss of heat (b, classes, h, w) per element.

    ``counts`` (b, h, w) is 0 where heat is ignored (Zhou et al. 2019, eq. 1, alpha 2, beta 4).
    """
    p = logit.sigmoid().clamp(1e-4, 1.0 - 1e-4)
    middle = (heat >= SURELY).float()
    right = middle * (1.0 - p) ** 2 * p.log()
    wrong = (1.0 - middle) * (1.0 - heat) ** 4 * p**2 * (1.0 - p).log() * counts[:, None]
    return -(right + wrong).sum() / middle.sum().clamp(min=1.0)


def _code(predicted: Tensor, target: Tensor, reduction: str) -> Tensor:
    return smooth_l1_loss(predicted, target, reduction=reduction, beta=EVENLY)


def _mean(loss: Callable[..., Tensor], predicted: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Return the mean over cells of a loss summed over channels, weighted by (b, h, w)."""
    each = loss(predicted, target, reduction="none").sum(dim=1)
    return (each * weight).sum() / weight.sum().clamp(min=1.0)


def _mask_losses(logit: Tensor, targets: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    """Return the losses of masks (b, 2, h, w): the cross-entropy of pixels, and 1 - Dice's overlap,
    which does not depend on how few pixels are poles."""
    weight = targets["mask_weight"][:, None]
    target = targets["mask"]
    each = binary_cross_entropy_with_logits(logit, target, reduction="none")
    predicted = logit.sigmoid() * weight
    both = (predicted * target).sum(dim=(0, 2, 3))
    either = predicted.sum(dim=(0, 2, 3)) + (target * weight).sum(dim=(0, 2, 3))
    return (each * weight).mean(), 1.0 - ((2.0 * both + 1.0) / (either + 1.0)).mean()
