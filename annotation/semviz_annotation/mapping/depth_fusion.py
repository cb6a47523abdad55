"""Dense depth of stereo pairs, and its fusion into one thinned cloud of coloured points.

Pairs are matched semi-globally (Hirschmüller 2008), with OpenCV. A depth is kept only where left
and right agree, the match is clearly the best of its row, and the depth lies within limits: its
standard deviation grows with its square. Near the border of what is matched it needs texture, too;
otherwise poles and trees would wear a halo of sky.

In the cloud, a depth counts if the frame before or after measures the same surface, and neither
looks through it: that leaves out most false matches and what moves. The cloud is averaged over a
voxel grid, which grows until there are no more points than allowed; then isolated points are
removed. Only this needs open3d, and only while it runs.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from semviz_core.base.camera import Camera, Rig
from semviz_core.base.frame import Dataset, Frame
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, ByteImage, FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.progress import OnProgress, unwatched

DepthImage = NDArray[np.float32]
"""(height, width) depth along the optical axis of the left camera, metres; NaN if unknown."""

NEAREST_M = 4.0
"""Nearer surfaces are not matched. The road enters KITTI's images at 6 m."""
BLOCK_PX = 5
_MATCHING: Mapping[str, int] = {
    "P1": 8 * BLOCK_PX**2,
    "P2": 32 * BLOCK_PX**2,
    "disp12MaxDiff": 1,
    "uniquenessRatio": 10,
    "speckleWindowSize": 120,
    "speckleRange": 1,
    "preFilterCap": 31,
}
_TEXTURE = 1.5
"""Least horizontal gradient near a depth at a border, in shades of 255 per pixel."""
_BORDER_PX = 17
"""Width of the window in which all pixels must have a depth where there is no texture."""
_STEPS_PER_PX = 16.0
"""OpenCV's disparities are whole numbers of sixteenths of a pixel."""
_LARGEST_OFFSET_PX = 1.0
"""Rows of a rectified pair differ by less, at ``NEAREST_M``."""


class StereoDepth:
    """Depths of one rig's images, up to ``farthest_m``.

    Raises SemvizError for a rig with one camera, and for one whose images are not rectified.
    """

    def __init__(self, rig: Rig, farthest_m: float) -> None:
        if rig.right is None or rig.T_right_left is None:
            raise SemvizError("one camera: stereo depth needs a left and a right camera")
        K, K_right = rig.left.K, rig.right.K
        self.length_px = float(K[0, 0])
        """Focal length."""
        self.baseline_m = -float(rig.T_right_left.translation[0])
        self._farthest_m = farthest_m
        self._offset_px = float(K[0, 2] - K_right[0, 2])
        """Disparity at infinity."""
        down_m = abs(float(rig.T_right_left.translation[1]))
        rows_px = abs(K[1, 2] - K_right[1, 2]) + self.length_px * down_m / NEAREST_M
        if (
            rig.left.distortion.any()
            or rig.right.distortion.any()
            or rows_px > _LARGEST_OFFSET_PX
            or not np.allclose(K[:2, :2], K_right[:2, :2], rtol=1e-4)
            or not np.allclose(rig.T_right_left.rotation, np.eye(3), atol=1e-4)
        ):
            raise SemvizError("the stereo images are not rectified; rectify them first")

    def disparity_px(self, depth_m: DepthImage) -> DepthImage:
        """Return the disparities of depths, without that of infinity."""
        return np.asarray(self.length_px * self.baseline_m / depth_m, dtype=np.float32)

    def depth_m(self, left: ByteImage, right: ByteImage) -> DepthImage:
        """Return the depth of each pixel of the left image; both are (height, width, 3) sRGB."""
        grey, grey_right = _grey(left), _grey(right)
        steps = self._matcher.compute(grey, grey_right)
        disparity = steps.astype(np.float32) / _STEPS_PER_PX - np.float32(self._offset_px)
        least_px = self.length_px * self.baseline_m / self._farthest_m
        is_matched = (steps >= 0) & (disparity >= least_px)
        disparity[~(is_matched & (_inside(is_matched) | _is_textured(grey)))] = np.nan
        return np.asarray(self.length_px * self.baseline_m / disparity, dtype=np.float32)

    @cached_property
    def _matcher(self) -> Any:
        largest_px = self.length_px * self.baseline_m / NEAREST_M + max(self._offset_px, 0.0)
        return cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=16 * int(np.ceil(largest_px / 16.0)),
            blockSize=BLOCK_PX,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
            **_MATCHING,
        )


def _grey(image: ByteImage) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def _inside(is_matched: BoolArray) -> BoolArray:
    """Return the pixels around which all are matched; beyond the image's border all are."""
    window = np.ones((_BORDER_PX, _BORDER_PX), np.uint8)
    return np.asarray(cv2.erode(is_matched.view(np.uint8), window) > 0)


def _is_textured(grey: NDArray[np.uint8]) -> BoolArray:
    """Return the pixels near which the image changes along its rows: there a match is unique."""
    gradient = np.abs(cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=3, scale=0.125))
    largest = cv2.dilate(gradient, np.ones((BLOCK_PX, BLOCK_PX), np.uint8))
    return np.asarray(largest >= _TEXTURE)


STEP_M = 0.5
"""Frames nearer to the one before add nothing."""
EVERY_PX = 2
"""Of so many columns, and rows, one is back-projected."""
AGREE_PX = 1.0
"""Depths of two frames agree if their disparities differ by less."""
NEIGHBOURS, SPREAD = 16, 2.0
"""A point is isolated if its mean distance to so many neighbours is so many standard deviations
above the average."""
BUFFER, KEPT = 2_000_000, 4_000_000
"""Points that wait to be thinned, and that are kept while more frames come."""
GROWTH = 1.08
"""Least factor by which voxels grow where there are too many points."""


@dataclass(frozen=True)
class FusionOptions:
    """How far to trust depths, and how dense the cloud is."""

    farthest_m: float = 25.0
    """Larger depths are left out. On KITTI, half a pixel of disparity is 0.8 m here."""
    voxel_m: float = 0.05
    max_points: int = 400_000

    def __post_init__(self) -> None:
        if not 5.0 <= self.farthest_m <= 200.0:
            raise SemvizError(f"depth limit {self.farthest_m:g} m; give 5 to 200")
        if not 0.01 <= self.voxel_m <= 10.0:
            raise SemvizError(f"voxel of {self.voxel_m:g} m; give 0.01 to 10")
        if not 1000 <= self.max_points <= 20_000_000:
            raise SemvizError(f"{self.max_points} points; give 1000 to 20000000")


class Cloud(NamedTuple):
    """Points (n, 3) in the map frame, metres, and their colours (n, 3) sRGB from 0 to 1."""

    points_m: FloatArray
    colors: FloatArray
    voxel_m: float = 0.0
    """Size of the voxels over which they were averaged; 0 if they were not."""


def chosen_frames(frames: Sequence[Frame]) -> tuple[Frame, ...]:
    """Return the frames with a pose, each at least ``STEP_M`` from the one before.

    SemvizError for fewer than two: depths are compared between frames.
    """
    chosen: list[Frame] = []
    last: FloatArray | None = None
    for frame in frames:
        pose = frame.T_map_camera
        if pose is None or (last is not None and np.linalg.norm(pose.translation - last) < STEP_M):
            continue
        chosen.append(frame)
        last = pose.translation
    if len(chosen) < 2:
        raise SemvizError(
            f"{len(chosen)} frames with poses {STEP_M:g} m apart; a backdrop needs 2 or more"
        )
    return tuple(chosen)


def fuse(
    source: Dataset,
    frames: Sequence[Frame],
    options: FusionOptions,
    on_progress: OnProgress = unwatched,
) -> Cloud:
    """Return the cloud of ``frames`` of ``source``, which ``chosen_frames`` chose.

    The same frames and options give the same cloud. Raises SemvizError where the rig has one
    camera or is not rectified, an image is missing, open3d cannot be imported, or no depth is
    confirmed.
    """
    stereo = StereoDepth(source.rig, options.farthest_m)
    _open3d()  # before minutes of work
    thinner = _Thinner(options)
    for done, cloud in enumerate(_clouds(source, frames, stereo)):
        on_progress("matching", done, len(frames))
        thinner.add(cloud)
    on_progress("matching", len(frames), len(frames))
    cloud = thinner.finish(on_progress)
    if not len(cloud.points_m):
        raise SemvizError("no depth was confirmed by another frame; check poses and calibration")
    return cloud


# -- back-projection


class _Depth(NamedTuple):
    """One frame with its depths."""

    T_map_camera: Pose
    image: ByteImage
    depth_m: DepthImage


def _clouds(source: Dataset, frames: Sequence[Frame], stereo: StereoDepth) -> Iterator[Cloud]:
    """Yield the confirmed points of each frame, in order; three frames are in memory at a time."""
    before: _Depth | None = None
    now = _matched(source, frames[0], stereo)
    for row in range(len(frames)):
        after = _matched(source, frames[row + 1], stereo) if row + 1 < len(frames) else None
        others = [frame for frame in (before, after) if frame is not None]
        yield _confirmed(now, others, source.rig.left, stereo)
        if after is not None:
            before, now = now, after


def _matched(source: Dataset, frame: Frame, stereo: StereoDepth) -> _Depth:
    assert frame.T_map_camera is not None  # chosen_frames leaves out the others
    left, right = source.image(frame.index, "left"), source.image(frame.index, "right")
    return _Depth(frame.T_map_camera, left, stereo.depth_m(left, right))


def _confirmed(now: _Depth, others: Sequence[_Depth], camera: Camera, stereo: StereoDepth) -> Cloud:
    """Return the points of ``now`` that another frame sees, and none sees through."""
    depth = now.depth_m[::EVERY_PX, ::EVERY_PX]
    rows, columns = np.nonzero(np.isfinite(depth))
    v, u = EVERY_PX * rows, EVERY_PX * columns
    z = depth[rows, columns].astype(np.float64)
    rays = camera.normalize(np.column_stack([u, v]).astype(np.float64))
    points = now.T_map_camera.apply(np.column_stack([rays * z[:, None], z]))
    seen, transparent = np.zeros(len(points), bool), np.zeros(len(points), bool)
    for other in others:
        agrees, beyond = _compared(points, other, camera, stereo)
        seen |= agrees
        transparent |= beyond
    kept = seen & ~transparent
    return Cloud(points[kept], now.image[v[kept], u[kept]] / 255.0)


def _compared(
    points_m: FloatArray, other: _Depth, camera: Camera, stereo: StereoDepth
) -> tuple[BoolArray, BoolArray]:
    """Return which points (n, 3) another frame measures, and which ones it looks through."""
    local = other.T_map_camera.inverse().apply(points_m)
    pixels = camera.project(local)
    inside = np.flatnonzero(camera.contains(pixels))
    columns, rows = np.rint(pixels[inside]).astype(np.int64).T
    columns, rows = columns.clip(0, camera.width - 1), rows.clip(0, camera.height - 1)
    expected = stereo.disparity_px(local[inside, 2].astype(np.float32))
    surplus = expected - stereo.disparity_px(other.depth_m[rows, columns])  # NaN: neither
    agrees, beyond = np.zeros(len(points_m), bool), np.zeros(len(points_m), bool)
    agrees[inside] = np.abs(surplus) < AGREE_PX
    beyond[inside] = surplus >= AGREE_PX
    return agrees, beyond


# -- thinning


class _Thinner:
    """Averages points over voxels as they come, so that any drive fits into memory."""

    def __init__(self, options: FusionOptions) -> None:
        self._options = options
        self._voxel_m = options.voxel_m
        self._waiting: list[Cloud] = []

    def add(self, cloud: Cloud) -> None:
        self._waiting.append(cloud)
        if sum(len(cloud.points_m) for cloud in self._waiting[1:]) > BUFFER:
            self._waiting = [self._thinned(max(KEPT, self._options.max_points))]

    def finish(self, on_progress: OnProgress) -> Cloud:
        """Return all points: no more than allowed, none isolated, in a fixed order."""
        on_progress("thinning", 0, 2)
        cloud = self._thinned(self._options.max_points)
        on_progress("thinning", 1, 2)
        if len(cloud.points_m) > NEIGHBOURS:
            thick, _ = _open3d_cloud(cloud).remove_statistical_outlier(NEIGHBOURS, SPREAD)
            cloud = _of_open3d(thick)
        order = np.lexsort(cloud.points_m.T)
        on_progress("thinning", 2, 2)
        return Cloud(cloud.points_m[order], cloud.colors[order], self._voxel_m)

    def _thinned(self, most: int) -> Cloud:
        """Return at most so many points: voxels grow until that holds, by the area per point."""
        points, colors, _ = zip(*self._waiting, strict=True)
        whole = _open3d_cloud(Cloud(np.concatenate(points), np.concatenate(colors)))
        while True:
            thin = whole.voxel_down_sample(self._voxel_m)
            count = len(thin.points)
            if count <= most:
                return _of_open3d(thin)
            self._voxel_m *= max(GROWTH, (count / most) ** 0.5)


def _open3d() -> Any:
    """Return the module. SemvizError where a system library that it needs is missing."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise SemvizError(
            f"open3d cannot be imported ({error}); the README names the packages that it needs"
        ) from None
    return open3d


def _open3d_cloud(cloud: Cloud) -> Any:
    open3d = _open3d()
    made = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud.points_m))
    made.colors = open3d.utility.Vector3dVector(cloud.colors)
    return made


def _of_open3d(cloud: Any) -> Cloud:
    return Cloud(np.asarray(cloud.points), np.asarray(cloud.colors))
