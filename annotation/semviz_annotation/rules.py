"""What observations must be: of a known class, of its shape, inside their image."""

from dataclasses import dataclass

import numpy as np

from semviz_annotation.rows import LabelElement, Observation, Pixel
from semviz_core.camera import Camera, Rig
from semviz_core.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.errors import SemvizError
from semviz_core.sources.source import Side

MIN_LENGTH_PX = 0.5
"""A pole whose ends are nearer to each other than this has no direction."""


@dataclass(frozen=True, eq=False)
class Rules:
    """What observations are checked against."""

    classes: ClassSet = DEFAULT_CLASSES
    rig: Rig | None = None
    """Gives the size of each image; None accepts every pixel."""

    def check_class(self, element: LabelElement) -> LabelElement:
        """Return ``element``; raises SemvizError where its class is not known."""
        self.classes[element.class_id]
        return element

    def check(self, row: Observation, class_id: int) -> Observation:
        """Return ``row``; raises SemvizError where it is no observation of this class."""
        one = self.classes[class_id]
        if one.kind == "line" and row.end_px is None:
            raise SemvizError(f"a {one.name} needs two points: peak and bottom")
        if one.kind == "point" and row.end_px is not None:
            raise SemvizError(f"a {one.name} has one point, its middle, not two")
        for point in (row.anchor_px, row.end_px):
            if point is not None:
                self._check_inside(point, row.side)
        if row.end_px is not None and np.hypot(*np.subtract(row.anchor_px, row.end_px)) < (
            MIN_LENGTH_PX
        ):
            raise SemvizError("peak and bottom are the same point; click them apart")
        return row

    def camera(self, side: Side) -> Camera | None:
        """None where any camera will do; SemvizError where the sequence has none on this side."""
        if self.rig is None:
            return None
        camera = self.rig.left if side == "left" else self.rig.right
        if camera is None:
            raise SemvizError("this sequence has no right camera")
        return camera

    def _check_inside(self, point: Pixel, side: Side) -> None:
        if not np.isfinite(point).all():
            raise SemvizError("a point is not a number; nothing was changed")
        camera = self.camera(side)
        if camera is not None and not camera.contains(np.array([point]))[0]:
            raise SemvizError(
                f"point ({point[0]:.1f}, {point[1]:.1f}) is outside the {side} image "
                f"({camera.width}x{camera.height})"
            )
