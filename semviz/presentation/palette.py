"""Colours of poses, status and residuals, shared by all pages and plots.

Element classes have their own colours (`semviz_core.base.classes`).
"""

from dataclasses import dataclass

import numpy as np

from semviz_core.base.localization import Status
from semviz_core.common.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class Tone:
    """A colour in sRGB hex; ``dark`` is for dark backgrounds and for every image."""

    dark: str
    light: str


TRUTH = Tone("#FFFFFF", "#111111")
ESTIMATE = Tone("#FF7A1A", "#C94A08")
PRIOR = Tone("#8B9198", "#74797F")
ALTERNATIVE = Tone("#B79CFF", "#6741D9")

STATUS: dict[Status, Tone] = {
    "ok": Tone("#5C9DED", "#1F62C8"),
    "ambiguous": Tone("#F5C542", "#A2811A"),
    "cannot": Tone("#F0532D", "#8E1B08"),
}

RESIDUAL_LIMITS_PX = (1.0, 2.0, 3.0, 5.0)
"""Upper limits of the residual colours except the last; the same in all frames."""
RESIDUAL = (
    Tone("#4A78C9", "#2C5AA0"),
    Tone("#8CC2E0", "#4F9BC4"),
    Tone("#F2E6A8", "#A8923A"),
    Tone("#F29A4A", "#D06A14"),
    Tone("#E0402A", "#A81C1C"),
)

USED_LIMITS = (2, 5, 10, 20)
"""Upper limits, in frames that used an element, of the colours except the last."""
USED = (
    Tone("#3F659F", "#96B2D6"),
    Tone("#6896C4", "#6989BF"),
    Tone("#99B4C2", "#3C60A8"),
    Tone("#C9D2C0", "#2A4183"),
    Tone("#FAF0BE", "#18225E"),
)
"""The part of the probability ramp that contrasts with the background of the 3D scene."""


def residual_level(residual_px: FloatArray) -> IntArray:
    """Return indices (k,) into RESIDUAL of residual lengths (k,) in pixels."""
    return np.searchsorted(RESIDUAL_LIMITS_PX, residual_px, side="right").astype(np.int64)


def rgba(color: str, alpha: float = 1.0) -> int:
    """Return ``#RRGGBB`` as the number 0xRRGGBBAA."""
    return int(color[1:], 16) << 8 | round(alpha * 255)


def residual_colors(residual_px: FloatArray) -> IntArray:
    """Return dark colours 0xRRGGBBAA (k,) of residual lengths (k,) in pixels."""
    return np.array([rgba(tone.dark) for tone in RESIDUAL])[residual_level(residual_px)]
