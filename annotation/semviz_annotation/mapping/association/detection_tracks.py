"""Detections of a drive as label elements: one for each landmark that they have in common.

Detections that labels do not explain are searched for tracks. Each track is added to the
labels, in memory, as a label element whose observations have the ids of its detections. So map
building, decisions and lint treat labels and detections alike.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from semviz_annotation.labels.detections import calibrated
from semviz_annotation.labels.labels import LabelElement, Labels, Observation
from semviz_annotation.labels.proposal import Proposal
from semviz_annotation.labels.proposals import Proposals
from semviz_annotation.labels.rows import Row, derived_id
from semviz_annotation.mapping.association.detected_drive import (
    FREE,
    LABELLED,
    NO_LANDMARK,
    REJECTED,
    TRACK_NUMBER,
    DetectedDrive,
    as_observation,
    sigma_ratio_of,
    without_rejected,
)
from semviz_annotation.mapping.association.ground_rays import (
    AgreedEnds,
    DriveImages,
    GroundRays,
    agreed_ends,
    moving_tracks,
)
from semviz_annotation.mapping.association.merging import LinkOptions
from semviz_annotation.mapping.association.track_search import SearchOptions, search_tracks
from semviz_annotation.mapping.placement.landmarks import Landmarks
from semviz_annotation.mapping.placement.observations import (
    ObservationArray,
    gather_observations,
)
from semviz_annotation.mapping.placement.triangulation import PlaceOptions, triangulate_landmarks
from semviz_core.base.detector_model import DetectorCalibration
from semviz_core.base.frame import Dataset
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.progress import OnCount, unwatched

__all__ = [
    "TRACK_NUMBER",
    "DetectionCounts",
    "JoinedDetections",
    "LabelsOfMap",
    "TrackOptions",
    "detection_labels",
    "labels_of_map",
]

MIN_FRAMES, SPARSE_M = (4, 3), 1.8
"""How many frames must detect a landmark by default, and how many where one camera's lie so far
apart: few show what is near, and there are fewer false detections to agree by chance. Two cameras
see enough, and repeat false ones (docs/results/mapping.md, 'bench/own_maps.py')."""
_NOWHERE: FloatArray = np.full(2, np.nan)
_WITHIN_A_PASS = 0.4
"""Error of poses from frame to frame, relative to that between two passes."""


@dataclass(frozen=True)
class TrackOptions:
    """Which detections become landmarks."""

    least_score: float = 0.0
    """Detections with a lower score are not used."""
    min_frames: int | None = None
    """Least number of frames, at positions of their own, that detect a landmark; None:
    ``MIN_FRAMES``, by how far the frames lie apart."""
    calibration: DetectorCalibration | None = None
    """Scores, sigmas and rates of the detector; None: as it gave them, with assumed rates."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.least_score <= 1.0:
            raise SemvizError(f"score {self.least_score:g}: give a number from 0 to 1")
        if self.min_frames is not None and self.min_frames < 2:
            raise SemvizError(f"min_frames {self.min_frames}: a track needs 2 frames or more")

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> "TrackOptions":
        """Return the options of ``as_json``. Raise TypeError or ValueError if they are invalid."""
        calibration = values.get("calibration")
        if calibration is None:
            return cls(**values)
        return cls(**dict(values) | {"calibration": DetectorCalibration(**calibration)})

    def as_json(self) -> dict[str, Any]:
        """Return JSON values; what has its default is not named."""
        values: dict[str, Any] = {"least_score": self.least_score}
        if self.min_frames is not None:
            values["min_frames"] = self.min_frames
        if self.calibration is not None:
            values["calibration"] = self.calibration.model_dump(mode="json")
        return values

    def search(
        self, images: DriveImages, searched: BoolArray, pose_sigma_m: float
    ) -> SearchOptions:
        """Return how tracks are searched in the ``searched`` (v,) images, with poses
        ``pose_sigma_m`` off from frame to frame."""
        search = SearchOptions(self._min_frames(images, searched), pose_sigma_m)
        if self.calibration is None:
            return search
        return search.of_detector(self.calibration.detector_model(self.least_score))

    def _min_frames(self, images: DriveImages, searched: BoolArray) -> int:
        if self.min_frames is not None:
            return self.min_frames
        shown = images.is_key & searched
        at_m = np.unique(images.path_m[shown])
        one_camera = len(at_m) == shown.sum() > 1
        return MIN_FRAMES[int(one_camera and float(np.median(np.diff(at_m))) >= SPARSE_M)]


@dataclass(frozen=True)
class DetectionCounts:
    """What became of the detections."""

    detections: int
    labelled: int
    """Of what is labelled."""
    rejected: int
    """Of what a person left out."""
    tracked: int
    alone: int
    """Of nothing that enough others show."""
    no_landmark: int
    """At one pixel all the time, or of something that moves."""
    tracks: int
    unknown_ends: int
    """Ends of poles that do not fit the height that others show."""

    def __str__(self) -> str:
        return (
            f"{self.detections} detections: {self.tracked} in {self.tracks} tracks, {self.alone} "
            f"that too few others agree with, {self.no_landmark} of the camera or of what moves, "
            f"{self.labelled} of labelled and {self.rejected} of rejected landmarks; "
            f"{self.unknown_ends} ends are not where others show them"
        )


class JoinedDetections(NamedTuple):
    """Labels and tracks of detections together."""

    labels: Labels
    """The labels, and each track as a label element."""
    sigma_ratio: dict[str, tuple[float, float]]
    """For ``collect_observations``, by observation id."""
    log_odds: dict[str, float]
    """Log-odds that the landmark of a track exists, by id of its label element."""
    min_frames: int
    """So many frames detect each track, or more."""
    counts: DetectionCounts


class LabelsOfMap(NamedTuple):
    """Labels, and the tracks of a map of detections, as the map was built from them."""

    labels: Labels
    sigma_ratio: dict[str, tuple[float, float]]
    """For ``collect_observations``, by id of the detection."""


def detection_labels(
    labels: Labels,
    detections: Proposals,
    source: Dataset,
    link: LinkOptions,
    options: TrackOptions = TrackOptions(),
    frames: Collection[int] | None = None,
    on_progress: OnCount = unwatched,
) -> JoinedDetections:
    """Return ``labels`` joined with the tracks of ``detections`` in ``frames`` (None: all).

    Detections in frames without a pose do not count. Raise SemvizError like
    ``collect_observations``.
    """
    if options.calibration is not None:
        detections = calibrated(detections, options.calibration)
    chosen = _chosen(labels, detections, source, options, frames)
    drive = DetectedDrive.of(labels, chosen, source, link, frames)
    searched = _searched(drive, detections)
    search = options.search(drive.images, searched, _WITHIN_A_PASS * link.pose_sigma_m)
    tracks = _search(drive, searched, search, on_progress)
    tracks = _without_moving(drive, searched, tracks)
    tracks = _with_the_rest(drive, tracks)
    tracks = _without_rejected(drive, tracks)
    return _joined(labels, drive, tracks, search.min_frames)


def _chosen(
    labels: Labels,
    detections: Proposals,
    source: Dataset,
    options: TrackOptions,
    frames: Collection[int] | None,
) -> list[Proposal]:
    """Return the detections to use, by image, with those of what was left out of maps; accepted
    ones are labels already."""
    posed = {frame.index for frame in source.frames if frame.T_map_camera is not None}
    usable = posed if frames is None else posed & set(frames)
    good = np.isin(detections.frame_index, sorted(usable))
    good &= detections.score >= options.least_score
    center = labels.triangle_center
    rows = (detections[row].following(center) for row in np.flatnonzero(good).tolist())
    known = labels.without_left_out().observations.keys() | labels.dismissals.keys()
    new = (row for row in rows if row.id not in known)
    return sorted(new, key=lambda row: (row.frame_index, row.side, row.id))


def _searched(drive: DetectedDrive, detections: Proposals) -> BoolArray:
    """Return which images (v,) a detector has processed; if that is not known, those where it
    found something."""
    views = drive.gathered.views
    if detections.processed is None:
        shown = drive.gathered.observations.view[drive.is_detection]
        return np.isin(np.arange(len(views)), shown)
    images = detections.processed.images
    return np.array(
        [
            (index, "right" if is_right else "left") in images
            for index, is_right in zip(
                views.frame_index.tolist(), views.is_right.tolist(), strict=True
            )
        ],
        dtype=np.bool_,
    )


class _Tracks(NamedTuple):
    """t tracks of k observations."""

    owner: IntArray
    """(k,) track, or ``FREE``, ``LABELLED``, ``REJECTED`` or ``NO_LANDMARK``"""
    at_m: FloatArray
    """(t, 2)"""
    log_odds: FloatArray
    """(t,)"""


def _search(
    drive: DetectedDrive,
    searched: BoolArray,
    options: SearchOptions,
    on_progress: OnCount,
) -> _Tracks:
    """Return the tracks of what labels do not explain."""
    owner = drive.initial_owner()
    rows = np.flatnonzero(owner == FREE)
    found = search_tracks(
        drive.rays.taken(rows),
        drive.gathered.observations.view[rows],
        drive.class_id[rows],
        drive.images,
        searched,
        options,
        on_progress,
    )
    owner[rows] = np.where(found.track >= 0, found.track, FREE)
    return _Tracks(owner, found.at_m, found.log_odds)


def _without_moving(drive: DetectedDrive, searched: BoolArray, tracks: _Tracks) -> _Tracks:
    """Give up the tracks that only one of two cameras sees, except of what is labelled."""
    view = drive.gathered.observations.view
    moving = moving_tracks(
        drive.gathered.views, drive.images, searched, view, tracks.owner, tracks.at_m
    )
    moving[tracks.owner[(tracks.owner >= 0) & ~drive.is_detection]] = False
    lost = np.append(moving, [False] * 4)[tracks.owner]
    return tracks._replace(owner=np.where(lost, NO_LANDMARK, tracks.owner))


def _without_rejected(drive: DetectedDrive, tracks: _Tracks) -> _Tracks:
    """Give up the tracks of landmarks that a person left out."""
    if not drive.left_out.any():
        return tracks
    _, placed = _placed(drive, tracks)
    return tracks._replace(owner=without_rejected(drive, tracks.owner, placed))


def _placed(drive: DetectedDrive, tracks: _Tracks) -> tuple[ObservationArray, Landmarks]:
    """Return the observations of the tracks, with the ends that agree, and their landmarks."""
    observations = drive.gathered.observations
    ends = agreed_ends(drive.rays, tracks.owner, tracks.at_m)
    agreed = replace(observations, anchor_known=ends.known[:, 0], end_known=ends.known[:, 1])
    grouped = agreed.regrouped(np.maximum(tracks.owner, -1), len(tracks.at_m))
    place = replace(drive.link.place, min_angle_rad=0.0)
    return grouped, triangulate_landmarks(drive.gathered.views, grouped, place)


def _with_the_rest(drive: DetectedDrive, tracks: _Tracks) -> _Tracks:
    """Add the free detections that fit a track, in images where it has none."""
    grouped, placed = _placed(drive, tracks)
    rows = np.flatnonzero((tracks.owner == FREE) & drive.is_detection)
    kind = np.full(len(tracks.at_m), -1)
    kind[grouped.landmark] = drive.class_id[grouped.label_row]
    claims, score = drive.explained(
        rows, drive.class_id[rows], placed, kind, drive.link.pose_sigma_m
    )
    view = drive.gathered.observations.view
    v = len(drive.gathered.views)
    cell = claims.landmark * v + view[rows[claims.observation]]
    score[np.isin(cell, grouped.landmark * v + grouped.view)] = -np.inf
    owner = tracks.owner.copy()
    taken: set[int] = set()
    for pair in np.argsort(-score, kind="stable")[: np.isfinite(score).sum()].tolist():
        row = rows[claims.observation[pair]]
        if owner[row] == FREE and int(cell[pair]) not in taken:
            owner[row] = claims.landmark[pair]
            taken.add(int(cell[pair]))
    return tracks._replace(owner=owner)


def _joined(
    labels: Labels, drive: DetectedDrive, tracks: _Tracks, min_frames: int
) -> JoinedDetections:
    """Return the labels with each track as a label element."""
    gathered, owner = drive.gathered, tracks.owner
    ends = agreed_ends(drive.rays, owner, tracks.at_m)
    rows: list[Row] = list(labels.rows())
    sigma_ratio: dict[str, tuple[float, float]] = {}
    log_odds: dict[str, float] = {}
    number = max(TRACK_NUMBER, labels.next_number)
    detected = np.flatnonzero((owner >= 0) & drive.is_detection)
    labelled = np.flatnonzero((owner >= 0) & ~drive.is_detection)
    first = {int(owner[row]): row for row in detected[::-1].tolist()}
    named = {int(owner[row]): row for row in labelled[::-1].tolist()}
    element_ids = {
        track: gathered.elements[gathered.observations.landmark[row]].id
        for track, row in named.items()
    }
    for track in sorted(first, key=lambda track: first[track]):
        if track in named:
            continue
        element_ids[track] = _track_id(gathered.label_rows[first[track]].id, labels)
        class_id = int(drive.class_id[first[track]])
        rows.append(LabelElement(element_ids[track], number, class_id))
        log_odds[element_ids[track]] = float(tracks.log_odds[track])
        number += 1
    for row in detected.tolist():
        detection, element_id = gathered.label_rows[row], element_ids[int(owner[row])]
        if labels.find(element_id, detection.frame_index, detection.side) is not None:
            continue
        rows.append(_observation(detection, element_id, ends.known[row]))
        across, along = drive.sigma_ratio[detection.id]
        sigma_ratio[detection.id] = across, along * float(ends.spread[row])
    joined = labels.with_rows(rows)
    counts = _counts(drive, tracks, ends, log_odds)
    return JoinedDetections(joined, sigma_ratio, log_odds, min_frames, counts)


def labels_of_map(
    labels: Labels, semantic_map: SemanticMap, detections: Proposals, source: Dataset
) -> LabelsOfMap:
    """Return ``labels`` with the tracks of a map of detections, as the map was built from them.

    Tracks of detections that are gone, or labels by now, are left out. As in building, an end that
    the other detections of its pole contradict is unknown.
    """
    row_of = {id_: row for row, id_ in enumerate(detections.id)}
    rows: list[Row] = list(labels.rows())
    seen: list[Proposal] = []
    at_m: dict[int, FloatArray] = {}
    elements = semantic_map.elements
    for row, (number, class_id) in enumerate(
        zip(elements.id.tolist(), elements.class_id.tolist(), strict=True)
    ):
        origin = semantic_map.provenance[row]
        new = [
            detections[row_of[id_]].following(labels.triangle_center)
            for id_ in origin.observation_ids
            if id_ in row_of and id_ not in labels.observations
        ]
        labelled = [id_ for id_ in origin.label_ids if id_ in labels.elements]
        element_id = (labelled or origin.label_ids)[0]
        if new and not labelled:
            rows.append(LabelElement(element_id, number, class_id))
            at_m[number] = elements.anchor_m[row, :2]
        rows += (replace(as_observation(found), element_id=element_id) for found in new)
        seen += new
    return _with_agreed_ends(labels.with_rows(rows), at_m, seen, source)


def _with_agreed_ends(
    labels: Labels, at_m: Mapping[int, FloatArray], seen: Sequence[Proposal], source: Dataset
) -> LabelsOfMap:
    """Return ``labels`` with unknown ends where others of their track contradict them.

    ``at_m`` tells where each track stands, by its number; ``seen`` are their detections.
    """
    if not at_m:
        return LabelsOfMap(labels, {})
    sigma_px = PlaceOptions().sigma_px
    ratios = {row.id: sigma_ratio_of(row, sigma_px) for row in seen}
    gathered = gather_observations(labels, source, sigma_ratio=ratios)
    places = np.array([at_m.get(element.number, _NOWHERE) for element in gathered.elements])
    track = gathered.observations.landmark
    track = np.where(np.isfinite(places[track, 0]), track, -1)
    ends = agreed_ends(
        GroundRays.of(gathered.views, gathered.observations, sigma_px), track, places
    )
    changed = {}
    for row in np.flatnonzero(track >= 0).tolist():
        label = gathered.label_rows[row]
        changed[label.id] = _observation(label, label.element_id, ends.known[row])
        across, along = ratios[label.id]
        ratios[label.id] = across, along * float(ends.spread[row])
    others = (row for row in labels.rows() if getattr(row, "id", None) not in changed)
    return LabelsOfMap(labels.with_rows([*others, *changed.values()]), ratios)


def _track_id(detection_id: str, labels: Labels) -> str:
    """Return the id of a track by its first detection, other than those of label elements."""
    track_id = derived_id(f"track {detection_id}")
    while track_id in labels.elements:
        track_id = derived_id(f"track {track_id}")
    return track_id


def _observation(detection: Observation, element_id: str, known: BoolArray) -> Observation:
    return replace(
        detection, element_id=element_id, anchor_known=bool(known[0]), end_known=bool(known[1])
    )


def _counts(
    drive: DetectedDrive, tracks: _Tracks, ends: AgreedEnds, log_odds: dict[str, float]
) -> DetectionCounts:
    owner = tracks.owner[drive.is_detection]
    return DetectionCounts(
        detections=len(owner),
        labelled=int((owner == LABELLED).sum()),
        rejected=int((owner == REJECTED).sum()),
        tracked=int((owner >= 0).sum()),
        alone=int((owner == FREE).sum()),
        no_landmark=int((owner == NO_LANDMARK).sum()),
        tracks=len(log_odds),
        unknown_ends=int((drive.rays.known & ~ends.known).sum()),
    )
