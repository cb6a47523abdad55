"""Which mode of a search is right, by a small network; its one definition, for numpy and torch.

Two sets, the mapped elements about a mode and what is seen, are pooled, joined with the numbers of
the mode itself, and compared with all modes of the frame. The answer is a log-odds for each mode,
and one for none of them. A straight line from the mode's numbers to its log-odds goes beside it
all, which alone would be a logistic regression.
"""

from collections.abc import Mapping
from typing import Any, TypeAlias

from semviz_core.learning.evidence import OF_A_MAPPED, OF_A_MODE, OF_A_SEEN

Numbers: TypeAlias = Any
"""A float32 array of numpy, or a tensor of torch; both know what is done with it here."""
HIDDEN, TOGETHER = 32, 64


def layer_sizes(classes: int) -> dict[str, tuple[int, int]]:
    """Inputs and outputs of each layer by name."""
    return {
        "mapped1": (OF_A_MAPPED + classes, HIDDEN),
        "mapped2": (HIDDEN, HIDDEN),
        "seen1": (OF_A_SEEN + classes, HIDDEN),
        "seen2": (HIDDEN, HIDDEN),
        "mode1": (OF_A_MODE, TOGETHER),
        "about": (HIDDEN, TOGETHER),
        "image": (HIDDEN, TOGETHER),
        "mode2": (TOGETHER, HIDDEN),
        "own": (HIDDEN, HIDDEN),
        "frame": (HIDDEN, HIDDEN),
        "right": (HIDDEN, 1),
        "straight": (OF_A_MODE, 1),
        "none": (HIDDEN, 1),
    }


def log_odds(
    weights: Mapping[str, Numbers],
    mode: Numbers,
    weight: Numbers,
    mapped: Numbers,
    near: Numbers,
    seen: Numbers,
    is_seen: Numbers,
) -> tuple[Numbers, Numbers]:
    """(..., b) of the modes, and (...) of none being right, before they are made to sum up to 1.

    As in ``Evidence``, with leading dimensions and padding: ``weight``, ``near`` and ``is_seen``
    (..., b, m) are 0 there.
    """

    def layer(name: str, x: Numbers) -> Numbers:
        return x @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]

    def pooled(name: str, x: Numbers, there: Numbers) -> Numbers:
        each = layer(f"{name}2", layer(f"{name}1", x).clip(min=0.0)).clip(min=0.0)
        return (each * there[..., None]).sum(-2) / 8.0

    about = layer("about", pooled("mapped", mapped, near))
    image = layer("image", pooled("seen", seen, is_seen))
    first = (layer("mode1", mode) + about + image).clip(min=0.0)
    each = layer("mode2", first).clip(min=0.0)
    share = weight / weight.sum(-1)[..., None].clip(min=1e-9)
    frame = (each * share[..., None]).sum(-2)
    compared = (layer("own", each) + layer("frame", frame)[..., None, :]).clip(min=0.0)
    right = layer("right", compared) + layer("straight", mode)
    return right[..., 0], layer("none", frame)[..., 0]
