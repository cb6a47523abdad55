"""Simulated streets whose pictures are painted once for all tests.

The first picture of a street costs most of a second: its textures are made then.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

import pytest

from semviz.workspace.settings import StreetSettings
from semviz.workspace.workspace import Workspace
from semviz_core.base.frame import Side
from semviz_core.common.arrays import ByteImage
from semviz_core.simulation.layout import StreetOptions
from semviz_core.simulation.street import Street


class PaintedOnce(Street):
    """Remembers its pictures."""

    def __init__(self, seed: int, options: StreetOptions | None = None) -> None:
        super().__init__(seed, options)
        self._pictures = lru_cache(maxsize=48)(super().image)

    def image(self, index: int, side: Side) -> ByteImage:
        return self._pictures(index, side).copy()


@lru_cache(maxsize=8)
def painted_once(seed: int, options: StreetOptions) -> PaintedOnce:
    """The same object for all tests; the same street as ``Street`` gives."""
    return PaintedOnce(seed, options)


def street(seed: int, frames: int = StreetOptions.frames) -> PaintedOnce:
    return painted_once(seed, StreetOptions(frames))


def street_workspace(path: Path, seed: int, frames: int) -> Workspace:
    """A new workspace over ``street(seed, frames)``."""
    return Workspace.create_street(path, seed, range(frames))


@contextmanager
def streets_painted_once() -> Iterator[None]:
    """Within it, all workspaces of one street share its pictures."""
    open_street = Workspace._open_street

    def open_shared(workspace: Workspace, settings: StreetSettings) -> PaintedOnce:
        opened = open_street(workspace, settings)
        assert isinstance(opened, Street)
        return painted_once(opened.seed, opened.options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Workspace, "_open_street", open_shared)
        yield
