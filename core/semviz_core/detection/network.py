"""The shipped detector as a model: an image in, regions out.

The network is a small residual network with a feature pyramid (Lin et al. 2017) and outputs at
stride 4, as in CenterNet (Zhou et al., "Objects as Points", 2019). It must run on one CPU core, so
it has few channels at high resolution. It takes 8-bit sRGB images, whose contrast is equalized
locally first: real streets have deep shade and glare, rendered ones do not.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import interpolate, pixel_shuffle
from torch.nn.utils.fusion import fuse_conv_bn_eval

from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.base.weights import NetworkWeights, load_trained, version_error
from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.jit import Stopwatch
from semviz_core.detection.heatmaps import BORDER, MASKS, Channels, regions_in
from semviz_core.detection.regions import Region

TASK = "detector"
SIDES = 32
"""Stride of the coarsest level: images are padded to multiples of it."""


@dataclass(frozen=True, eq=False)
class HeatmapModel:
    """The network of ``semviz detect train`` with its weights."""

    network: "DetectorNet"
    classes: ClassSet
    threshold: FloatArray
    """(classes,) least heat of a region."""
    name: str = "semviz"
    equalizes: bool = True
    """Whether the network was trained on ``equalized`` images; older ones were not."""

    @classmethod
    def of(
        cls, network: "DetectorNet", classes: ClassSet, equalizes: bool = True
    ) -> "HeatmapModel":
        """Return the model of a trained network, which is changed for inference."""
        threshold = network.threshold.double().numpy()
        return cls(network.eval().folded(), classes, threshold, equalizes=equalizes)

    def from_score(self, least: float) -> "HeatmapModel":
        """Return the model with one threshold, instead of those chosen in training."""
        return replace(self, threshold=np.full(len(self.classes), least))

    def find(self, image: ByteImage, watch: Stopwatch | None = None) -> list[Region]:
        """Return the regions in an image (height, width, 3) sRGB of any size, best score first."""
        watch = watch or Stopwatch()
        maps, masks = watch.time("network", lambda: self._run(image))
        size = (image.shape[0], image.shape[1])
        return watch.time(
            "regions", lambda: regions_in(maps, masks, self.threshold, self.classes, size)
        )

    def _run(self, image: ByteImage) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the maps and masks of an image."""
        import torch

        if image.ndim != 3 or image.shape[2] != 3 or not image.size:
            raise SemvizError(f"an image of shape {image.shape}; give (height, width, 3)")
        if self.equalizes:
            image = equalized(image)
        height, width = image.shape[:2]
        below, beside = -height % SIDES, -width % SIDES
        padded = np.pad(image, ((0, below), (0, beside), (0, 0)), constant_values=BORDER)
        with torch.inference_mode():
            maps = self.network(torch.from_numpy(padded)[None])
            masks = masks_of(maps, Channels(len(self.classes)))[0]
        return maps[0].numpy(), masks.numpy()


def load_shipped_model(
    path: Path | None = None, classes: ClassSet = DEFAULT_CLASSES
) -> HeatmapModel:
    """Return the model with the weights at ``path``; default: the shipped weights.

    Raise SemvizError if the weights are missing or for another task, or torch is missing.
    """
    return load_trained(TASK, path, classes, _build)


def _build(weights: NetworkWeights, classes: ClassSet, path: Path) -> HeatmapModel:
    network = DetectorNet(len(classes), size_of(weights, path))
    weights.load_into(network, path)
    return HeatmapModel.of(network, classes, equalizes=EQUALIZED in weights.options)


def size_of(weights: NetworkWeights, path: Path) -> "NetworkSize":
    """Return the size of the network that weights are of. Raise SemvizError for other networks."""
    try:
        return NetworkSize.of(weights.tensors)
    except KeyError:
        raise version_error(TASK, path) from None


EQUALIZED = "equalized"
"""Option of weights whose network was trained on equalized images: how they were made."""
_TILE_PX, _MOST_CONTRAST = 128, 2.0


def equalized(image: ByteImage) -> ByteImage:
    """Return an image (height, width, 3) sRGB with the contrast of its lightness equalized in tiles
    (CLAHE, Zuiderveld 1994); its colours stay."""
    import cv2

    height, width = image.shape[:2]
    tiles = max(1, round(width / _TILE_PX)), max(1, round(height / _TILE_PX))
    lab = cv2.cvtColor(image, cv2.COLOR_RGB2LAB)
    lab[..., 0] = cv2.createCLAHE(_MOST_CONTRAST, tiles).apply(lab[..., 0])
    return np.asarray(cv2.cvtColor(lab, cv2.COLOR_LAB2RGB), np.uint8)


@dataclass(frozen=True)
class NetworkSize:
    """Channels and depth of a ``DetectorNet``."""

    widths: tuple[int, ...] = (24, 36, 72, 128, 160)
    """Channels at strides 2, 4, 8, 16 and 32."""
    blocks: tuple[int, ...] = (0, 1, 2, 3, 2)
    """Residual blocks at each stride. At stride 32 the receptive field reaches 300 px up and down:
    both ends of a pole as tall as an image."""
    pyramid: int = 48
    head: int = 64

    @classmethod
    def of(cls, tensors: Mapping[str, NDArray[np.float32]]) -> "NetworkSize":
        """Return the size of the network that weights, by state-dict name, are of.

        Raise KeyError if they are of another kind of network.
        """

        def numbers(name: str, first: int) -> range:
            """Return the numbers, from ``first`` on, with which weights are named so."""
            return range(first, next(n for n in count(first) if name.format(n) not in tensors))

        stages = numbers("stages.{}.0.0.weight", 0)
        widths = [len(tensors[f"stages.{stage}.0.0.weight"]) for stage in stages]
        blocks = [len(numbers(f"stages.{stage}.{{}}.one.0.weight", 1)) for stage in stages]
        pyramid, head = (len(tensors[name]) for name in ("lateral.0.weight", "head.0.weight"))
        return cls(tuple(widths), tuple(blocks), pyramid, head)


STANDARD = NetworkSize()
"""The size of new networks."""
RARE = -4.6
"""Initial logit of heat, since few cells hold a centre."""
MEAN, SPREAD = 114.0, 64.0
"""Approximate mean and standard deviation of 8-bit pixels."""


class DetectorNet(nn.Module):
    """Images (b, height, width, 3) 8-bit sRGB, sides multiples of 32, to maps of float32.

    Maps are (b, ``Channels.count``, height / 4, width / 4), masks included as channels;
    ``Channels`` gives their order.
    """

    def __init__(self, classes: int, size: NetworkSize = STANDARD) -> None:
        super().__init__()
        self.size = size
        widths, pyramid, head = size.widths, size.pyramid, size.head
        self.stages = nn.ModuleList(
            nn.Sequential(_conv(before, width, 2), *(_Residual(width) for _ in range(blocks)))
            for before, width, blocks in zip((3, *widths), widths, size.blocks, strict=False)
        )
        self.lateral = nn.ModuleList(nn.Conv2d(width, pyramid, 1) for width in widths[1:])
        self.merge = nn.ModuleList(_conv(pyramid, pyramid) for _ in widths[2:])
        self.head = _conv(pyramid, head)
        channels = Channels(classes)
        self.answer = nn.Conv2d(head, channels.count, 1)
        bias = torch.zeros(channels.count)
        bias[channels.heat] = RARE
        self.answer.bias = nn.Parameter(bias)
        self.register_buffer("threshold", torch.full((classes,), 0.3))
        self.threshold: Tensor
        """(classes,) least heat of a region; chosen after training."""
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # twice as fast

    def forward(self, image: Tensor) -> Tensor:
        x = (image.permute(0, 3, 1, 2).float() - MEAN) / SPREAD  # channels last, as stored
        levels: list[Tensor] = []
        for stage in self.stages:
            x = stage(x)
            levels.append(x)
        y = self.lateral[-1](levels[-1])
        for number in range(len(self.merge) - 1, -1, -1):
            y = interpolate(y, scale_factor=2.0, mode="nearest") + self.lateral[number](
                levels[number + 1]
            )
            y = self.merge[number](y)
        y = self.head(y)
        with torch.autocast(image.device.type, enabled=False):  # bfloat16 is too coarse for pixels
            answer: Tensor = self.answer(y.float())
        return answer

    def folded(self) -> "DetectorNet":
        """Return self for inference only, with normalization folded into the convolutions."""
        for block in [module for module in self.modules() if isinstance(module, nn.Sequential)]:
            convolution, *others = block
            if isinstance(convolution, nn.Conv2d) and isinstance(others[0], nn.BatchNorm2d):
                block[0] = fuse_conv_bn_eval(convolution, others[0])
                block[1] = nn.Identity()
        return self


def masks_of(maps: Tensor, channels: Channels) -> Tensor:
    """Return (b, 2, 2 h, 2 w) logits of pole and sign pixels from maps (b, channels, h, w)."""
    return pixel_shuffle(maps[:, channels.mask], MASKS)


class _Residual(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.one, self.other = _conv(width, width), _conv(width, width)

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = x + self.other(self.one(x))
        return y


def _conv(before: int, width: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(before, width, 3, stride, 1, bias=False),
        nn.BatchNorm2d(width),
        nn.ReLU(inplace=True),
    )
