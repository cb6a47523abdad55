"""Triangulated positions of label elements, and where they appear in unlabelled images.

Results are cached until the observations change. Within a pixel of noise, rays to a far point
are parallel or meet behind the cameras. The best point ahead of the cameras is then at
infinity, and only the direction fixes it. So points are homogeneous: (x, y, z, 1) in the map
frame, or (x, y, z, 0) for a direction.
"""

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from semviz.annotator.panes import Cameras
from semviz_annotation.assist.marked_image import pixel
from semviz_annotation.labels.labels import Labels, Observation, Pixel
from semviz_annotation.labels.views import PosedView, camera_of, rig_view
from semviz_annotation.mapping.placement import triangulation
from semviz_core.base.camera import Rig
from semviz_core.base.frame import Side
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.metrics.detection import across_px


def reprojection_error_px(views: Sequence[PosedView], observations: Sequence[Observation]) -> float:
    """Return how badly the last of some observations of one element fits the others, px.

    It is the reprojection error (rms) of the worse end. Ends known in fewer than two views do not
    count. Both ends are taken as points, because planes through poles in two views always meet.
    With more views, or if an observation has no end that counts, the last observation's error
    across the line counts too: many good views must not hide it. Infinite if no point at any depth
    projects into all views.
    """
    pairs = list(zip(views, observations, strict=True))
    ends = (
        [(view, row, _anchor(row)) for view, row in pairs if row.anchor_known],
        [(view, row, _end(row)) for view, row in pairs if row.end_px and row.end_known],
    )
    counted = [points for points in ends if len(points) > 1]
    errors = [
        _point_error_px([view for view, _, _ in points], [end for _, _, end in points])
        for points in counted
    ]
    with_end = [row for points in counted for _, row, _ in points]
    is_line = observations[0].end_px is not None
    if is_line and (len(pairs) > 2 or any(row not in with_end for row in observations)):
        errors.append(_line_error_px(views, observations))
    worst = max(errors)
    return worst if np.isfinite(worst) else float("inf")


def best_ends(views: Sequence[PosedView], observations: Sequence[Observation]) -> FloatArray:
    """Return homogeneous ends (2, 4) where the rays agree best; NaN for the end of a sign."""
    anchor = _best_point(views, [_anchor(observation) for observation in observations])
    if observations[0].end_px is None:
        return np.stack([anchor, np.full(4, np.nan)])
    return np.stack(
        [anchor, _best_point(views, [_end(observation) for observation in observations])]
    )


def project_homogeneous(view: PosedView, points: FloatArray) -> FloatArray:
    """Return (n, 2) px of homogeneous points (n, 4); NaN behind the camera."""
    pose = view.T_camera_map
    return view.camera.project(points[:, :3] @ pose.rotation.T + points[:, 3:] * pose.translation)


def _best_point(views: Sequence[PosedView], points: Sequence[Observation]) -> FloatArray:
    """The point (4,) of least reprojection error to first order, ahead of all views or at infinity.

    Iterative-Eigen (Hartley & Sturm 1997, 5.3), which treats points at infinity like any other.
    """
    pairs = list(zip(views, points, strict=True))
    rays = np.array([view.rays(_pixels(point))[0] for view, point in pairs])
    center = np.mean([view.center_m for view in views], axis=0)  # small numbers condition better
    planes = np.array([_planes(view, ray, center) for view, ray in zip(views, rays, strict=True)])
    axes = np.array([view.T_camera_map.rotation[2] for view in views])
    offsets = np.array([view.center_m - center for view in views])
    depth_of = np.column_stack([axes, -(axes * offsets).sum(axis=1)])
    depths = np.ones(len(views))
    for _ in range(3):
        point = np.linalg.svd((planes / depths[:, None, None]).reshape(-1, 4))[2][3]
        point *= np.copysign(1.0, point[3])
        depths = depth_of @ point
        if (depths <= 0.0).any():
            return np.append(rays.mean(axis=0), 0.0)
    return np.append(point[:3] + point[3] * center, point[3])


def _planes(view: PosedView, ray: FloatArray, center: FloatArray) -> FloatArray:
    """(2, 4) planes through a ray, horizontal and vertical in its image, in px times depth."""
    R = view.T_camera_map.rotation
    x, y, z = R @ ray
    normals = np.stack([R[0] - x / z * R[2], R[1] - y / z * R[2]])
    normals *= np.diag(view.camera.K)[:2, None]
    return np.column_stack([normals, -normals @ (view.center_m - center)])


def _point_error_px(views: Sequence[PosedView], points: Sequence[Observation]) -> float:
    best = _best_point(views, points)[None]
    errors = [
        project_homogeneous(view, best) - _pixels(point)
        for view, point in zip(views, points, strict=True)
    ]
    return _rms(np.linalg.norm(np.concatenate(errors), axis=1))


def _line_error_px(views: Sequence[PosedView], poles: Sequence[Observation]) -> float:
    """Error of the last pole across the triangulated line, or across the line at infinity."""
    position = triangulation.triangulate(views, poles, min_angle_rad=0.0)
    if isinstance(position, triangulation.TriangulationFailure):
        line = _line_at_infinity(views, poles)
    else:
        line = np.column_stack([np.stack([position.anchor_m, position.end_m]), np.ones(2)])
    return _rms(across_px(project_homogeneous(views[-1], line), _pixels(poles[-1])))


def _line_at_infinity(views: Sequence[PosedView], poles: Sequence[Observation]) -> FloatArray:
    """(2, 4) homogeneous: in the mean of the planes through all poles."""
    rays = np.array([view.rays(_pixels(pole)) for view, pole in zip(views, poles, strict=True)])
    normal = np.cross(rays[:, 0], rays[:, 1]).sum(axis=0)
    normal /= max(float(np.linalg.norm(normal)), 1e-12)
    on_line = rays[-1] - (rays[-1] @ normal)[:, None] * normal
    return np.concatenate([on_line, np.zeros((2, 1))], axis=1)


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.square(errors).mean()))


def _pixels(row: Observation) -> FloatArray:
    """(1, 2) px of a point, (2, 2) of a pole."""
    return np.array([row.anchor_px] if row.end_px is None else [row.anchor_px, row.end_px])


def _anchor(row: Observation) -> Observation:
    """The anchor as a point."""
    return replace(row, end_px=None)


def _end(pole: Observation) -> Observation:
    """The bottom as a point."""
    return replace(pole, anchor_px=pole.end_px or pole.anchor_px, end_px=None)


REACH_M = 60.0
"""Elements further ahead are too small to label."""
POLE_POINTS = 9
"""Points tested along a pole: it may be visible though both its ends are outside the image."""


@dataclass(frozen=True)
class ProjectedElement:
    """The projection of an element into one image."""

    element_id: str
    side: Side
    anchor_px: Pixel
    end_px: Pixel | None
    depth_m: float
    """Depth of its anchor in this camera."""


def projected_elements(
    frame_index: int,
    side: Side,
    T_camera_map: Pose,
    rig: Rig,
    labels: Labels,
    mapped: Mapping[str, triangulation.Triangulated],
) -> tuple[ProjectedElement, ...]:
    """Return mapped elements visible in one image of a frame and not labelled there, nearest first.

    ``T_camera_map`` is the pose of the frame's left camera. An element counts as visible if part of
    it is in the image, and all of it is less than ``REACH_M`` ahead.
    """
    if not mapped:
        return ()
    ids = list(mapped)
    ends_m = np.array([[mapped[id_].anchor_m, mapped[id_].end_m] for id_ in ids])
    projections = [
        projection
        for projection in _in_image(ids, ends_m, T_camera_map, rig, side)
        if labels.find(projection.element_id, frame_index, side) is None
    ]
    return tuple(sorted(projections, key=lambda projection: projection.depth_m))


def _in_image(
    ids: list[str], ends_m: FloatArray, T_left_map: Pose, rig: Rig, side: Side
) -> list[ProjectedElement]:
    """``ends_m`` is (n, 2, 3); the end is NaN for signs."""
    camera, T_camera_left = camera_of(rig, side)
    ends = (T_camera_left @ T_left_map).apply(ends_m)
    depth = ends[..., 2]
    near = ((depth > 0.5) & (depth < REACH_M)) | np.isnan(depth)
    pixels = camera.project(ends.reshape(-1, 3)).reshape(-1, 2, 2)
    along = pixels[:, :1] + np.linspace(0.0, 1.0, POLE_POINTS)[:, None] * (
        pixels[:, 1:] - pixels[:, :1]
    )
    points = np.where(np.isnan(along), pixels[:, :1], along)
    inside = camera.contains(points.reshape(-1, 2)).reshape(-1, POLE_POINTS)
    rows = np.flatnonzero(near.all(axis=1) & inside.any(axis=1))
    return [
        ProjectedElement(
            element_id=ids[row],
            side=side,
            anchor_px=pixel(pixels[row, 0]),
            end_px=None if np.isnan(pixels[row, 1]).any() else pixel(pixels[row, 1]),
            depth_m=float(depth[row, 0]),
        )
        for row in rows
    ]


Position = triangulation.Triangulated | triangulation.TriangulationFailure

ONE_VIEW = triangulation.TriangulationFailure("1 view; label it in a second image")
NEAR_M = REACH_M + 100.0
"""An element within ``REACH_M`` of a camera and labelled from up to 100 m away was labelled by
cameras this close."""
CACHED_FRAMES = 8
"""Frames whose surroundings are cached: those on screen, of all pages."""
MANY_CHANGES = 100
"""With more changed elements, all frames are forgotten, not only those that show them."""
SLICE_S = 0.01
"""How long an answer waits for positions that it can do without."""


class ElementPositions:
    """Triangulates elements and keeps the results until their observations change.

    ``near`` triangulates what a frame needs at once. There may be many thousands of other elements:
    ``update`` triangulates them a slice at a time. One thread at a time.
    """

    def __init__(self, cameras: Cameras) -> None:
        self._cameras = cameras
        poses = cameras.T_map_camera.items()
        posed = {index: pose for index, pose in poses if pose is not None}
        self._posed = np.array(list(posed), dtype=np.int64)
        self._centers_m = np.array([pose.translation for pose in posed.values()]).reshape(-1, 3)
        self._labels = Labels()
        self._stale: dict[str, None] = {}
        """Elements whose positions are unknown or may have changed, as an ordered set."""
        self._sources: dict[str, tuple[Observation, ...]] = {}
        """The observations from which positions were computed."""
        self._positions: dict[str, Position] = {}
        self._mapped: dict[str, triangulation.Triangulated] = {}
        self._ends: dict[str, FloatArray | None] = {}
        self._near: dict[int, Mapping[str, triangulation.Triangulated]] = {}
        self._elements_in: dict[int, tuple[str, ...]] = {}
        """Elements labelled in a frame; filled on request."""
        self.version = 0
        """Changes whenever ``mapped`` may have changed."""

    def near(self, labels: Labels, frame_index: int) -> Mapping[str, triangulation.Triangulated]:
        """Return the triangulated elements that may be visible in a frame, by id.

        They are those labelled by cameras within ``NEAR_M``, in this pass of the street or another.
        Empty if the frame has no pose.
        """
        self._follow(labels)
        if frame_index not in self._near:
            near: dict[str, triangulation.Triangulated] = {}
            for element_id in self._labelled_near(frame_index):
                position = self._updated(element_id)
                if isinstance(position, triangulation.Triangulated):
                    near[element_id] = position
            if len(self._near) >= CACHED_FRAMES:
                self._near.clear()
            self._near[frame_index] = near
        return self._near[frame_index]

    def centers_near(self, frame_index: int, reach_m: float) -> FloatArray:
        """Return (k, 3) camera centres within ``reach_m`` of a frame that has a pose."""
        here = self._cameras.T_map_camera[frame_index]
        assert here is not None
        away_m = np.linalg.norm(self._centers_m - here.translation, axis=1)
        return np.asarray(self._centers_m[away_m <= reach_m])

    def mapped(self, labels: Labels) -> Mapping[str, triangulation.Triangulated]:
        """Return the elements triangulated so far, by id."""
        self.update(labels)
        return self._mapped

    def update(self, labels: Labels, seconds: float = SLICE_S) -> bool:
        """Triangulate changed elements for that long. Return whether all are up to date."""
        self._follow(labels)
        end = time.monotonic() + seconds
        while self._stale and time.monotonic() < end:
            self._updated(next(iter(self._stale)))
        return not self._stale

    def of_element(self, labels: Labels, element_id: str) -> Position:
        """Return the position of one element in the map frame."""
        self._follow(labels)
        return self._updated(element_id)

    def of_observations(self, observations: Sequence[Observation]) -> Position:
        """Triangulate one element in the map frame; observations in unposed frames are ignored."""
        posed = self.posed(observations)
        if len(posed) < 2:
            return ONE_VIEW
        return triangulation.triangulate([self.view(row) for row in posed], posed)

    def best_ends(self, labels: Labels, element_id: str) -> FloatArray | None:
        """Return (2, 4) homogeneous ends at any ray angle; None for a single view."""
        self._follow(labels)
        if element_id not in self._ends:
            posed = self.posed(labels.of_element(element_id))
            views = [self.view(row) for row in posed]
            self._ends[element_id] = best_ends(views, posed) if len(posed) > 1 else None
        return self._ends[element_id]

    def posed(self, observations: Iterable[Observation]) -> list[Observation]:
        """Return the observations in frames that have a pose."""
        return [
            observation
            for observation in observations
            if self._cameras.T_map_camera.get(observation.frame_index) is not None
        ]

    def of_pair(self, observations: Sequence[Observation]) -> Position:
        """Triangulate one element in left camera coordinates from one frame's observations."""
        if len(observations) < 2:
            return ONE_VIEW
        return triangulation.triangulate(
            [rig_view(self._cameras.rig, observation.side) for observation in observations],
            observations,
        )

    def view(self, observation: Observation) -> PosedView:
        """Return the camera of an observation."""
        return self._cameras.view(observation.frame_index, observation.side)

    def _follow(self, labels: Labels) -> None:
        """Mark as stale what differs between ``labels`` and the labels used so far."""
        if labels is self._labels:
            return
        differing = sorted(labels.differing(self._labels))
        self._forget_frames(differing, labels)
        for element_id in differing:
            self._ends.pop(element_id, None)
            if element_id in labels.elements:
                self._stale[element_id] = None
            else:
                self._forget(element_id)
        self._labels = labels
        self._near.clear()

    def _forget_frames(self, differing: Sequence[str], labels: Labels) -> None:
        if len(differing) > MANY_CHANGES:
            self._elements_in.clear()
            return
        for element_id in differing:
            for state in (self._labels, labels):
                for row in state.of_element(element_id):
                    self._elements_in.pop(row.frame_index, None)

    def _forget(self, element_id: str) -> None:
        self.version += 1
        for cache in (self._stale, self._sources, self._positions, self._mapped):
            cache.pop(element_id, None)

    def _updated(self, element_id: str) -> Position:
        if element_id in self._stale:
            observations = self._labels.of_element(element_id)
            if self._sources.get(element_id) != observations:
                self._put(element_id, self.of_observations(observations))
                self._sources[element_id] = observations
            del self._stale[element_id]
        return self._positions.get(element_id, ONE_VIEW)

    def _put(self, element_id: str, position: Position) -> None:
        self.version += 1
        self._positions[element_id] = position
        if isinstance(position, triangulation.Triangulated):
            self._mapped[element_id] = position
        else:
            self._mapped.pop(element_id, None)

    def _labelled_near(self, frame_index: int) -> Iterable[str]:
        """Elements labelled in frames whose cameras are near, each once."""
        here = self._cameras.T_map_camera[frame_index]
        if here is None:
            return ()
        away_m = np.linalg.norm(self._centers_m - here.translation, axis=1)
        frames = self._posed[away_m <= NEAR_M].tolist()
        return dict.fromkeys(
            element_id for frame in frames for element_id in self._labelled_in(frame)
        )

    def _labelled_in(self, frame_index: int) -> tuple[str, ...]:
        if frame_index not in self._elements_in:
            rows = self._labels.in_frame(frame_index)
            self._elements_in[frame_index] = tuple(dict.fromkeys(row.element_id for row in rows))
        return self._elements_in[frame_index]
