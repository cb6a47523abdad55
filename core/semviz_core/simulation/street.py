"""A simulated street as a Dataset of stereo images, with its ground truth.

The camera drives in the right lane, with the deviations of the benchmark. Far objects are painted
first, near ones over them. Textures are made with the first image. The same seed gives the same
street.
"""

from dataclasses import replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from semviz_core.base.camera import Camera, Rig
from semviz_core.base.classes import NEW_CENTER, POLE, TRIANGULAR, TriangleCenter
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Frame, Side
from semviz_core.base.pose import Pose, so3_exp
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.common.arrays import BoolArray, ByteImage, FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.localizability.route import CAMERA_HEIGHT_M
from semviz_core.simulation import scenery
from semviz_core.simulation.drawing import PinholeView, fill_mask
from semviz_core.simulation.furniture import objects_far_to_near, paint_object, silhouette
from semviz_core.simulation.ground import GroundRenderer, shadows
from semviz_core.simulation.layout import (
    LANE_M,
    Layout,
    RoadGeometry,
    StreetOptions,
    lay_out_street,
)
from semviz_core.simulation.objects import Car, Color, Sign
from semviz_core.simulation.scenery import Scenery

NEAREST_M, FARTHEST_M = 3.0, 60.0
_SHORTEST_PX = 8.0
"""Poles with a shorter visible part are not labelled."""
LABEL_SIGMA_PX = 0.5
"""Error of a careful annotator's click; the labels themselves are exact."""


class _VisibleElement(NamedTuple):
    id: int
    class_id: int
    anchor_px: FloatArray
    end_px: FloatArray
    anchor_known: bool
    end_known: bool


class Painted(NamedTuple):
    """The order in which objects were painted."""

    order: NDArray[np.int32]
    """(height, width) rank of the object painted last."""
    ranks: dict[int, int]
    """Each element's rank, by its id."""


def elements_in_view(
    painted: Painted, truth: Elements3D, view: PinholeView
) -> tuple[Elements2D, IntArray]:
    """Return the elements that ``view`` shows of ``truth`` (n,), and their ids (m,).

    A point of an element is visible if nothing was painted over it later.
    """
    order, ranks = painted
    distance = np.linalg.norm((truth.anchor_m - view.center_m)[:, :2], axis=1)
    in_range = (distance > NEAREST_M) & (distance < FARTHEST_M)
    visible: list[_VisibleElement] = []
    for row in np.flatnonzero(in_range):
        rank = ranks.get(int(truth.id[row]))
        if rank is None:
            continue
        element = truth[[row]]
        measure = _visible_pole if element.is_line[0] else _visible_sign
        visible_element = measure(element, view, order, rank)
        if visible_element is not None:
            visible.append(visible_element)
    return _elements(visible)


def paint_ranks(layout: Layout, view: PinholeView) -> Painted:
    """Return the order in which the objects in ``view`` are painted."""
    order = np.zeros((view.camera.height, view.camera.width), np.int32)
    ranks: dict[int, int] = {}
    for rank, item in enumerate(objects_far_to_near(layout, view), start=1):
        for polygon in silhouette(item, view, layout.sun):
            fill_mask(order, polygon, rank)
        if not isinstance(item, Car):
            ranks[item.id] = rank
    return Painted(order, ranks)


def _visible_pole(
    pole: Elements3D, view: PinholeView, order: NDArray[np.int32], rank: int
) -> _VisibleElement | None:
    """Return a pole from the first to the last visible point of its axis; None if too short."""
    peak, bottom = view.project(np.concatenate([pole.anchor_m, pole.end_m]))
    count = int(np.ceil(np.linalg.norm(bottom - peak) * 2)) + 2
    points = peak + np.linspace(0.0, 1.0, count)[:, None] * (bottom - peak)
    visible = np.flatnonzero(_uncovered(points, view, order, rank))
    if not len(visible):
        return None
    first, last = visible[0], visible[-1]
    if np.linalg.norm(points[last] - points[first]) < _SHORTEST_PX:
        return None
    return _VisibleElement(
        int(pole.id[0]), POLE, points[first], points[last], first == 0, last == count - 1
    )


def _visible_sign(
    sign: Elements3D, view: PinholeView, order: NDArray[np.int32], rank: int
) -> _VisibleElement | None:
    """Return a sign if its centre is visible."""
    middle = view.project(sign.anchor_m)[0]
    if not _uncovered(middle[None], view, order, rank)[0]:
        return None
    return _VisibleElement(
        int(sign.id[0]), int(sign.class_id[0]), middle, np.full(2, np.nan), True, False
    )


def _uncovered(
    points_px: FloatArray, view: PinholeView, order: NDArray[np.int32], rank: int
) -> BoolArray:
    """Return (n,) whether points (n, 2) are in the image and not painted over."""
    inside = view.camera.contains(points_px)
    pixels = np.round(points_px[inside]).astype(int)
    visible = np.zeros(len(points_px), dtype=bool)
    visible[inside] = order[pixels[:, 1], pixels[:, 0]] <= rank
    return visible


def _elements(visible: list[_VisibleElement]) -> tuple[Elements2D, IntArray]:
    m = len(visible)
    elements = Elements2D(
        anchor_px=np.array([element.anchor_px for element in visible]).reshape(m, 2),
        end_px=np.array([element.end_px for element in visible]).reshape(m, 2),
        class_id=np.array([element.class_id for element in visible], dtype=np.int64),
        score=np.ones(m),
        sigma_px=np.full((m, 2), LABEL_SIGMA_PX),
        anchor_known=np.array([element.anchor_known for element in visible], dtype=bool),
        end_known=np.array([element.end_known for element in visible], dtype=bool),
    )
    return elements, np.array([element.id for element in visible], dtype=np.int64)


LATERAL_SIGMA_M = 0.3
HEIGHT_SIGMA_M = 0.03
YAW_SIGMA_RAD = float(np.deg2rad(3.0))
ATTITUDE_SIGMA_RAD = float(np.deg2rad(0.5))
_CORRELATION_M = 7.0
"""Correlation length of the driver's deviations."""


def camera_trajectory(road: RoadGeometry, options: StreetOptions, seed: int) -> list[Pose]:
    """Return the true ``T_map_camera`` of each frame, with the benchmark's deviations."""
    rng = np.random.default_rng([seed, 1])
    s: FloatArray = np.arange(options.frames, dtype=np.float64) * options.spacing_m
    sigmas = (LATERAL_SIGMA_M, HEIGHT_SIGMA_M, ATTITUDE_SIGMA_RAD, YAW_SIGMA_RAD)
    lateral, height, pitch, yaw = (sigma * _smooth_noise(rng, options) for sigma in sigmas)
    roll = ATTITUDE_SIGMA_RAD * _smooth_noise(rng, options)
    centers = road.at(s, lateral - LANE_M / 2, CAMERA_HEIGHT_M + height)
    headings = road.heading(s)
    grade = np.cos(headings) * road.slope[0] + np.sin(headings) * road.slope[1]
    turns = np.stack([np.arctan(grade) + pitch, yaw, roll], axis=1)
    return [
        Pose(camera_axes(float(heading)) @ so3_exp(turn), center)
        for heading, turn, center in zip(headings, turns, centers, strict=True)
    ]


def camera_axes(heading_rad: float) -> FloatArray:
    """Return the (3, 3) rotation of ``T_map_camera`` of a level camera with a heading."""
    sin, cos = np.sin(heading_rad), np.cos(heading_rad)
    return np.array([[sin, 0.0, cos], [-cos, 0.0, sin], [0.0, -1.0, 0.0]])


def _smooth_noise(rng: np.random.Generator, options: StreetOptions) -> FloatArray:
    """Return (frames,) smooth noise of standard deviation 1."""
    memory = _CORRELATION_M / options.spacing_m
    reach = int(np.ceil(3.0 * memory))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / memory) ** 2)
    kernel /= np.linalg.norm(kernel)
    white = rng.standard_normal(options.frames + 2 * reach)
    return np.convolve(white, kernel, mode="valid")


HAZE: Color = (206, 220, 232)
SHADOW_SIGHT_M = 80.0


class Painter:
    """Paints one street. Textures are made with the first image."""

    def __init__(self, layout: Layout, seed: int) -> None:
        self._layout = layout
        self._seed = seed

    def paint(self, view: PinholeView) -> ByteImage:
        """Return (height, width, 3) sRGB."""
        image = self._paint_sky(view)
        self._ground.paint(image, view, self._shadows_near(view), HAZE)
        self._scenery.paint(image, view)
        for item in objects_far_to_near(self._layout, view):
            paint_object(image, view, item, self._layout.sun, HAZE)
        return image

    @cached_property
    def _shadows(self) -> list[FloatArray]:
        return shadows(self._layout)

    @cached_property
    def _shadow_middles(self) -> FloatArray:
        return np.array([shadow.mean(axis=0) for shadow in self._shadows]).reshape(-1, 3)

    def _shadows_near(self, view: PinholeView) -> list[FloatArray]:
        distance = np.linalg.norm(self._shadow_middles - view.center_m, axis=1)
        return [self._shadows[row] for row in np.flatnonzero(distance < SHADOW_SIGHT_M)]

    @cached_property
    def _sky(self) -> ByteImage:
        return scenery.sky(np.random.default_rng([self._seed, 2]), HAZE)

    @cached_property
    def _ground(self) -> GroundRenderer:
        return GroundRenderer(self._layout.road, np.random.default_rng([self._seed, 3]))

    @cached_property
    def _scenery(self) -> Scenery:
        return Scenery(self._layout, np.random.default_rng([self._seed, 4]), HAZE)

    def _paint_sky(self, view: PinholeView) -> ByteImage:
        """Return an image of the sky: the panorama in the direction of each pixel's ray."""
        x, y, z = (view.rays(axis) for axis in np.eye(3))
        level, azimuth = cv2.cartToPolar(x, y)
        low, high = scenery.SKY_ELEVATION_RAD
        height, width = self._sky.shape[:2]
        column = azimuth * np.float32(width / (2.0 * np.pi))
        row = (np.float32(high) - np.arctan(z / level)) * np.float32((height - 1) / (high - low))
        row = np.clip(row, 0.0, height - 1.0)
        sky = cv2.remap(self._sky, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        return np.asarray(sky, dtype=np.uint8)


BASELINE_M = 0.54
FRAME_RATE_HZ = 10.0
TRUTH_SIGMA_M = 0.005


class Street:
    """A simulated street with random layout and trajectory; the same for the same seed."""

    def __init__(
        self,
        seed: int,
        options: StreetOptions | None = None,
        triangle_center: TriangleCenter = NEW_CENTER,
    ) -> None:
        self.seed = seed
        self.options = options or StreetOptions()
        self.triangle_center: TriangleCenter = triangle_center
        self.layout: Layout = lay_out_street(seed, self.options)
        self._map_frame = MapFrame(f"street-{seed}")
        self._rig = _rig()
        poses = camera_trajectory(self.layout.road, self.options, seed)
        self._frames = tuple(Frame(i, i / FRAME_RATE_HZ, pose) for i, pose in enumerate(poses))
        self._painter = Painter(self.layout, seed)
        self.truth_map = _truth_map(self.layout, self._map_frame, poses, triangle_center)
        self._triangles = {
            sign.id: np.array([sign.middle_m, _centroid_m(sign)])
            for sign in self.layout.signs
            if sign.class_id == TRIANGULAR
        }
        self._visible = lru_cache(maxsize=256)(self._compute_visible)
        self._painted = lru_cache(maxsize=2)(self._paint_ranks)

    @property
    def map_frame(self) -> MapFrame:
        return self._map_frame

    @property
    def rig(self) -> Rig:
        return self._rig

    @property
    def frames(self) -> tuple[Frame, ...]:
        return self._frames

    def following(self, triangle_center: TriangleCenter) -> "Street":
        """Return the same street with this middle of triangular signs in its truth."""
        if triangle_center == self.triangle_center:
            return self
        return Street(self.seed, self.options, triangle_center)

    def image(self, index: int, side: Side) -> ByteImage:
        """Return (376, 1241, 3) sRGB of a frame; painted at each call."""
        return self._painter.paint(self.view(index, side))

    def labels(self, index: int, side: Side) -> tuple[Elements2D, IntArray]:
        """Return the elements visible in an image, and their ids (m,) in ``truth_map``."""
        return self._visible(index, side)

    def painted(self, index: int, side: Side) -> Painted:
        """Return the order of painting of an image, which tells which pixels show which object."""
        return self._painted(index, side)

    def distance_m(self, ids: IntArray, index: int, side: Side) -> FloatArray:
        """Return (k,) horizontal distances of elements of ``truth_map``, by id, from a camera."""
        truth = self.truth_map.elements
        offset = truth.anchor_m[np.searchsorted(truth.id, ids)] - self.view(index, side).center_m
        return np.asarray(np.linalg.norm(offset[:, :2], axis=1))

    def view(self, index: int, side: Side) -> PinholeView:
        """Return one of a frame's cameras at its true pose."""
        if not 0 <= index < len(self._frames):
            raise SemvizError(
                f"{self._map_frame.name} has no frame {index}; give 0 to {len(self._frames) - 1}"
            )
        pose, rig = self._frames[index].T_map_camera, self._rig
        assert pose is not None  # a street knows the truth
        if side == "left" or rig.right is None or rig.T_right_left is None:
            return PinholeView(rig.left, pose)
        return PinholeView(rig.right, pose @ rig.T_right_left.inverse())

    def _compute_visible(self, index: int, side: Side) -> tuple[Elements2D, IntArray]:
        painted, view = self.painted(index, side), self.view(index, side)
        elements, ids = elements_in_view(painted, self.truth_map.elements, view)
        shift = np.full(len(ids), np.nan)
        for row, id_ in enumerate(ids.tolist()):
            if id_ in self._triangles:
                box, centroid = view.project(self._triangles[id_])
                shift[row] = centroid[1] - box[1]
        return replace(elements, to_centroid_px=shift), ids

    def _paint_ranks(self, index: int, side: Side) -> Painted:
        return paint_ranks(self.layout, self.view(index, side))


def _rig() -> Rig:
    """KITTI's colour cameras, idealized."""
    K = np.array([[718.856, 0.0, 607.1928], [0.0, 718.856, 185.2157], [0.0, 0.0, 1.0]])
    camera = Camera(1241, 376, K)
    return Rig(camera, camera, Pose(np.eye(3), np.array([-BASELINE_M, 0.0, 0.0])))


def _centroid_m(sign: Sign) -> FloatArray:
    """Return the centroid (3,) of an upright triangle's corners."""
    return np.asarray(sign.middle_m - sign.up_m / 3.0)


def _truth_map(
    layout: Layout, frame: MapFrame, poses: list[Pose], triangle_center: TriangleCenter
) -> SemanticMap:
    """Return the map of all elements without errors."""

    def middle_m(sign: Sign) -> FloatArray:
        by_box = sign.class_id != TRIANGULAR or triangle_center == "box"
        return sign.middle_m if by_box else _centroid_m(sign)

    nothing = np.full(3, np.nan)
    rows = [(pole.id, pole.peak_m, pole.bottom_m, POLE) for pole in layout.poles]
    rows += [(sign.id, middle_m(sign), nothing, sign.class_id) for sign in layout.signs]
    ids, anchors, ends, classes = zip(*sorted(rows, key=lambda row: row[0]), strict=True)
    return SemanticMap(
        elements=Elements3D.from_ends(ids, anchors, ends, classes, sigma_m=TRUTH_SIGMA_M),
        frame=frame,
        trajectory_m=np.array([pose.translation for pose in poses]),
        made_by="simulated street, without errors",
        triangle_center=triangle_center,
    )
