"""Candidates for new elements: what passes see where the map has nothing."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semviz_annotation.labels.detections import as_proposals
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.proposal import ProcessedImages, Proposal
from semviz_annotation.labels.proposals import Proposals
from semviz_annotation.mapping.association.detection_tracks import TrackOptions, detection_labels
from semviz_annotation.mapping.association.merging import LinkOptions
from semviz_annotation.mapping.association.tracks import (
    find_tracks,
    finish_detected,
)
from semviz_annotation.mapping.build import map_elements
from semviz_annotation.mapping.passes.evidence import Pass, unexplained
from semviz_annotation.mapping.placement.observations import (
    LabelObservations,
    gather_observations,
)
from semviz_annotation.mapping.placement.reprojection import PlaceOptions
from semviz_core.base.camera import Rig
from semviz_core.base.elements import Elements3D
from semviz_core.base.frame import Frame, Side
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.common.arrays import ByteImage
from semviz_core.common.errors import SemvizError
from semviz_core.common.progress import OnProgress, unwatched

MIN_FRAMES, MIN_IN_PASS = 4, 2
"""So many frames detect a candidate, in all passes and in each: an element far beside the road, or
behind others, shows in few frames of a pass."""
_PLACE = PlaceOptions(sigma_px=1.5)
"""Estimated poses add about as much to a detection's error as the detector."""
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
    those of the map. Each pass has a sure frame. ``labels`` say what classes there are.

    Detections are tracked within a pass. The tracks of all passes are then linked and placed like
    those of one drive: one pass alone often sees only the direction of what is far beside the road.
    """
    found = Labels(own_classes=labels.own_classes, triangle_center=semantic_map.triangle_center)
    linking, options = LinkOptions(_PLACE, _pose_sigma_m(passes)), TrackOptions(0.0, MIN_IN_PASS)
    gathered, first = list[LabelObservations](), 0
    for number, one in enumerate(passes):
        on_progress("looking for what is not in the map", number, len(passes))
        source, detections = _unexplained(one, semantic_map, first)
        frames = range(first, first := first + len(source.frames))
        joined = detection_labels(found, detections, source, linking, options, frames)
        found = joined.labels
        gathered.append(gather_observations(found, source, frames, joined.sigma_ratio))
    if not found.elements:
        return NO_ELEMENTS
    together = LabelObservations.joined(gathered)
    tracks = find_tracks(found, together, linking, None, unwatched)
    elements, _ = map_elements(finish_detected(tracks, found.elements, MIN_FRAMES))
    ids = semantic_map.elements.id
    return replace(elements, id=np.arange(len(elements)) + (int(ids.max()) + 1 if len(ids) else 1))


def _unexplained(one: Pass, semantic_map: SemanticMap, first: int) -> tuple[_Posed, Proposals]:
    """Return the sure frames of a pass with their estimated poses, numbered from ``first`` on, and
    their detections that no element of the map explains."""
    rows: list[Proposal] = []
    frames: list[Frame] = []
    for position in one.sure:
        result, index = one.localizations[position], first + len(frames)
        observed = result.observed[unexplained(result, semantic_map, one.detector)]
        center = semantic_map.triangle_center
        rows += as_proposals(index, "left", observed, result.camera, one.name, center)
        assert result.T_camera_map is not None
        pose = result.T_camera_map.inverse()
        frames.append(replace(one.frames[position], index=index, T_map_camera=pose))
    images: frozenset[tuple[int, Side]] = frozenset((frame.index, "left") for frame in frames)
    rig = Rig(one.localizations[one.sure[0]].camera)
    detections = Proposals.of(rows, ProcessedImages(one.name, images=images))
    return _Posed(rig, semantic_map.frame, tuple(frames)), detections


def _pose_sigma_m(passes: Sequence[Pass]) -> float:
    """Return the median error of the estimated camera centres, in each direction."""
    covariances = [one.localizations[row].covariance for one in passes for row in one.sure]
    known = [covariance for covariance in covariances if covariance is not None]
    if not known:
        return _LEAST_POSE_SIGMA_M
    sigma_m = np.sqrt([np.trace(covariance[:3, :3]) / 3.0 for covariance in known])
    return max(float(np.median(sigma_m)), _LEAST_POSE_SIGMA_M)
