"""Tracks of detections: the elements of the last map that no person has accepted or rejected.

A map built from detections names the detections of each element. Such a track is proposed as a
whole, and accepted or rejected in all its images by one operation. It is open as long as none of
its label elements exists and at least one of its detections is neither labelled nor dismissed.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.special import expit

from semviz.annotator.element_positions import REACH_M
from semviz.annotator.panes import Cameras
from semviz.annotator.proposals.label_proposals import DETECTED_PX
from semviz_annotation.assist.marked_image import Mark, both_ends_px, gaps_px
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.proposal import Proposal
from semviz_annotation.labels.proposals import Proposals
from semviz_annotation.labels.rows import derived_id
from semviz_annotation.labels.shared_dict import SharedDict
from semviz_annotation.labels.views import PosedView
from semviz_core.base.elements import Elements3D
from semviz_core.base.frame import Side
from semviz_core.base.semantic_map import Provenance, SemanticMap
from semviz_core.common.arrays import FloatArray
from semviz_core.metrics.detection import across_px

SURE_FRAMES = 3
"""A false detection seldom repeats in a position that fits one object in so many frames."""
SURE_LOG_ODDS = 7.0
"""More than 99.9 %."""
SURE_PX = 2.0
"""Largest residual (rms) of a sure track, as for a confident proposal."""


def mark_of(detection: Proposal) -> Mark:
    """Return the mark of a detection."""
    return Mark(detection.anchor_px, detection.end_px, detection.anchor_known, detection.end_known)


@dataclass(frozen=True)
class DetectionTrack:
    """The detections of one map element that no label element stands for."""

    id: str
    """Id of the label element that it becomes."""
    name: str
    """Name of the map element."""
    map_id: int
    class_id: int
    label_ids: tuple[str, ...]
    """All ids of label elements that would settle it; the first is ``id``."""
    detections: tuple[Proposal, ...]
    """By frame, left first; at most one in each image."""
    log_odds: float | None
    """Log-odds that it exists; None if the map is older."""
    residuals_px: tuple[float, ...]
    """Distance of each detection from the projected element: across a pole."""

    @cached_property
    def residual_px(self) -> float:
        """Distance (rms) of the detections from the projected element."""
        return float(np.sqrt(np.square(self.residuals_px).mean()))

    @cached_property
    def frames(self) -> tuple[int, ...]:
        """The frames with its detections, ascending."""
        return tuple(sorted({detection.frame_index for detection in self.detections}))

    @property
    def existence(self) -> str:
        """Its probability, as in ``Provenance``; ``unknown`` if the map is older."""
        return Provenance(log_odds=self.log_odds).existence or "unknown"

    @property
    def probability(self) -> float | None:
        return None if self.log_odds is None else float(expit(self.log_odds))

    @property
    def is_sure(self) -> bool:
        """Whether it may be accepted together with others."""
        return not self.doubt

    @cached_property
    def doubt(self) -> str:
        """Why a person should look at it first: ``2 frames only``, ``98.2 % sure``, ``2.8 px off``;
        empty if it is sure."""
        if len(self.frames) < SURE_FRAMES:
            return "1 frame only" if len(self.frames) == 1 else f"{len(self.frames)} frames only"
        if self.log_odds is None or self.log_odds < SURE_LOG_ODDS:
            return "existence unknown" if self.log_odds is None else f"{self.existence} sure"
        return f"{self.residual_px:.1f} px off" if self.residual_px > SURE_PX else ""

    @cached_property
    def best_frame(self) -> int:
        """The frame to look at: a pole appears longest there, a sign is seen last there."""
        ends_px = both_ends_px(map(mark_of, self.detections))
        lengths_px = np.nan_to_num(np.linalg.norm(ends_px[:, 0] - ends_px[:, 1], axis=1)).tolist()
        frames = [row.frame_index for row in self.detections]
        return max(zip(lengths_px, frames, strict=True))[1]


def _doubt(track: DetectionTrack) -> tuple[bool, float, int, float]:
    """The sort key of tracks: the smaller, the less sure."""
    return track.is_sure, track.log_odds or 0.0, len(track.frames), -track.residual_px


@dataclass(frozen=True, eq=False)
class DetectionTracks:
    """The tracks of one map, whether open or not; the least sure first."""

    tracks: tuple[DetectionTrack, ...] = ()
    elements: Elements3D = field(default_factory=lambda: Elements3D.from_ends([], [], [], []))
    """Their map elements, in the same order; the ids are places in ``tracks``."""

    @classmethod
    def of(
        cls, semantic_map: SemanticMap, detected: Proposals, cameras: Cameras
    ) -> "DetectionTracks":
        """Return the tracks of a map whose detections are among those ``detected``."""
        rows, found = _detections_of(semantic_map, detected, cameras)
        residuals_px = _residuals_px(semantic_map.elements, rows, found, cameras)
        label_ids = _label_ids(semantic_map, rows, found)
        tracks = [
            _track(semantic_map, row, ids, detections, off_px)
            for row, ids, detections, off_px in zip(
                rows, label_ids, found, residuals_px, strict=True
            )
        ]
        order = sorted(range(len(tracks)), key=lambda n: _doubt(tracks[n]))
        elements = semantic_map.elements[np.array([rows[n] for n in order], dtype=np.int64)]
        return cls(tuple(tracks[n] for n in order), replace(elements, id=np.arange(len(order))))

    @cached_property
    def by_id(self) -> Mapping[str, DetectionTrack]:
        return {track.id: track for track in self.tracks}

    @cached_property
    def of_detection(self) -> Mapping[str, DetectionTrack]:
        """The track of each detection, by its id."""
        return {row.id: track for track in self.tracks for row in track.detections}


def _detections_of(
    semantic_map: SemanticMap, detected: Proposals, cameras: Cameras
) -> tuple[list[int], list[tuple[Proposal, ...]]]:
    """Return the map rows with detections, and the detections of each."""
    place = {id_: row for row, id_ in enumerate(detected.id)}
    rows, found = [], []
    for row, provenance in enumerate(semantic_map.provenance):
        best: dict[tuple[int, Side], Proposal] = {}
        for observation_id in provenance.observation_ids:
            if observation_id not in place:
                continue
            detection = detected[place[observation_id]]
            image = detection.frame_index, detection.side
            known = cameras.T_map_camera.get(detection.frame_index) is not None
            if known and (image not in best or best[image].score < detection.score):
                best[image] = detection
        if best and provenance.label_ids:
            rows.append(row)
            found.append(tuple(best[image] for image in sorted(best)))
    return rows, found


def _label_ids(
    semantic_map: SemanticMap, rows: Sequence[int], found: Sequence[tuple[Proposal, ...]]
) -> list[tuple[str, ...]]:
    """Return the ids of label elements of each track, no id twice.

    Elements that map building split off have the ids of the element that they come from. They get
    one of their own, from their first detection.
    """
    used: set[str] = set()
    label_ids = []
    for row, detections in zip(rows, found, strict=True):
        new = tuple(id_ for id_ in semantic_map.provenance[row].label_ids if id_ not in used)
        label_ids.append(new or (derived_id(f"track {detections[0].id} split"),))
        used.update(new)
    return label_ids


def _track(
    semantic_map: SemanticMap,
    row: int,
    label_ids: tuple[str, ...],
    detections: tuple[Proposal, ...],
    residuals_px: tuple[float, ...],
) -> DetectionTrack:
    map_id, class_id = (
        int(column[row]) for column in (semantic_map.elements.id, semantic_map.elements.class_id)
    )
    return DetectionTrack(
        id=label_ids[0],
        name=semantic_map.classes.element_name(class_id, map_id),
        map_id=map_id,
        class_id=class_id,
        label_ids=label_ids,
        detections=detections,
        log_odds=semantic_map.provenance[row].log_odds,
        residuals_px=residuals_px,
    )


def _residuals_px(
    elements: Elements3D,
    rows: Sequence[int],
    found: Sequence[tuple[Proposal, ...]],
    cameras: Cameras,
) -> list[tuple[float, ...]]:
    """Return the residual (px) of each detection of each track; all of an image at once."""
    in_image: dict[tuple[int, Side], list[tuple[int, int]]] = defaultdict(list)
    for n, detections in enumerate(found):
        for k, row in enumerate(detections):
            in_image[row.frame_index, row.side].append((n, k))
    off_px = [np.zeros(len(detections)) for detections in found]
    for image, here in in_image.items():
        at = np.array([rows[n] for n, _ in here])
        ends_m = np.stack([elements.anchor_m[at], elements.end_m[at]], axis=1)
        marks_px = both_ends_px([mark_of(found[n][k]) for n, k in here])
        projected = cameras.view(*image).project(ends_m.reshape(-1, 3)).reshape(-1, 2, 2)
        for (n, k), square in zip(here, _squares_px2(projected, marks_px), strict=True):
            off_px[n][k] = np.sqrt(square)
    return [tuple(off.tolist()) for off in off_px]


def _squares_px2(projected: FloatArray, marks_px: FloatArray) -> FloatArray:
    """Return mean squares (n,) of ends (n, 2, 2) across projected poles, or of signs' centres."""
    centers = np.square(projected[:, 0] - marks_px[:, 0]).sum(axis=1)
    is_line = np.isfinite(marks_px[:, 1, 0]) & np.isfinite(projected[:, 1, 0])
    across = [
        np.square(across_px(line, ends)).mean() if poles else np.inf
        for line, ends, poles in zip(projected, marks_px, is_line, strict=True)
    ]
    return np.where(np.isnan(marks_px[:, 1, 0]), centers, across)


class OpenTracks:
    """Follows which tracks are open while labels change: an edit affects few of thousands."""

    def __init__(self, tracks: DetectionTracks) -> None:
        self.tracks = tracks
        self._about: dict[str, list[int]] = defaultdict(list)
        """Places of the tracks that a label element settles."""
        self._in_frame: dict[int, list[int]] = defaultdict(list)
        for place, track in enumerate(tracks.tracks):
            for label_id in track.label_ids:
                self._about[label_id].append(place)
            for frame_index in track.frames:
                self._in_frame[frame_index].append(place)
        self._labels: Labels | None = None
        self._open: set[int] = set()
        self._sorted: tuple[int, ...] = ()

    def of(self, labels: Labels) -> tuple[DetectionTrack, ...]:
        """Return the open tracks, the least sure first."""
        return tuple(self.tracks.tracks[place] for place in self.places(labels))

    def sure(self, labels: Labels) -> tuple[DetectionTrack, ...]:
        """Return the open tracks that one operation may accept together."""
        return tuple(track for track in self.of(labels) if track.is_sure)

    def places(self, labels: Labels) -> tuple[int, ...]:
        """Return the places of the open tracks."""
        if labels is not self._labels:
            for place in self._affected(labels):
                if is_open(self.tracks.tracks[place], labels):
                    self._open.add(place)
                else:
                    self._open.discard(place)
            self._labels = labels
            self._sorted = tuple(sorted(self._open))
        return self._sorted

    def named(self, track_ids: Iterable[str], labels: Labels) -> list[tuple[int, DetectionTrack]]:
        """Return the open tracks among some ids, with their places."""
        self.places(labels)
        places = (place for id_ in track_ids for place in self._about.get(id_, ()))
        return [(place, self.tracks.tracks[place]) for place in places if place in self._open]

    def project(self, view: PosedView, labels: Labels) -> FloatArray:
        """Return the pixels (n, 2, 2) of anchors and ends of open tracks within ``REACH_M``."""
        elements = self.tracks.elements[np.array(self.places(labels), dtype=np.int64)]
        depth_m = view.depth_m(elements.anchor_m)
        near = elements[np.flatnonzero((depth_m > 0.5) & (depth_m < REACH_M))]
        ends_m = np.stack([near.anchor_m, near.end_m], axis=1)
        return view.project(ends_m.reshape(-1, 3)).reshape(-1, 2, 2)

    def is_open(self, track: DetectionTrack | None, labels: Labels) -> bool:
        """Return whether a track of this map is open."""
        if track is None:
            return False
        return bool(self.named([track.id], labels))

    def _affected(self, labels: Labels) -> Iterable[int]:
        """The tracks that changes since the last labels may have opened or closed."""
        before = self._labels
        if before is None:
            return range(len(self.tracks.tracks))
        changed = labels.differing(before)
        frames = {
            row.frame_index
            for state in (before, labels)
            for element_id in changed
            for row in state.of_element(element_id)
        }
        frames |= _differing_dismissals(before, labels)
        affected = {place for id_ in changed for place in self._about.get(id_, ())}
        return affected.union(*(self._in_frame.get(index, ()) for index in frames))


def _differing_dismissals(before: Labels, labels: Labels) -> set[int]:
    """The frames in which dismissals differ."""
    changed = SharedDict.of(labels.dismissals).differing(SharedDict.of(before.dismissals))
    rows = (state.dismissals.get(id_) for state in (before, labels) for id_ in changed)
    return {row.frame_index for row in rows if row is not None}


def is_open(track: DetectionTrack, labels: Labels) -> bool:
    """Return whether a track waits for a person: see the module."""
    if any(label_id in labels.elements for label_id in track.label_ids):
        return False
    return next(free_detections(track.detections, labels), None) is not None


def free_detections(detections: Iterable[Proposal], labels: Labels) -> Iterator[Proposal]:
    """Iterate over the detections that are neither labelled nor dismissed.

    A label of any element on a detection means that the image is decided there.
    """
    for detection in detections:
        if detection.id in labels.observations or detection.id in labels.dismissals:
            continue
        rows = labels.in_frame(detection.frame_index, detection.side)
        if rows:
            gaps = gaps_px(both_ends_px([mark_of(detection)]), both_ends_px(map(Mark.of, rows)))
            if (gaps < DETECTED_PX).any():
                continue
        yield detection
