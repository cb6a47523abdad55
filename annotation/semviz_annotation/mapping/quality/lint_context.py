"""Input and output of lint rules: a map with its labels, the findings, and the driven path.

The driven path gives the ground height and the distance from the road.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

import numpy as np

from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.views import rig_view
from semviz_annotation.mapping.quality.label_links import LabelAssociation, associate_labels
from semviz_core.base.frame import Dataset
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import FloatArray, IntArray

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Severity: TypeAlias = Literal["error", "warning", "hint"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "hint")
"""The worst first. An error cannot be right; a warning hardly ever is; a hint may well be."""


@dataclass(frozen=True)
class Finding:
    """One or several elements that a person should check."""

    rule: str
    """Name of the rule, for example ``leaning pole``."""
    severity: Severity
    element_ids: tuple[int, ...]
    """Ids of map elements."""
    message: str
    """One sentence with numbers."""
    frame_index: int | None
    """Frame that shows it best; None if no frame does."""


CAMERA_HEIGHT_M = 1.65
"""KITTI's; default for maps with too few poles."""
CAMERA_HEIGHTS_M = (1.0, 3.0)
"""Plausible range, from a low car to a lorry."""
_FEW = 5
"""Least number of poles that determine the height, against single hidden bottoms."""
_NEAR_M = 15.0
"""Poles farther from the road may stand on other ground."""
_GAP_M = 10.0
"""Cameras farther apart are not connected: the drive jumps there."""
_STEP_M = 0.25


class RoadOffsets(NamedTuple):
    """Positions of n points relative to the road."""

    distance_m: FloatArray
    """(n,) horizontal distance from the camera's path."""
    camera_m: FloatArray
    """(n,) height of the camera where it passed nearest."""


@dataclass(frozen=True, eq=False)
class DrivenPath:
    """The path of the cameras, (k, 3) points in driving order, k >= 1."""

    cameras_m: FloatArray

    def beside(self, points_m: FloatArray) -> RoadOffsets:
        """Return the offsets of points (n, 3) from the nearest point in space: roads may cross
        above."""
        lifted = points_m + np.array([0.0, 0.0, CAMERA_HEIGHT_M])
        nearest = self._path[self._index.query(lifted)[1]]
        distance = np.linalg.norm(points_m[:, :2] - nearest[:, :2], axis=1)
        return RoadOffsets(distance, nearest[:, 2])

    def camera_height_m(self, bottoms_m: FloatArray) -> float:
        """Return the camera's height above the ground, from the bottoms (n, 3) of poles
        (median)."""
        beside = self.beside(bottoms_m)
        near = beside.distance_m < _NEAR_M
        if near.sum() < _FEW:
            return CAMERA_HEIGHT_M
        heights = beside.camera_m[near] - bottoms_m[near, 2]
        return float(np.clip(np.median(heights), *CAMERA_HEIGHTS_M))

    @cached_property
    def _path(self) -> FloatArray:
        """(p, 3) points of the path, at most one step apart where the drive is continuous."""
        steps = np.diff(self.cameras_m, axis=0, append=self.cameras_m[-1:])
        lengths = np.linalg.norm(steps, axis=1)
        counts = np.where(lengths < _GAP_M, np.ceil(lengths / _STEP_M), 1.0)
        counts = np.maximum(counts, 1.0).astype(np.int64)
        row = np.repeat(np.arange(len(counts)), counts)
        share = (np.arange(len(row)) - (np.cumsum(counts) - counts)[row]) / counts[row]
        return np.asarray(self.cameras_m[row] + share[:, None] * steps[row])

    @cached_property
    def _index(self) -> "cKDTree":
        from scipy.spatial import cKDTree

        return cKDTree(self._path)


_BEST_DEPTH_M = 12.0
"""Best distance for checking an element without labels."""


@dataclass(frozen=True, eq=False)
class LintContext:
    """A map of n elements with its labels and images.

    ``labelled`` is None if the map was not made from these labels; rules that need labels skip it.
    """

    semantic_map: SemanticMap
    labels: Labels
    source: Dataset

    @cached_property
    def labelled(self) -> LabelAssociation | None:
        """The labels of map elements in frames with a pose."""
        posed = {frame.index for frame in self.source.frames if frame.T_map_camera is not None}
        return associate_labels(self.semantic_map, self.labels, self.source, posed)

    @cached_property
    def road(self) -> DrivenPath | None:
        """The driven path of the map, or else of the images; None if neither has poses."""
        cameras = self.semantic_map.trajectory_m
        if not len(cameras):
            poses = [frame.T_map_camera for frame in self.source.frames]
            cameras = np.array([pose.translation for pose in poses if pose is not None])
        return DrivenPath(cameras) if len(cameras) else None

    @cached_property
    def foot_m(self) -> FloatArray:
        """(n, 3) lowest known point of each element: a pole's bottom, a sign's centre."""
        elements = self.semantic_map.elements
        ends = np.where(elements.is_line[:, None], elements.end_m, elements.anchor_m)
        return np.where((ends[:, 2] < elements.anchor_m[:, 2])[:, None], ends, elements.anchor_m)

    @cached_property
    def foot_sigma_m(self) -> FloatArray:
        """(n,) standard deviation of the height of ``foot_m``."""
        elements = self.semantic_map.elements
        variances = np.diagonal(elements.covariance_m2, axis1=1, axis2=2)
        is_end = self.foot_m[:, 2] < elements.anchor_m[:, 2]
        return np.asarray(np.sqrt(np.where(is_end, variances[:, 5], variances[:, 2])))

    def name(self, row: int) -> str:
        """Return the display name of the element in a row of the map."""
        elements = self.semantic_map.elements
        return self.semantic_map.classes.element_name(elements.class_id[row], elements.id[row])

    def views_of(self, row: int) -> IntArray:
        """Return the rows (k,) of ``labelled.views`` in which the element of a row is labelled."""
        if self.labelled is None:
            return np.zeros(0, dtype=np.int64)
        observations = self.labelled.observations
        first, last = np.searchsorted(observations.landmark, [row, row + 1])
        return observations.view[first:last]

    def finding(
        self,
        rule: str,
        severity: Severity,
        rows: tuple[int, ...],
        message: str,
        frame_index: int | None = None,
    ) -> Finding:
        """Return a finding about rows of the map, with the best frame if ``frame_index`` is
        None."""
        ids = tuple(int(self.semantic_map.elements.id[row]) for row in rows)
        shown_frame = self._best_frame(rows[0]) if frame_index is None else frame_index
        return Finding(rule, severity, ids, message, shown_frame)

    def _best_frame(self, row: int) -> int | None:
        """Return the nearest frame that labels the element, or else the best one that shows it."""
        views = self.views_of(row)
        if self.labelled is not None and len(views):
            return int(self.labelled.views.frame_index[views].max())
        point = self.semantic_map.elements.anchor_m[row][None]
        best: tuple[float, int] | None = None
        for frame in self.source.frames:
            if frame.T_map_camera is None:
                continue
            view = rig_view(self.source.rig, "left", frame.T_map_camera.inverse())
            if view.camera.contains(view.project(point))[0]:
                far = abs(float(view.depth_m(point)[0]) - _BEST_DEPTH_M)
                best = min(best or (far, frame.index), (far, frame.index))
        return None if best is None else best[1]


Rule: TypeAlias = Callable[[LintContext], Iterator[Finding]]
