"""What a training's losses were: lines of JSON, each a mean over some hundred steps."""

import json
from collections.abc import Mapping
from math import isfinite
from pathlib import Path
from typing import Any

from semviz_core.errors import SemvizError
from semviz_core.files import replacing

WINDOW_STEPS = 200
Window = dict[str, tuple[float, int]]
"""Sum and number of each value's finite occurrences."""


class History:
    """A file of lines ``{"samples": 2400, "losses": {...}}`` and ``{..., "held_out": {...}}``."""

    def __init__(self, path: Path, samples: int) -> None:
        """Lines of later than ``samples`` go: a training that was killed makes them again."""
        self.path = path
        kept = [line for line in read_history(path) if line["samples"] <= samples]
        with replacing(path) as temporary:
            temporary.write_text("".join(json.dumps(line) + "\n" for line in kept))

    def write(self, samples: int, **facts: Mapping[str, float]) -> None:
        """Append one line."""
        with self.path.open("a") as file:
            file.write(json.dumps({"samples": samples, **facts}) + "\n")


def read_history(path: Path) -> list[dict[str, Any]]:
    """The whole lines; none if there is no file."""
    if not path.is_file():
        return []
    content = path.read_bytes()
    lines = content[: content.rfind(b"\n") + 1].splitlines()  # the last may be torn
    try:
        return [{"samples": 0} | json.loads(line) for line in lines]
    except (ValueError, TypeError):
        raise SemvizError(f"{path}: not the losses of a training; move it away") from None


def add(window: Window, values: Mapping[str, float], weight: int = 1) -> None:
    """Count values in, each as the mean of ``weight`` of them."""
    for name, value in values.items():
        if isfinite(value):
            total, number = window.get(name, (0.0, 0))
            window[name] = (total + value * weight, number + weight)


def means(window: Window) -> dict[str, float]:
    """Of what was counted in, to six digits."""
    return {name: float(f"{total / number:.6g}") for name, (total, number) in window.items()}
