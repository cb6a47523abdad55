"""A small world with exact labels, and random edits."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from semviz_annotation.labels.labels import LabelElement, Labels, Observation, new_id
from semviz_annotation.labels.views import rig_view
from semviz_annotation.storage.store import LabelStore
from semviz_core.base.camera import Camera, Rig
from semviz_core.base.frame import Frame, Side
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame
from semviz_core.common.arrays import ByteImage, FloatArray

K = np.array([[720.0, 0.0, 610.0], [0.0, 720.0, 180.0], [0.0, 0.0, 1.0]])
BASE = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Camera axes (x right, y down, z forward) in a map with x forward and z up."""


@dataclass(frozen=True, eq=False)
class World:
    """A straight drive past given poles and signs; a ``Source`` without images."""

    landmarks: dict[int, tuple[int, FloatArray, FloatArray | None]]
    """Number -> class, anchor (3,), end (3,) or None."""
    rig: Rig = field(
        default_factory=lambda: Rig(
            Camera(1241, 376, K), Camera(1241, 376, K), Pose(np.eye(3), np.array([-0.54, 0.0, 0.0]))
        )
    )
    count: int = 5
    map_frame: MapFrame = field(default_factory=lambda: MapFrame("world"))

    @property
    def frames(self) -> tuple[Frame, ...]:
        return tuple(
            Frame(i, 0.1 * i, Pose(BASE, np.array([2.0 * i, 0.0, 1.65]))) for i in range(self.count)
        )

    def image(self, index: int, side: Side) -> ByteImage:
        raise NotImplementedError

    def labels(self, sigma_px: float = 0.0, seed: int = 0) -> Labels:
        """Every landmark that is in an image, labelled there."""
        rng = np.random.default_rng(seed)
        elements = {
            n: LabelElement(new_id(), n, kind) for n, (kind, _, _) in self.landmarks.items()
        }
        rows: list[LabelElement | Observation] = []
        for frame in self.frames:
            assert frame.T_map_camera is not None
            for side in ("left", "right"):
                view = rig_view(self.rig, side, frame.T_map_camera.inverse())
                for number, (_, anchor, end) in self.landmarks.items():
                    pixels = view.project(np.stack([anchor, anchor if end is None else end]))
                    pixels = pixels + rng.normal(0.0, 1.0, (2, 2)) * sigma_px
                    if not view.camera.contains(pixels).all():
                        continue
                    a, b = (tuple(map(float, px)) for px in pixels)
                    rows.append(
                        Observation(
                            id=new_id(),
                            element_id=elements[number].id,
                            frame_index=frame.index,
                            side=side,
                            anchor_px=a,
                            end_px=None if end is None else b,
                            anchor_known=True,
                            end_known=end is not None,
                        )
                    )
        seen = {row.element_id for row in rows if isinstance(row, Observation)}
        return Labels.from_rows(
            [element for element in elements.values() if element.id in seen] + rows
        )


@pytest.fixture
def world() -> World:
    """Two poles and two signs of different classes, well apart."""
    return World(
        {
            3: (0, np.array([20.0, 5.0, 4.0]), np.array([20.0, 5.02, 0.4])),
            4: (0, np.array([25.0, -6.0, 5.0]), np.array([25.1, -6.0, 0.5])),
            7: (1, np.array([22.0, -4.0, 2.4]), None),
            9: (3, np.array([18.0, 3.5, 2.2]), None),
        }
    )


@pytest.fixture
def make_world() -> type[World]:
    return World


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "labels.db"


@pytest.fixture
def store(path: Path) -> LabelStore:
    return LabelStore.open(path)
