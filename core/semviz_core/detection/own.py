"""Our own network as a finder: from an image to the regions that it tells."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from semviz_core.arrays import ByteImage, FloatArray
from semviz_core.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.detection.maps import BORDER, Channels, regions_in
from semviz_core.detection.region import Region
from semviz_core.errors import SemvizError
from semviz_core.learning.weights import Weights, load_trained

if TYPE_CHECKING:
    from semviz_core.learning.networks.detector import DetectorNet

TASK = "detector"
SIDES = 32
"""The network's coarsest cells: images are filled up to multiples of so many pixels."""


@dataclass(frozen=True, eq=False)
class OwnFinder:
    """The network of ``semviz detect train`` with its weights."""

    network: "DetectorNet"
    classes: ClassSet
    least: FloatArray
    """(classes,) heat from which on something is told."""
    name: str = "semviz"

    @classmethod
    def of(cls, network: "DetectorNet", classes: ClassSet) -> "OwnFinder":
        """Of a network that has learned; it is for nothing else any more."""
        return cls(network.eval().folded(), classes, network.threshold.double().numpy())

    def find(self, image: ByteImage) -> list[Region]:
        """What it sees in an image (height, width, 3) sRGB of any size, the surest first."""
        import torch

        from semviz_core.learning.networks.detector import masks_of

        if image.ndim != 3 or image.shape[2] != 3 or not image.size:
            raise SemvizError(f"an image of shape {image.shape}; give (height, width, 3)")
        height, width = image.shape[:2]
        below, beside = -height % SIDES, -width % SIDES
        filled = np.pad(image, ((0, below), (0, beside), (0, 0)), constant_values=BORDER)
        with torch.inference_mode():
            maps = self.network(torch.from_numpy(filled)[None])
            masks = masks_of(maps, Channels(len(self.classes)))[0]
        shape = (height, width)
        return regions_in(maps[0].numpy(), masks.numpy(), self.least, self.classes, shape)


def load_own(path: Path | None = None, classes: ClassSet = DEFAULT_CLASSES) -> OwnFinder:
    """With the weights at ``path``, or those that come with semviz.

    Raises SemvizError where there are none, or they are for something else.
    """
    return load_trained(TASK, path, classes, _built)


def _built(weights: Weights, classes: ClassSet, path: Path) -> OwnFinder:
    from semviz_core.learning.networks.detector import DetectorNet

    network = DetectorNet(len(classes))
    weights.put_into(network, path)
    return OwnFinder.of(network, classes)
