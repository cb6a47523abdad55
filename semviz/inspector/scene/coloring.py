"""What the colours of the map say: classes, residuals, or how often an element was used."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from semviz.inspector.scene.usage import Usage
from semviz.inspector.session import MapColors
from semviz.palette import RESIDUAL, RESIDUAL_LIMITS_PX, USED, USED_LIMITS, residual_level
from semviz.web.colors import PALETTES, Theme, mix
from semviz.web.scene import ElementLook, Scene, class_rows
from semviz_core.arrays import IntArray
from semviz_core.semantic_map import SemanticMap

FAINT = 0.45
"""Strength of elements beyond the submap where colours say the class."""
FAINT_PX = 1.0
WIDTHS_PX = (1.4, 1.8, 2.2, 2.7, 3.2)
"""By level: the width says what the colour says."""
NEVER_PX = 1.0

Json = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Coloring:
    """A look for each element of a map."""

    looks: tuple[ElementLook, ...]
    look_of: IntArray
    """(n,) which of the looks an element has."""


def coloring(colors: MapColors, semantic_map: SemanticMap, usage: Usage, scene: Scene) -> Coloring:
    """How the map is drawn; in colours other than the class's, the last look is for never used."""
    if colors == "class":
        rows = class_rows(semantic_map.elements.class_id, semantic_map.classes)
        return Coloring(scene.class_looks(semantic_map.classes, FAINT, FAINT_PX), rows)
    never = ElementLook(_never(scene.theme), NEVER_PX)
    looks = [ElementLook(*one) for one in zip(_ramp(colors, scene.theme), WIDTHS_PX, strict=True)]
    return Coloring((*looks, never), levels(colors, usage))


def levels(colors: MapColors, usage: Usage) -> IntArray:
    """(n,) level of each element, the number of levels where it was never used."""
    if colors == "residual":
        level = residual_level(usage.residual_px)
    else:
        level = np.searchsorted(USED_LIMITS, usage.times, side="left").astype(np.int64)
    return np.where(usage.times == 0, len(WIDTHS_PX), level)


def legend(colors: MapColors, usage: Usage, theme: Theme) -> Json:
    """What the page writes beside the colours: from, to and number of elements of each level."""
    if colors == "class":
        return {"by": colors, "steps": []}
    level = levels(colors, usage)
    limits = RESIDUAL_LIMITS_PX if colors == "residual" else USED_LIMITS
    names = _residual_steps(limits) if colors == "residual" else _count_steps()
    steps = [
        {"color": color, "width": width, "name": name, "elements": int((level == number).sum())}
        for number, (color, width, name) in enumerate(
            zip(_ramp(colors, theme), WIDTHS_PX, names, strict=True)
        )
    ]
    never = {
        "color": _never(theme),
        "width": NEVER_PX,
        "name": "never",
        "elements": int((usage.times == 0).sum()),
    }
    return {"by": colors, "steps": [*steps, never]}


def _residual_steps(limits: tuple[float, ...]) -> list[str]:
    lows = (0.0, *limits[:-1])
    return [f"{low:g}-{high:g}" for low, high in zip(lows, limits, strict=True)] + [
        f"over {limits[-1]:g}"
    ]


def _count_steps() -> list[str]:
    lows = (1, *(limit + 1 for limit in USED_LIMITS[:-1]))
    names = [f"{low}-{high}" for low, high in zip(lows, USED_LIMITS, strict=True)]
    return [*names, f"over {USED_LIMITS[-1]}"]


def _ramp(colors: MapColors, theme: Theme) -> tuple[str, ...]:
    tones = RESIDUAL if colors == "residual" else USED
    return tuple(one.dark if theme == "dark" else one.light for one in tones)


def _never(theme: Theme) -> str:
    palette = PALETTES[theme]
    return mix(palette.faint, palette.scene, 0.5)
