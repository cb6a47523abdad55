"""Drives with truth for the benches: simulated streets, and KITTI odometry 02 with our own labels.

The truth of KITTI 02 are the labels of docs/kitti02, each measured in its own image. Its images are
not part of the project: give their folder as ``--kitti`` or in SEMVIZ_KITTI.
"""

import tempfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np

from semviz.workspace.workspace import Workspace
from semviz_annotation.assist.expected_position import expected_px
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.views import PosedView, rig_view
from semviz_annotation.mapping.placement.triangulation import (
    Triangulated,
    TriangulationFailure,
    triangulate,
)
from semviz_annotation.storage.backup import import_operations
from semviz_core.base.camera import Camera
from semviz_core.base.elements import Elements2D
from semviz_core.base.frame import Dataset, Side
from semviz_core.simulation.street import Street

SIDES: tuple[Side, Side] = ("left", "right")
KITTI_LABELS = Path(__file__).parents[1] / "docs" / "kitti02" / "labels.jsonl"
MEASURED = 809
"""Operations whose labels were measured in each image; later ones were carried by triangulation."""
KITTI_FRAMES = range(20)

Seen = tuple[np.ndarray, np.ndarray, int, tuple[bool, bool]]
"""Anchor, end (NaN for signs), class, and which ends are known."""


class Drive(Protocol):
    """Frames of stereo images with what they truly show."""

    @property
    def source(self) -> Dataset: ...

    @property
    def tells_hidden(self) -> bool:
        """Whether an end that is not known is hidden; otherwise nobody said where it is."""
        ...

    def seen(self, frame: int, side: Side) -> dict[int, Seen]:
        """What is visible in an image, by element."""
        ...

    def known(self, frame: int, side: Side) -> dict[int, Seen]:
        """The same, with what is there but was not measured: it is right, but not missed."""
        ...

    def depths_m(self, frame: int) -> dict[int, float]:
        """Depths of all elements in the left camera."""
        ...


@dataclass(frozen=True, eq=False)
class StreetDrive:
    """A simulated street."""

    street: Street
    tells_hidden = True

    @property
    def source(self) -> Dataset:
        return self.street

    def seen(self, frame: int, side: Side) -> dict[int, Seen]:
        return by_id(*self.street.labels(frame, side))

    def known(self, frame: int, side: Side) -> dict[int, Seen]:
        return self.seen(frame, side)

    def depths_m(self, frame: int) -> dict[int, float]:
        elements = self.street.truth_map.elements
        depths = view_of(self.street, frame, "left").depth_m(elements.anchor_m)
        return dict(zip(elements.id.tolist(), depths.tolist(), strict=True))


def by_id(seen: Elements2D, ids: np.ndarray) -> dict[int, Seen]:
    known = zip(seen.anchor_known.tolist(), seen.end_known.tolist(), strict=True)
    rows = zip(seen.anchor_px, seen.end_px, seen.class_id.tolist(), known, strict=True)
    return dict(zip(ids.tolist(), rows, strict=True))


@dataclass(frozen=True, eq=False)
class KittiDrive:
    """The 20 frames of KITTI 02 that are labelled."""

    source: Dataset
    labels: Labels
    completed: Labels
    """With those that were carried by triangulation."""
    tells_hidden = False

    @classmethod
    def of(cls, kitti: Path) -> "KittiDrive":
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "truth"
            workspace = Workspace.create_kitti(path, kitti, "02", (2, 3), KITTI_FRAMES)
            with workspace.open_labels() as store:
                import_operations(KITTI_LABELS, store)
                completed = store.labels
                store.restore(MEASURED, "bench")
                return cls(workspace.source, store.labels, completed)

    def seen(self, frame: int, side: Side) -> dict[int, Seen]:
        return labelled(self.labels, frame, side)

    def known(self, frame: int, side: Side) -> dict[int, Seen]:
        """Where nobody labelled an element, it is where all labels together put it."""
        view = view_of(self.source, frame, side)
        placed: dict[int, Seen] = {}
        for element, position in self._positions.items():
            ends = expected_px(position, view)
            if ends is not None:
                end = ends[1] if position.is_line else np.full(2, np.nan)
                class_id = self._class_ids[element]
                placed[element] = ends[0], end, class_id, (False, False)
        return placed | labelled(self.completed, frame, side) | self.seen(frame, side)

    @cached_property
    def _class_ids(self) -> dict[int, int]:
        return {each.number: each.class_id for each in self.completed.elements.values()}

    @cached_property
    def _positions(self) -> dict[int, Triangulated]:
        positions = {}
        for element in self.completed.elements.values():
            rows = self.completed.of_element(element.id)
            views = [view_of(self.source, row.frame_index, row.side) for row in rows]
            position = triangulate(views, rows)
            if not isinstance(position, TriangulationFailure):
                positions[element.number] = position
        return positions

    def depths_m(self, frame: int) -> dict[int, float]:
        view = view_of(self.source, frame, "left")
        return {
            element: float(view.depth_m(position.anchor_m[None])[0])
            for element, position in self._positions.items()
        }


def labelled(labels: Labels, frame: int, side: Side) -> dict[int, Seen]:
    return {
        labels.element(row.element_id).number: (
            np.array(row.anchor_px),
            np.array(row.end_px or (np.nan, np.nan)),
            labels.element(row.element_id).class_id,
            (row.anchor_known, row.end_known),
        )
        for row in labels.in_frame(frame, side)
    }


def view_of(source: Dataset, frame: int, side: Side) -> PosedView:
    """The camera of an image at its given pose."""
    pose = source.frames[frame].T_map_camera
    assert pose is not None
    return rig_view(source.rig, side, pose.inverse())


def focal_px(camera: Camera) -> float:
    return float(camera.K[0, 0])
