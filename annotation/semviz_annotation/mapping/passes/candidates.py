"""Candidates for new elements: what passes see where the map has nothing."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import NamedTuple

import numpy as np

from semviz_annotation.labels.detections import as_proposals
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.proposal import ProcessedImages, Proposal
from semviz_annotation.labels.proposals import Proposals
from semviz_annotation.mapping.association.detection_tracks import TrackOptions, detection_labels
from semviz_annotation.mapping.association.merging import LinkOptions
from semviz_annotation.mapping.association.tracks import (
    OnProgress,
    find_tracks,
    finish_detected,
)
from semviz_annotation.mapping.build import BuildOptions, map_elements
from semviz_annotation.mapping.passes.evidence import Pass, unexplained
from semviz_annotation.mapping.placement.observations import collect_observations
from semviz_core.base.camera import Rig
from semviz_core.base.elements import Elements3D, joined
from semviz_core.base.frame import Frame, Side
from semviz_core.base.semantic_map import (
    MapFrame,
    SemanticMap,
    footprint_covariance_m2,
    footprint_m,
)
from semviz_core.common.arrays import ByteImage, FloatArray, IntArray
from semviz_core.common.errors import SemvizError

MIN_FRAMES, MIN_IN_PASS = 4, 2
"""So many frames detect a candidate, in all passes and in each: an element far beside the road, or
behind others, shows in few frames of a pass."""
SAME_M = 1.5
"""Candidates of one class are one up to this distance: the poses of two passes differ by up to a
metre where few elements are seen, and their covariances do not tell."""
_LEAST_POSE_SIGMA_M = 0.05
NO_ELEMENTS = Elements3D.from_ends([], [], [], [])


@dataclass(frozen=True)
class _Posed:
    """The frames of a pass with their estimated poses, as a dataset without images."""

    rig: Rig
    map_frame: MapFrame
    frames: tuple[Frame, ...]

    def image(self, index: int, side: Side) -> ByteImage:
        raise SemvizError(f"frame {index}: the {side} image of a pass is not at hand")


def candidates(
    passes: Sequence[Pass], semantic_map: SemanticMap, labels: Labels, on_progress: OnProgress
) -> Elements3D:
    """Return one element for each thing that passes see and the map lacks; their ids go on from
    those of the map. Each pass has a sure frame. ``labels`` say what classes there are."""
    found = _Clusters()
    for number, one in enumerate(passes):
        on_progress("looking for what is not in the map", number, len(passes))
        found.add(_built(one, semantic_map, labels))
    ids = semantic_map.elements.id
    return found.elements(int(ids.max()) + 1 if len(ids) else 1)


class _Built(NamedTuple):
    """Elements that the unexplained detections of a pass make."""

    elements: Elements3D
    frames: IntArray
    """(n,) that detect each."""


def _built(one: Pass, semantic_map: SemanticMap, labels: Labels) -> _Built:
    rows: list[Proposal] = []
    frames: list[Frame] = []
    center = semantic_map.triangle_center
    for position in one.sure:
        frame, result = one.frames[position], one.localizations[position]
        observed = result.observed[unexplained(result, semantic_map, one.detector)]
        rows += as_proposals(frame.index, "left", observed, result.camera, one.name, center)
        assert result.T_camera_map is not None
        frames.append(replace(frame, T_map_camera=result.T_camera_map.inverse()))
    nothing = Labels(own_classes=labels.own_classes, triangle_center=center)
    images: frozenset[tuple[int, Side]] = frozenset((frame.index, "left") for frame in frames)
    detections = Proposals.of(rows, ProcessedImages(one.name, images=images))
    source = _Posed(Rig(one.localizations[one.sure[0]].camera), semantic_map.frame, tuple(frames))
    linking = LinkOptions(BuildOptions().place, _pose_sigma_m(one))
    options = TrackOptions(min_frames=MIN_IN_PASS)
    tracked = detection_labels(nothing, detections, source, linking, options)
    if not tracked.labels.elements:
        return _Built(NO_ELEMENTS, np.zeros(0, np.int64))
    gathered = collect_observations(tracked.labels, source, None, tracked.sigma_ratio)
    tracks = find_tracks(tracked.labels, gathered, linking, None, lambda what, done, of: None)
    tracks = finish_detected(tracks, tracked.log_odds.keys(), tracked.min_frames)
    elements, origin = map_elements(tracks, tracked.log_odds)
    return _Built(elements, np.array([len(each.observation_ids) for each in origin], np.int64))


def _pose_sigma_m(one: Pass) -> float:
    """Return the median error of the estimated camera centres, in each direction."""
    covariances = [one.localizations[position].covariance for position in one.sure]
    known = [covariance for covariance in covariances if covariance is not None]
    if not known:
        return _LEAST_POSE_SIGMA_M
    sigma_m = np.sqrt([np.trace(covariance[:3, :3]) / 3.0 for covariance in known])
    return max(float(np.median(sigma_m)), _LEAST_POSE_SIGMA_M)


class _Cluster(NamedTuple):
    """Elements of different passes at one place."""

    best: Elements3D
    """(1) The most precise of them."""
    place_m: FloatArray
    """(2,)"""
    variance_m2: float
    frames: int
    """That detect it, in all passes."""


class _Clusters:
    def __init__(self) -> None:
        self._found: list[_Cluster] = []

    def add(self, built: _Built) -> None:
        """Add the elements of a pass, each to the nearest cluster of its class, or as its own."""
        elements = built.elements
        variance_m2 = np.trace(footprint_covariance_m2(elements), axis1=1, axis2=2) / 2.0
        for row, place_m in enumerate(footprint_m(elements)[:, :2]):
            one = _Cluster(elements[[row]], place_m, float(variance_m2[row]), built.frames[row])
            near = self._nearest(one)
            if near is None:
                self._found.append(one)
                continue
            best = min(self._found[near], one, key=lambda each: each.variance_m2)
            self._found[near] = best._replace(frames=self._found[near].frames + one.frames)

    def _nearest(self, one: _Cluster) -> int | None:
        nearest, least_m = None, SAME_M
        for number, other in enumerate(self._found):
            away_m = float(np.linalg.norm(one.place_m - other.place_m))
            if one.best.class_id[0] == other.best.class_id[0] and away_m < least_m:
                nearest, least_m = number, away_m
        return nearest

    def elements(self, first_id: int) -> Elements3D:
        """Return the clusters that enough frames show as elements with ids from ``first_id`` on."""
        shown = [cluster for cluster in self._found if cluster.frames >= MIN_FRAMES]
        named = (
            replace(cluster.best, id=np.array([first_id + number]))
            for number, cluster in enumerate(shown)
        )
        return reduce(joined, named, NO_ELEMENTS)
