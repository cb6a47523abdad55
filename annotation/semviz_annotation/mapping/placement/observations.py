"""Labels as arrays of views and observations, grouped by landmark.

Views have no distortion; observed pixels are undistorted accordingly. Rows are sorted by landmark.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from types import MappingProxyType
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from semviz_annotation.labels.labels import LabelElement, Labels, Observation
from semviz_annotation.labels.views import PosedView, rig_view
from semviz_core.base.camera import Camera, Rig
from semviz_core.base.frame import Dataset, Side
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray, unit_vectors
from semviz_core.common.errors import SemvizError

Number = TypeVar("Number", bound=np.generic)


@dataclass(frozen=True, eq=False)
class ViewArray:
    """v images without distortion, each at its pose in the map frame."""

    frame_index: IntArray
    """(v,)"""
    is_right: BoolArray
    """(v,)"""
    R: FloatArray
    """(v, 3, 3) rotation of ``T_camera_map``."""
    t: FloatArray
    """(v, 3) m, translation of ``T_camera_map``."""
    K: FloatArray
    """(v, 3, 3) px"""

    def __len__(self) -> int:
        return len(self.frame_index)

    @cached_property
    def center_m(self) -> FloatArray:
        """(v, 3) camera centres in the map frame."""
        return np.asarray(-(self.R.transpose(0, 2, 1) @ self.t[:, :, None])[:, :, 0])

    @cached_property
    def projection(self) -> FloatArray:
        """(v, 3, 4) from homogeneous map points to homogeneous pixels; the third is the depth
        (m)."""
        return np.asarray(self.K @ np.concatenate([self.R, self.t[:, :, None]], axis=2))

    def rays(self, rows: IntArray, pixels_px: FloatArray) -> FloatArray:
        """Return unit rays (k, 3) in the map frame through pixels (k, 2) of the views in rows
        (k,)."""
        homogeneous = np.concatenate([pixels_px, np.ones((len(pixels_px), 1))], axis=1)
        to_map = np.linalg.inv(self.projection[:, :, :3])
        rays = (to_map[rows] @ homogeneous[:, :, None])[:, :, 0]
        return unit_vectors(rays)

    def depth_m(self, rows: IntArray, points_m: FloatArray) -> FloatArray:
        """Return depths (k,) of points (k, 3), each in the view in its row (k,)."""
        return np.asarray(np.einsum("ki,ki->k", self.R[rows, 2], points_m) + self.t[rows, 2])


@dataclass(frozen=True, eq=False)
class ObservationArray:
    """k observations of n landmarks; rows sorted by landmark."""

    landmark: IntArray
    """(k,) landmark of each observation, 0 to n - 1, ascending."""
    view: IntArray
    """(k,) row in ``ViewArray``."""
    anchor_px: FloatArray
    """(k, 2) without distortion."""
    end_px: FloatArray
    """(k, 2) without distortion; NaN for points."""
    anchor_known: BoolArray
    """(k,)"""
    end_known: BoolArray
    """(k,)"""
    sigma_ratio: FloatArray
    """(k, 2) sigma across and along a pole, or along u and v, in multiples of the common
    ``PlaceOptions.sigma_px``: 1 for labels."""
    label_row: IntArray
    """(k,) row in ``LabelObservations.label_rows``."""
    count: int
    """Number of landmarks, n."""

    def __len__(self) -> int:
        return len(self.landmark)

    @cached_property
    def seen(self) -> IntArray:
        """(n,) number of observations of each landmark."""
        return np.bincount(self.landmark, minlength=self.count)

    @cached_property
    def first(self) -> IntArray:
        """(n,) row of each landmark's first observation, if it has one."""
        return np.cumsum(self.seen) - self.seen

    @cached_property
    def is_line(self) -> BoolArray:
        """(k,) whether the observation is of a pole."""
        return np.isfinite(self.end_px[:, 0])

    def per_landmark(self, combine: np.ufunc, values: NDArray[Number]) -> NDArray[Number]:
        """Combine values (k, ...) per landmark (n, ...), for example by ``np.add``; zero without
        any."""
        result = np.zeros((self.count, *values.shape[1:]), dtype=values.dtype)
        if len(values):
            some = self.seen > 0
            result[some] = combine.reduceat(values, self.first[some], axis=0)
        return result

    def of(self, values: BoolArray) -> BoolArray:
        """Return whether any observation of a landmark (n,) has True in values (k,)."""
        return self.per_landmark(np.logical_or, values)

    def where(self, rows: BoolArray) -> "ObservationArray":
        """Return the observations with True in rows (k,), of the same landmarks."""
        return self.taken(np.flatnonzero(rows), self.landmark[rows], self.count)

    def only(self, landmarks: BoolArray) -> "ObservationArray":
        """Return the observations of the landmarks with True in (n,), renumbered from 0."""
        rows = np.flatnonzero(landmarks[self.landmark])
        number = np.cumsum(landmarks) - 1
        return self.taken(rows, number[self.landmark[rows]], int(landmarks.sum()))

    def regrouped(self, landmark: IntArray, count: int) -> "ObservationArray":
        """Return the observations of ``count`` other landmarks: landmark (k,), or -1 to leave out.

        Observations of one landmark keep their order.
        """
        order = np.argsort(landmark, kind="stable")
        order = order[landmark[order] >= 0]
        return self.taken(order, landmark[order], count)

    def taken(self, rows: IntArray, landmark: IntArray, count: int) -> "ObservationArray":
        """Return the rows (m,), as observations of landmark (m,), ascending, 0 to count - 1."""
        return ObservationArray(
            landmark=landmark,
            view=self.view[rows],
            anchor_px=self.anchor_px[rows],
            end_px=self.end_px[rows],
            anchor_known=self.anchor_known[rows],
            end_known=self.end_known[rows],
            sigma_ratio=self.sigma_ratio[rows],
            label_row=self.label_row[rows],
            count=count,
        )


class LabelObservations(NamedTuple):
    """The labels of the chosen frames."""

    views: ViewArray
    """Views of all chosen frames with a pose, by frame, left before right."""
    observations: ObservationArray
    """Observations of ``elements`` (landmark i is element i), by view within a landmark."""
    elements: tuple[LabelElement, ...]
    """The elements labelled in the chosen frames, by number."""
    label_rows: tuple[Observation, ...]

    @classmethod
    def joined(cls, parts: "Sequence[LabelObservations]") -> "LabelObservations":
        """Concatenate labels of different frames and different elements, whatever their cameras.

        Frames and element numbers of each part come after those of the part before.
        """
        before = (0, 0, 0)
        shifted: list[ObservationArray] = []
        for part in parts:
            view, landmark, row = before
            of = part.observations
            shifted.append(
                replace(
                    of,
                    view=of.view + view,
                    landmark=of.landmark + landmark,
                    label_row=of.label_row + row,
                )
            )
            before = view + len(part.views), landmark + of.count, row + len(part.label_rows)
        arrays = {
            field.name: np.concatenate([getattr(of, field.name) for of in shifted])
            for field in fields(ObservationArray)
            if field.name != "count"
        }
        views = (
            np.concatenate([getattr(part.views, field.name) for part in parts])
            for field in fields(ViewArray)
        )
        return cls(
            ViewArray(*views),
            ObservationArray(**arrays, count=before[1]),
            tuple(element for part in parts for element in part.elements),
            tuple(row for part in parts for row in part.label_rows),
        )


def collect_observations(
    labels: Labels,
    source: Dataset,
    frames: Collection[int] | None = None,
    sigma_ratio: Mapping[str, tuple[float, float]] = MappingProxyType({}),
) -> LabelObservations:
    """Return the labels in ``frames`` (None: all).

    ``sigma_ratio`` is that of ``ObservationArray``, by observation id; others have 1.
    Raise SemvizError if a labelled frame is not in the source or has no pose, or no element is
    labelled in two images.
    """
    gathered = gather_observations(labels, source, frames, sigma_ratio)
    _check_twice(gathered.label_rows)
    return gathered


def gather_observations(
    labels: Labels,
    source: Dataset,
    frames: Collection[int] | None = None,
    sigma_ratio: Mapping[str, tuple[float, float]] = MappingProxyType({}),
) -> LabelObservations:
    """Return the same as ``collect_observations``, even if no element is labelled twice."""
    posed = _posed(labels, source, frames)
    rows = [row for index in posed for row in labels.in_frame(index)]
    by_number = {labels.element(row.element_id).number: row.element_id for row in rows}
    elements = tuple(labels.element(by_number[number]) for number in sorted(by_number))
    landmark_of = {element.id: landmark for landmark, element in enumerate(elements)}
    rows.sort(key=lambda row: (landmark_of[row.element_id], row.frame_index, row.side))
    sides: tuple[Side, ...] = ("left", "right") if source.rig.right is not None else ("left",)
    images = {
        (index, side): number
        for number, (index, side) in enumerate((index, side) for index in posed for side in sides)
    }
    where = [rig_view(source.rig, side, posed[index].inverse()) for index, side in images]
    observations = ObservationArray(
        landmark=np.array([landmark_of[row.element_id] for row in rows], dtype=np.int64),
        view=np.array([_image(images, row) for row in rows], dtype=np.int64),
        anchor_px=_undistorted(source.rig, rows, [row.anchor_px for row in rows]),
        end_px=_undistorted(source.rig, rows, [row.end_px or (np.nan, np.nan) for row in rows]),
        anchor_known=np.array([row.anchor_known for row in rows], dtype=np.bool_),
        end_known=np.array([row.end_known for row in rows], dtype=np.bool_),
        sigma_ratio=np.array([sigma_ratio.get(row.id, (1.0, 1.0)) for row in rows]).reshape(-1, 2),
        label_row=np.arange(len(rows)),
        count=len(elements),
    )
    return LabelObservations(as_views(list(images), where), observations, elements, tuple(rows))


def as_views(images: Sequence[tuple[int, Side]], views: Sequence[PosedView]) -> ViewArray:
    """Return images (frame index, side) and their views as arrays, without distortion."""
    return ViewArray(
        frame_index=np.array([index for index, _ in images], dtype=np.int64),
        is_right=np.array([side == "right" for _, side in images], dtype=np.bool_),
        R=np.array([view.T_camera_map.rotation for view in views]).reshape(-1, 3, 3),
        t=np.array([view.T_camera_map.translation for view in views]).reshape(-1, 3),
        K=np.array([view.camera.K for view in views]).reshape(-1, 3, 3),
    )


def undistorted(camera: Camera, pixels_px: FloatArray) -> FloatArray:
    """Return pixels (n, 2) as seen by a camera with the same ``K`` without distortion; NaN
    stays."""
    if not camera.distortion.size:
        return pixels_px
    plane = camera.normalize(pixels_px)
    return np.asarray(plane @ camera.K[:2, :2].T + camera.K[:2, 2])


def _posed(labels: Labels, source: Dataset, frames: Collection[int] | None) -> dict[int, Pose]:
    """Return ``T_map_camera`` of the chosen frames with a pose, by index."""
    labelled_poses(labels, source, frames)
    poses = {frame.index: frame.T_map_camera for frame in source.frames}
    chosen = set(poses) if frames is None else set(frames)
    return {index: pose for index, pose in poses.items() if index in chosen and pose is not None}


def labelled_poses(
    labels: Labels, source: Dataset, frames: Collection[int] | None
) -> dict[int, Pose]:
    """Return ``T_map_camera`` of the labelled frames in ``frames`` (None: all), by index.

    Without those that a person left out. Raise SemvizError if another one is not in the source, or
    has no pose.
    """
    known = {frame.index: frame for frame in source.frames}
    poses: dict[int, Pose] = {}
    for index in labels.frames:
        if frames is not None and index not in frames:
            continue
        frame = known.get(index)
        if frame is None:
            raise SemvizError(f"frame {index} is labelled but not in this sequence; wrong source?")
        if frame.T_map_camera is not None:
            poses[index] = frame.T_map_camera
        elif not frame.left_out:
            raise SemvizError(f"frame {index} is labelled but has no pose; a map needs true poses")
    return poses


def _check_twice(rows: Sequence[Observation]) -> None:
    views = Counter(row.element_id for row in rows)
    if max(views.values(), default=0) < 2:
        raise SemvizError(
            "no element is labelled in two images; in 'semviz annotate', label elements in left "
            "and right, or in several frames"
        )


def _image(images: dict[tuple[int, Side], int], row: Observation) -> int:
    try:
        return images[row.frame_index, row.side]
    except KeyError:
        raise SemvizError(
            f"frame {row.frame_index} is labelled in the right image, but the sequence has one "
            "camera; wrong source?"
        ) from None


def _undistorted(
    rig: Rig, rows: Sequence[Observation], pixels_px: Sequence[tuple[float, float]]
) -> FloatArray:
    result = np.array(pixels_px, dtype=np.float64).reshape(-1, 2)
    is_right = np.array([row.side == "right" for row in rows], dtype=np.bool_)
    for camera, on_side in ((rig.left, ~is_right), (rig.right, is_right)):
        if camera is not None:
            result[on_side] = undistorted(camera, result[on_side])
    return result
