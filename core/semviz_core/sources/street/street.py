"""A simulated street as a source of stereo images, with the truth about everything in them."""

from functools import lru_cache

import numpy as np

from semviz_core.arrays import ByteImage, FloatArray, IntArray
from semviz_core.camera import Camera, Rig
from semviz_core.classes import POLE
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.errors import SemvizError
from semviz_core.frame import Frame
from semviz_core.pose import Pose
from semviz_core.semantic_map import MapFrame, SemanticMap
from semviz_core.sources.source import Side
from semviz_core.sources.street.layout import Layout, StreetOptions, lay_out
from semviz_core.sources.street.painter import Painter
from semviz_core.sources.street.trajectory import drive
from semviz_core.sources.street.view import View
from semviz_core.sources.street.visibility import Painted, paint_ranks, visible_elements

BASELINE_M = 0.54
FRAME_RATE_HZ = 10.0
TRUTH_SIGMA_M = 0.005


class Street:
    """A street of our own, furnished and driven down at random; the same for the same seed."""

    def __init__(self, seed: int, options: StreetOptions | None = None) -> None:
        self.seed = seed
        self.options = options or StreetOptions()
        self.layout: Layout = lay_out(seed, self.options)
        self._map_frame = MapFrame(f"street-{seed}")
        self._rig = _rig()
        poses = drive(self.layout.road, self.options, seed)
        self._frames = tuple(Frame(i, i / FRAME_RATE_HZ, pose) for i, pose in enumerate(poses))
        self._painter = Painter(self.layout, seed)
        self.truth_map = _truth_map(self.layout, self._map_frame, poses)
        self._visible = lru_cache(maxsize=256)(self._look)
        self._painted = lru_cache(maxsize=2)(self._paint)

    @property
    def map_frame(self) -> MapFrame:
        return self._map_frame

    @property
    def rig(self) -> Rig:
        return self._rig

    @property
    def frames(self) -> tuple[Frame, ...]:
        return self._frames

    def image(self, index: int, side: Side) -> ByteImage:
        """(376, 1241, 3) sRGB of a frame; painted anew at each call."""
        return self._painter.paint(self.view(index, side))

    def labels(self, index: int, side: Side) -> tuple[Elements2D, IntArray]:
        """What is truly to be seen in an image, and its ids (m,) in ``truth_map``."""
        return self._visible(index, side)

    def painted(self, index: int, side: Side) -> Painted:
        """In which order what an image shows is painted: which pixels show what."""
        return self._painted(index, side)

    def distance_m(self, ids: IntArray, index: int, side: Side) -> FloatArray:
        """(k,) of elements of ``truth_map``, by id, from a camera, horizontally."""
        truth = self.truth_map.elements
        offset = truth.anchor_m[np.searchsorted(truth.id, ids)] - self.view(index, side).center_m
        return np.asarray(np.linalg.norm(offset[:, :2], axis=1))

    def view(self, index: int, side: Side) -> View:
        """One of a frame's cameras at its true place."""
        if not 0 <= index < len(self._frames):
            raise SemvizError(
                f"{self._map_frame.name} has no frame {index}; it has 0 to {len(self._frames) - 1}"
            )
        pose, rig = self._frames[index].T_map_camera, self._rig
        assert pose is not None  # a street knows the truth
        if side == "left" or rig.right is None or rig.T_right_left is None:
            return View(rig.left, pose)
        return View(rig.right, pose @ rig.T_right_left.inverse())

    def _look(self, index: int, side: Side) -> tuple[Elements2D, IntArray]:
        painted, view = self.painted(index, side), self.view(index, side)
        return visible_elements(painted, self.truth_map.elements, view)

    def _paint(self, index: int, side: Side) -> Painted:
        return paint_ranks(self.layout, self.view(index, side))


def _rig() -> Rig:
    """KITTI's colour cameras, idealized."""
    K = np.array([[718.856, 0.0, 607.1928], [0.0, 718.856, 185.2157], [0.0, 0.0, 1.0]])
    camera = Camera(1241, 376, K)
    return Rig(camera, camera, Pose(np.eye(3), np.array([-BASELINE_M, 0.0, 0.0])))


def _truth_map(layout: Layout, frame: MapFrame, poses: list[Pose]) -> SemanticMap:
    """Every element where it stands."""
    nothing = np.full(3, np.nan)
    rows = [(one.id, one.peak_m, one.bottom_m, POLE) for one in layout.poles]
    rows += [(one.id, one.middle_m, nothing, one.class_id) for one in layout.signs]
    ids, anchors, ends, classes = zip(*sorted(rows, key=lambda row: row[0]), strict=True)
    return SemanticMap(
        elements=Elements3D.from_ends(ids, anchors, ends, classes, sigma_m=TRUTH_SIGMA_M),
        frame=frame,
        trajectory_m=np.array([pose.translation for pose in poses]),
        made_by="simulated street, without errors",
    )
