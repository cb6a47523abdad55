"""Workspaces over simulated streets whose pictures are painted once for all tests.

The first picture of a street costs most of a second: its textures are made then.
"""

from functools import lru_cache
from pathlib import Path

from semviz.workspace.workspace import Workspace
from semviz_core.base.frame import Side
from semviz_core.common.arrays import ByteImage
from semviz_core.simulation.layout import StreetOptions
from semviz_core.simulation.street import Street


class PaintedOnce(Street):
    """Remembers its pictures."""

    def __init__(self, seed: int, options: StreetOptions | None = None) -> None:
        super().__init__(seed, options)
        self._pictures = lru_cache(maxsize=64)(super().image)

    def image(self, index: int, side: Side) -> ByteImage:
        return self._pictures(index, side).copy()


@lru_cache(maxsize=8)
def street(seed: int, frames: int = StreetOptions.frames) -> PaintedOnce:
    """The same object for all tests; the same street as ``Street`` gives."""
    return PaintedOnce(seed, StreetOptions(frames))


def street_workspace(path: Path, seed: int, frames: int) -> Workspace:
    """A new workspace over ``street(seed, frames)``."""
    workspace = Workspace.create_street(path, seed, range(frames))
    vars(workspace)["source"] = street(seed, frames)  # a cached property
    return workspace
