"""What rules look at: a map, with what is known of it, in a form they share."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np

from semviz_annotation.labels import Labels
from semviz_annotation.mapping.quality.labelled import Labelled, labelled
from semviz_annotation.mapping.quality.linting.finding import Finding, Severity
from semviz_annotation.mapping.quality.linting.road import Road
from semviz_annotation.view import rig_view
from semviz_core.arrays import FloatArray, IntArray
from semviz_core.semantic_map import SemanticMap
from semviz_core.sources.source import Source

_BEST_DEPTH_M = 12.0
"""An element without labels is best looked at from about here."""


@dataclass(frozen=True, eq=False)
class Case:
    """A map of n elements with the labels and images that it belongs to.

    Rules that need labels find ``labelled`` None where the map was not made from these.
    """

    semantic_map: SemanticMap
    labels: Labels
    source: Source

    @cached_property
    def labelled(self) -> Labelled | None:
        """In the frames that have a pose."""
        posed = {one.index for one in self.source.frames if one.T_map_camera is not None}
        return labelled(self.semantic_map, self.labels, self.source, posed)

    @cached_property
    def road(self) -> Road | None:
        """As the map knows it, or else the images; None where neither has poses."""
        cameras = self.semantic_map.trajectory_m
        if not len(cameras):
            poses = [one.T_map_camera for one in self.source.frames]
            cameras = np.array([one.translation for one in poses if one is not None])
        return Road(cameras) if len(cameras) else None

    @cached_property
    def foot_m(self) -> FloatArray:
        """(n, 3) the lowest that is known of each element: a pole's bottom, a sign's middle."""
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
        """What people call the element in a row of the map."""
        elements = self.semantic_map.elements
        return self.semantic_map.classes.element_name(elements.class_id[row], elements.id[row])

    def views_of(self, row: int) -> IntArray:
        """(k,) rows of ``labelled.views`` that show the element in a row, as it is labelled."""
        if self.labelled is None:
            return np.zeros(0, dtype=np.int64)
        sightings = self.labelled.sightings
        first, last = np.searchsorted(sightings.thing, [row, row + 1])
        return sightings.view[first:last]

    def finding(
        self,
        rule: str,
        severity: Severity,
        rows: tuple[int, ...],
        message: str,
        frame_index: int | None = None,
    ) -> Finding:
        """Of elements in rows of the map; looked at in ``frame_index``, or the best there is."""
        ids = tuple(int(self.semantic_map.elements.id[row]) for row in rows)
        look = self._best_frame(rows[0]) if frame_index is None else frame_index
        return Finding(rule, severity, ids, message, look)

    def _best_frame(self, row: int) -> int | None:
        """Where the element is largest among those where it is labelled, or else to be seen."""
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


Rule: TypeAlias = Callable[[Case], Iterator[Finding]]
