"""semviz weights"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg


@dataclass(frozen=True)
class Weights:
    """Take the weights out of a training, with a card that says where they come from: for
    semviz localize --weights."""

    training: Annotated[Positional[Path], arg(metavar="TRAINING")]
    """The folder that 'semviz train' was given as --out."""
    out: Annotated[Path, arg(metavar="DIR")]
    """Folder for MODEL.safetensors and the card, MODEL.json."""

    def run(self) -> int:
        from semviz_core.learning.card import write_weights

        path = write_weights(self.training, self.out)
        print(f"{path}: {path.stat().st_size / 1e6:.1f} MB, card {path.with_suffix('.json')}")
        return 0
