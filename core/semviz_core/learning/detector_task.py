"""Training of the detector's network: from labelled images to maps that tell what is in them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, smooth_l1_loss

from semviz_core.arrays import ByteImage
from semviz_core.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.detection.labelled import LabelledImages
from semviz_core.detection.maps import Channels
from semviz_core.detection.own import TASK, OwnFinder
from semviz_core.learning.detector_crops import Crop, middle_crop, random_crop
from semviz_core.learning.detector_targets import Targets
from semviz_core.learning.detector_thresholds import chosen_thresholds
from semviz_core.learning.networks.detector import DetectorNet, masks_of
from semviz_core.learning.schedule import cosine
from semviz_core.learning.task import Progress
from semviz_core.learning.weights import read_weights

RATE = 2e-3
DETECTOR_SAMPLES = 48_000
TUNING_IMAGES = 200
SURELY = 0.999
"""Heat in the cell of an element's middle."""
EVENLY = 0.1
"""Errors of codes beyond count by their size, smaller ones by their square."""
WEIGHTS = {
    "heat": 1.0, "middle": 1.0, "size": 0.5, "ends": 1.0, "width": 0.3,
    "known": 0.3, "pixels": 2.0, "mask": 0.5,
}  # fmt: skip
"""Of the parts of the loss."""


@dataclass(frozen=True, eq=False)
class CropBatch:
    """b crops with what the maps should say of them."""

    image: Tensor  # (b, height, width, 3) uint8
    targets: dict[str, Tensor]  # by the names of ``Targets``

    def to(self, device: torch.device) -> "CropBatch":
        targets = {name: one.to(device) for name, one in self.targets.items()}
        return CropBatch(self.image.to(device), targets)


@dataclass(frozen=True, eq=False)
class LearnedCrop:
    """A crop and what the maps should say of it."""

    image: ByteImage
    targets: Targets


class DetectorTask:
    """The detector's network on crops of labelled images."""

    name = TASK
    samples = DETECTOR_SAMPLES

    def __init__(self, source: LabelledImages, classes: ClassSet = DEFAULT_CLASSES):
        self.source = source
        self.classes = classes
        self.detector = DetectorNet(len(classes))
        self.network: nn.Module = self.detector
        self.options: dict[str, Any] = {
            "classes": [one.name for one in classes],
            "data": source.describe(),
        }

    def learning_rate(self, progress: Progress) -> float:
        return cosine(progress, RATE)

    def make(self, number: int) -> LearnedCrop:
        """Of any of the images, cut and changed at random."""
        rng = np.random.default_rng([number, 7])
        labelled = self.source.image(int(rng.integers(self.source.count)))
        return self._learned(random_crop(labelled, rng))

    def held_out(self, number: int) -> LearnedCrop:
        """Of all images of that kind in turn, cut from other places in each round."""
        rounds, row = divmod(number, self.source.held_out_count)
        share = ((row + rounds) * 0.37) % 1.0
        return self._learned(middle_crop(self.source.held_out(row), share))

    def collate(self, items: Sequence[LearnedCrop]) -> CropBatch:
        return CropBatch(
            torch.from_numpy(np.stack([one.image for one in items])),
            {
                one.name: torch.from_numpy(
                    np.stack([getattr(item.targets, one.name) for item in items])
                )
                for one in fields(Targets)
            },
        )

    def losses(self, together: CropBatch, progress: Progress) -> dict[str, Tensor]:
        """The weighted sum, and its parts."""
        parts = self.figures(together)
        loss = torch.stack([WEIGHTS[name] * part for name, part in parts.items()]).sum()
        return {"loss": loss, **parts}

    def figures(self, together: CropBatch) -> dict[str, Tensor]:
        """Each part of the loss."""
        channels, targets = Channels(len(self.classes)), together.targets
        maps: Tensor = self.detector(together.image)
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

    def finish(self) -> None:
        """Chooses from which heat on elements are told."""
        network = DetectorNet(len(self.classes))
        network.load_state_dict(self.network.state_dict())
        finder = OwnFinder.of(network, self.classes)
        rows = range(min(self.source.held_out_count, TUNING_IMAGES))
        images = (self.source.held_out(row) for row in rows)
        threshold = chosen_thresholds(finder, images, self.classes)
        self.detector.threshold.copy_(torch.from_numpy(threshold))

    def _learned(self, crop: Crop) -> LearnedCrop:
        return LearnedCrop(crop.image, Targets.of(crop, self.classes))


def make_detector(source: LabelledImages, seed: int = 0, start: Path | None = None) -> DetectorTask:
    """With fresh weights, drawn from ``seed``, or those of a file ``start``.

    Raises SemvizError where these are missing or for something else.
    """
    torch.manual_seed(seed)
    task = DetectorTask(source)
    if start is not None:
        weights = read_weights(start)
        weights.check(TASK, task.classes, start)
        weights.put_into(task.network, start)
        task.options["from"] = sha256(start.read_bytes()).hexdigest()
    return task


def focal(logit: Tensor, heat: Tensor, counts: Tensor) -> Tensor:
    """CenterNet's focal loss of heat (b, classes, h, w), for each middle that is there; ``counts``
    (b, h, w) is 0 where nothing is learned (Zhou et al. 2019, eq. 1, with alpha 2 and beta 4)."""
    p = logit.sigmoid().clamp(1e-4, 1.0 - 1e-4)
    middle = (heat >= SURELY).float()
    right = middle * (1.0 - p) ** 2 * p.log()
    wrong = (1.0 - middle) * (1.0 - heat) ** 4 * p**2 * (1.0 - p).log() * counts[:, None]
    return -(right + wrong).sum() / middle.sum().clamp(min=1.0)


def _code(told: Tensor, wanted: Tensor, reduction: str) -> Tensor:
    return smooth_l1_loss(told, wanted, reduction=reduction, beta=EVENLY)


def _mean(loss: Callable[..., Tensor], told: Tensor, wanted: Tensor, weight: Tensor) -> Tensor:
    """Of a loss of each cell, summed over channels, by weights (b, h, w)."""
    each = loss(told, wanted, reduction="none").sum(dim=1)
    return (each * weight).sum() / weight.sum().clamp(min=1.0)


def _mask_losses(logit: Tensor, targets: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    """Of masks (b, 2, h, w): cross-entropy of each pixel, and 1 - Dice's overlap of both masks,
    which does not mind how few pixels are poles."""
    weight = targets["mask_weight"][:, None]
    wanted = targets["mask"]
    each = binary_cross_entropy_with_logits(logit, wanted, reduction="none")
    told = logit.sigmoid() * weight
    both = (told * wanted).sum(dim=(0, 2, 3))
    either = told.sum(dim=(0, 2, 3)) + (wanted * weight).sum(dim=(0, 2, 3))
    return (each * weight).mean(), 1.0 - ((2.0 * both + 1.0) / (either + 1.0)).mean()
