"""The detector's network: a small residual pyramid, as CenterNet's, that answers at stride 4.

Zhou et al., "Objects as Points" (2019); the pyramid is Lin et al.'s (2017). One core of a CPU has
to run it, so it is narrow where images are large.
"""

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, pixel_shuffle
from torch.nn.utils.fusion import fuse_conv_bn_eval

from semviz_core.detection.maps import MASKS, Channels

WIDTHS = (16, 24, 48, 96, 128)
"""Channels at strides 2, 4, 8, 16 and 32."""
BLOCKS = (0, 1, 2, 2, 2)
"""Residual blocks there. Those at stride 32 look 300 px up and down: to both ends of poles as
tall as an image."""
PYRAMID, HEAD = 32, 48
RARE = -4.6
"""Heat's first logit: nearly nowhere is the middle of something."""
MEAN, SPREAD = 114.0, 64.0
"""Of 8-bit pixels, about."""


class DetectorNet(nn.Module):
    """Images (b, height, width, 3) 8-bit sRGB, sides multiples of 32, to maps of float32.

    Maps are (b, ``Channels.count``, height / 4, width / 4), masks shuffled in; ``Channels`` says
    what is where.
    """

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.stages = nn.ModuleList(
            nn.Sequential(_conv(before, width, 2), *(_Residual(width) for _ in range(blocks)))
            for before, width, blocks in zip((3, *WIDTHS), WIDTHS, BLOCKS, strict=False)
        )
        self.lateral = nn.ModuleList(nn.Conv2d(width, PYRAMID, 1) for width in WIDTHS[1:])
        self.merge = nn.ModuleList(_conv(PYRAMID, PYRAMID) for _ in WIDTHS[2:])
        self.head = _conv(PYRAMID, HEAD)
        channels = Channels(classes)
        self.answer = nn.Conv2d(HEAD, channels.count, 1)
        bias = torch.zeros(channels.count)
        bias[channels.heat] = RARE
        self.answer.bias = nn.Parameter(bias)
        self.register_buffer("threshold", torch.full((classes,), 0.3))
        self.threshold: Tensor
        """(classes,) of heat, from which on something is told; chosen when training is over."""
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
        with torch.autocast(image.device.type, enabled=False):  # 8 bits are too few for pixels
            answer: Tensor = self.answer(y.float())
        return answer

    def folded(self) -> "DetectorNet":
        """Itself, for inference only: normalization becomes part of the convolutions before it."""
        for block in [one for one in self.modules() if isinstance(one, nn.Sequential)]:
            convolution, *others = block
            if isinstance(convolution, nn.Conv2d) and isinstance(others[0], nn.BatchNorm2d):
                block[0] = fuse_conv_bn_eval(convolution, others[0])
                block[1] = nn.Identity()
        return self


def masks_of(maps: Tensor, channels: Channels) -> Tensor:
    """(b, 2, 2 h, 2 w) logits of poles' and signs' pixels, of maps (b, channels, h, w)."""
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
