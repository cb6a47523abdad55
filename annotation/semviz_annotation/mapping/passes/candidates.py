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
MOST_APART_M, SAME_CHI2 = 4.0, 9.2
"""They are also one up to this distance if their covariances explain it (99 %)."""
PASS_SIGMA_M = 0.3
"""Error of the poses of a pass that its elements share, in each direction."""
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
    variance_m2: float
    """Of ``best``."""
    information: FloatArray
    """(2, 2) of all."""
    weighted_m: FloatArray
    """(2,) ``information`` times their mean."""
    frames: int
    """That detect it, in all passes."""

    @property
    def place_m(self) -> FloatArray:
        """(2,)"""
        return np.asarray(np.linalg.solve(self.information, self.weighted_m))

    def joined(self, other: "_Cluster") -> "_Cluster":
        better = min(self, other, key=lambda each: each.variance_m2)
        return better._replace(
            information=self.information + other.information,
            weighted_m=self.weighted_m + other.weighted_m,
            frames=self.frames + other.frames,
        )

    def fits(self, other: "_Cluster") -> bool:
        """Whether both are one element: few frames show how far away it is only roughly."""
        if self.best.class_id[0] != other.best.class_id[0]:
            return False
        off_m = self.place_m - other.place_m
        covariance = np.linalg.inv(self.information) + np.linalg.inv(other.information)
        away_m = float(np.linalg.norm(off_m))
        chi2 = float(off_m @ np.linalg.solve(covariance, off_m))
        return away_m < SAME_M or (away_m < MOST_APART_M and chi2 < SAME_CHI2)

    def element(self, id_: int) -> Elements3D:
        """Return the element, where all passes together put it."""
        by_m = np.append(self.place_m - footprint_m(self.best)[0, :2], 0.0)
        anchor_m, end_m = self.best.anchor_m + by_m, self.best.end_m + by_m
        return replace(self.best, id=np.array([id_]), anchor_m=anchor_m, end_m=end_m)


class _Clusters:
    def __init__(self) -> None:
        self._found: list[_Cluster] = []

    def add(self, built: _Built) -> None:
        """Add the elements of a pass, each to the nearest cluster that it fits, or as its own."""
        covariance_m2 = footprint_covariance_m2(built.elements)[:, :2, :2]
        covariance_m2 = covariance_m2 + PASS_SIGMA_M**2 * np.eye(2)
        for row, place_m in enumerate(footprint_m(built.elements)[:, :2]):
            information = np.linalg.inv(covariance_m2[row])
            variance_m2 = float(np.trace(covariance_m2[row]))
            element, frames = built.elements[[row]], int(built.frames[row])
            one = _Cluster(element, variance_m2, information, information @ place_m, frames)
            near = self._nearest(one)
            if near is None:
                self._found.append(one)
            else:
                self._found[near] = self._found[near].joined(one)

    def _nearest(self, one: _Cluster) -> int | None:
        away_m = {
            number: float(np.linalg.norm(one.place_m - other.place_m))
            for number, other in enumerate(self._found)
            if other.fits(one)
        }
        return min(away_m, key=away_m.__getitem__, default=None)

    def elements(self, first_id: int) -> Elements3D:
        """Return the clusters that enough frames show as elements with ids from ``first_id`` on."""
        shown = [cluster for cluster in self._found if cluster.frames >= MIN_FRAMES]
        named = (cluster.element(first_id + number) for number, cluster in enumerate(shown))
        return reduce(joined, named, NO_ELEMENTS)
