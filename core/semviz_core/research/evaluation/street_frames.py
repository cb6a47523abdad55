"""Street frames with a picture and a cloud, for methods that match pixels with scans.

A street was mapped on another day: other cars were parked, and seven scans of that drive make the
cloud around the fix. Elements are as the simulated detector sees them, and as mapped with errors.
Frames are picked, as the paper's are, by the number of elements that they show within 20 m.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.detector_model import NoiseName
from semviz_core.base.frame import Prior
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, ByteImage, FloatArray, IntArray
from semviz_core.datasets.priors import PriorOptions, simulate_prior
from semviz_core.research.evaluation.problems import (
    CAMERA,
    PAPER_20M,
    LocalizationProblem,
)
from semviz_core.research.evaluation.roads import with_errors
from semviz_core.simulation.detector import Detection, SimulatedDetector
from semviz_core.simulation.layout import StreetOptions, with_other_cars
from semviz_core.simulation.lidar import merged, scan
from semviz_core.simulation.street import Street, camera_trajectory

OPTIONS = StreetOptions(frames=80)
FIRST_FRAME, LAST_FRAME = 18, 62
"""Frames with three scans before and after them."""
SCAN_EVERY, SCANS = 6, 7
"""Metres between scans, and their number in a cloud, as published for DeepI2P."""
CLOUD_M = 40.0
"""Reach of a cloud around the fix."""
FRAMES_A_STREET = 2
LEAST_SEEN = 6
"""Detections of a frame. About four of them are true and mapped, as all of the paper's four are."""
_TOP, _BOTTOM = 50, 360
"""Rows of the image that the picture shows; DeepI2P leaves out the same above."""
PICTURE_PX = (640, 160)
PRIOR = PriorOptions(distance_m=PAPER_20M.gps_distance_m, vertical_sigma_m=0.06)
_ANOTHER_DAY = 1_000_000_007
_SAME_M = 1.0
"""Elements of one class stand further apart, and moved ones are 8 m off."""


def _picture_camera() -> Camera:
    scale = np.array([PICTURE_PX[0] / CAMERA.width, PICTURE_PX[1] / (_BOTTOM - _TOP)])
    K = CAMERA.K.copy()
    K[:2, 2] = (K[:2, 2] - (0.0, _TOP) + 0.5) * scale - 0.5
    K[[0, 1], [0, 1]] *= scale
    return Camera(*PICTURE_PX, K)


PICTURE_CAMERA = _picture_camera()


CELL_PX = 32
COLUMNS, ROWS = PICTURE_PX[0] // CELL_PX, PICTURE_PX[1] // CELL_PX
"""DeepI2P divides a picture into cells."""
NEAREST_M = 0.1


def seen_in_picture(place_m: FloatArray) -> tuple[BoolArray, FloatArray]:
    """Return which points (n, 3) in camera axes are inside the picture, hidden or not, and their
    pixels (n, 2)."""
    pixel = PICTURE_CAMERA.project(place_m)
    return (place_m[:, 2] > NEAREST_M) & PICTURE_CAMERA.contains(pixel), pixel


def cells(pixel: FloatArray, inside: BoolArray) -> IntArray:
    """Return (n,) the cells of pixels (n, 2); 0 outside."""
    column, row = np.where(inside[:, None], (pixel + 0.5) // CELL_PX, 0.0).T.astype(int)
    return np.asarray(row.clip(max=ROWS - 1) * COLUMNS + column.clip(max=COLUMNS - 1))


def cell_centers(cell: IntArray) -> FloatArray:
    """Return the pixels (n, 2) in the middle of cells (n,)."""
    corner = np.stack([cell % COLUMNS, cell // COLUMNS], axis=1) * CELL_PX
    return np.asarray(corner + 0.5 * (CELL_PX - 1), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class StreetProblem(LocalizationProblem):
    """A problem with a picture and a cloud in place of elements, for methods that need them."""

    picture: ByteImage
    """(160, 640, 3) sRGB, seen by ``PICTURE_CAMERA``."""
    cloud: FloatArray
    """(n, 7) in the map frame: point (m), intensity, unit normal."""


class MappedStreet:
    """A street, and the scans of an earlier drive."""

    def __init__(self, seed: int) -> None:
        self.street = Street(seed, OPTIONS)
        layout, earlier = self.street.layout, seed + _ANOTHER_DAY
        self._earlier = with_other_cars(layout, OPTIONS, earlier)
        drive = camera_trajectory(layout.road, OPTIONS, earlier)
        self.drive_m = np.array([pose.translation for pose in drive])
        self._scanners = drive[::SCAN_EVERY]
        self._scan = lru_cache(maxsize=None)(self._make_scan)

    def picture(self, index: int) -> ByteImage:
        """Return (160, 640, 3) of a frame."""
        image = self.street.image(index, "left")[_TOP:_BOTTOM]
        return np.asarray(cv2.resize(image, PICTURE_PX, interpolation=cv2.INTER_AREA), np.uint8)

    def cloud(self, position_m: FloatArray, reach_m: float = CLOUD_M) -> FloatArray:
        """Return the cloud (n, 7) around a position (3,), from the scans next to it."""
        centers = np.array([pose.translation for pose in self._scanners])
        order = np.argsort(np.linalg.norm(centers - position_m, axis=1))
        cloud = merged([self._scan(int(number)) for number in order[:SCANS]])
        near = np.linalg.norm(cloud[:, :2] - position_m[:2], axis=1) < reach_m
        return np.asarray(cloud[near])

    def pose(self, index: int) -> Pose:
        """Return the true T_map_camera of a frame."""
        pose = self.street.frames[index].T_map_camera
        assert pose is not None  # a street knows the truth
        return pose

    def prior(self, index: int, seed: int) -> Prior:
        """Return what the car knows: a fix within 5 m, gravity, the height of the mapped road."""
        prior = simulate_prior(self.pose(index), PRIOR, [seed, 8])
        x, y, _ = prior.position_m
        nearest = np.linalg.norm(self.drive_m[:, :2] - (x, y), axis=1).argmin()
        position = np.array([x, y, self.drive_m[nearest, 2]])
        return replace(prior, position_m=position, road_m=self.drive_m)

    def _make_scan(self, number: int) -> FloatArray:
        rng = np.random.default_rng([self.street.seed, 7, number])
        return scan(self._earlier, self._scanners[number], rng)


@lru_cache(maxsize=16)
def street_problem(seed: int, noise: NoiseName) -> StreetProblem:
    """Return a frame of the street ``seed // FRAMES_A_STREET``: the first drawn that shows
    ``LEAST_SEEN`` elements within 20 m, or else the one that shows most."""
    world = _world(seed // FRAMES_A_STREET)
    detector = SimulatedDetector(world.street, noise, seed)
    frames = np.random.default_rng([seed, 9]).permutation(np.arange(FIRST_FRAME, LAST_FRAME))
    shown: dict[int, Detection] = {}
    for index in frames.tolist():
        shown[index] = _within_reach(detector.detect(index), world, index)
        if len(shown[index].observed) >= LEAST_SEEN:
            break
    index = max(shown, key=lambda index: len(shown[index].observed))
    detection = shown[index]
    prior = world.prior(index, seed)
    mapped = with_errors(world.street.truth_map, seed // FRAMES_A_STREET).elements
    offset = np.linalg.norm(mapped.anchor_m[:, :2] - prior.position_m[:2], axis=1)
    submap = mapped[np.flatnonzero(offset < PAPER_20M.crop_m)]
    true = _true_anchors(world, detection.element_id)
    same = detection.observed.class_id[:, None] == submap.class_id
    same &= np.linalg.norm(true[:, None] - submap.anchor_m, axis=2) < _SAME_M
    return StreetProblem(
        observed=detection.observed,
        submap=submap,
        camera=CAMERA,
        prior=prior,
        T_camera_map=world.pose(index).inverse(),
        pairs=np.argwhere(same),
        end_visible=detection.observed.end_known,
        picture=world.picture(index),
        cloud=world.cloud(prior.position_m),
    )


@lru_cache(maxsize=2)
def _world(seed: int) -> MappedStreet:
    return MappedStreet(seed)


def _within_reach(detection: Detection, world: MappedStreet, index: int) -> Detection:
    """Return the detections within 20 m of the camera, and the false ones."""
    kept: BoolArray = detection.element_id < 0
    true = ~kept
    distance = world.street.distance_m(detection.element_id[true], index, "left")
    kept[true] = distance < PAPER_20M.seen_within_m
    return Detection(detection.observed[kept], detection.element_id[kept])


def _true_anchors(world: MappedStreet, element_id: IntArray) -> FloatArray:
    """Return (m, 3) true anchors; infinite for false detections."""
    truth = world.street.truth_map.elements
    anchors = np.full((len(element_id), 3), np.inf)
    true = element_id >= 0
    anchors[true] = truth.anchor_m[np.searchsorted(truth.id, element_id[true])]
    return anchors
