"""The detections of a drive beside its labels, and which of them the labels explain.

Labels win: a detection on a label of its image, or of a labelled landmark, is not searched again.
Detections of what a person left out are searched, and their tracks rejected afterwards: so a
rejection takes nothing from other tracks. A rejected track is recognized by its detections. Another
detector's is recognized by lying on the labels of the rejected one, and one of another pass by
where it stands. Two tracks that one image shows apart are two objects, however near they stand.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from semviz_annotation.labels.labels import LabelElement, Labels, Observation
from semviz_annotation.labels.proposal import Proposal
from semviz_annotation.labels.rows import Row, derived_id
from semviz_annotation.mapping.association.candidates import LandmarkPositions, ground_positions
from semviz_annotation.mapping.association.ground_rays import (
    DriveImages,
    GroundRays,
    marks_on_camera,
)
from semviz_annotation.mapping.association.merging import LinkOptions
from semviz_annotation.mapping.association.nodes import ReviewConstraints, spans
from semviz_annotation.mapping.association.shared_observations import (
    CandidateExplanations,
    nearby_explanations,
)
from semviz_annotation.mapping.placement.landmarks import Landmarks
from semviz_annotation.mapping.placement.observations import (
    LabelObservations,
    ObservationArray,
    gather_observations,
)
from semviz_annotation.mapping.placement.triangulation import triangulate_landmarks
from semviz_core.base.frame import Dataset
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray

TRACK_NUMBER = 100_000
"""Tracks of detections are numbered from here on, by their first frame."""
FREE, REJECTED, LABELLED, NO_LANDMARK = -1, -2, -3, -4
"""Instead of the track of a detection."""
_STEP_M = 0.3
"""Frames nearer to each other show no landmark from elsewhere."""
_LEAST_SIGMA_PX = 0.3
"""No detector is known to be more precise."""
_ON_LABEL_PX, _ON_LABEL_SIGMAS = 5.0, 3.0
"""A detection is on a label if it is this near, whatever the two agree on."""


@dataclass(frozen=True, eq=False)
class DetectedDrive:
    """The labels, and each detection as an element of its own; k observations of both."""

    gathered: LabelObservations
    """The elements of labels come first, then one for each detection."""
    link: LinkOptions
    left_out: BoolArray
    """(n,) label elements that a person left out"""
    left_out_with: IntArray
    """(k,) the label element (row of n) that was left out with this detection, or -1; its label
    stands beside the detection"""
    placed: Landmarks
    """The landmarks of the n label elements."""
    rays: GroundRays
    """of all k observations"""
    images: DriveImages
    sigma_ratio: dict[str, tuple[float, float]]
    """For ``collect_observations``, by id of the detection."""

    @classmethod
    def of(
        cls,
        labels: Labels,
        detections: Sequence[Proposal],
        source: Dataset,
        link: LinkOptions,
        frames: Collection[int] | None,
    ) -> "DetectedDrive":
        """Gather ``labels`` and ``detections``, by image, in ``frames`` (None: all).

        A detection that is a label, too, was left out with it.
        """
        number = max(TRACK_NUMBER, labels.next_number)
        rows: list[Row] = list(labels.rows())
        beside = {
            row.id: derived_id(f"beside {row.id}")
            for row in detections
            if row.id in labels.observations
        }
        detections = [replace(row, id=beside.get(row.id, row.id)) for row in detections]
        for row, detection in enumerate(detections):
            rows.append(LabelElement(detection.id, number + row, detection.class_id))
            rows.append(as_observation(detection))
        sigma_ratio = {row.id: sigma_ratio_of(row, link.place.sigma_px) for row in detections}
        gathered = gather_observations(Labels.from_rows(rows), source, frames, sigma_ratio)
        views, observations = gathered.views, gathered.observations
        elements = tuple(element for element in gathered.elements if element.number < number)
        label_of = {
            beside[row.id]: label
            for row, label in zip(gathered.label_rows, observations.landmark.tolist(), strict=True)
            if row.id in beside
        }
        is_label = np.arange(observations.count) < len(elements)
        cameras = (source.rig.left, source.rig.right or source.rig.left)
        sizes_px = np.array([(camera.width, camera.height) for camera in cameras], dtype=np.float64)
        return cls(
            gathered=gathered,
            link=link,
            left_out=ReviewConstraints.of(labels, elements).left_out,
            left_out_with=np.array(
                [label_of.get(row.id, -1) for row in gathered.label_rows], dtype=np.int64
            ),
            placed=triangulate_landmarks(views, observations.only(is_label), link.place),
            rays=GroundRays.of(views, observations, link.place.sigma_px),
            images=DriveImages.of(views, sizes_px[views.is_right.astype(np.int64)], _STEP_M),
            sigma_ratio=sigma_ratio,
        )

    @property
    def is_detection(self) -> BoolArray:
        """(k,)"""
        return np.asarray(self.gathered.observations.landmark >= len(self.left_out))

    @property
    def class_id(self) -> IntArray:
        """(k,)"""
        kinds = np.array([element.class_id for element in self.gathered.elements], dtype=np.int64)
        return kinds[self.gathered.observations.landmark]

    def lines_only(self, rows: IntArray) -> ObservationArray:
        """Return the observations in rows (m,), each of a landmark of its own, with unknown ends:
        a detector's ends may be far off."""
        alone = self.gathered.observations.taken(rows, np.arange(len(rows)), len(rows))
        nothing = np.zeros(len(rows), dtype=np.bool_)
        return replace(alone, anchor_known=nothing, end_known=nothing)

    def explained(
        self, rows: IntArray, kind_of: IntArray, placed: Landmarks, kind: IntArray, pose_m: float
    ) -> tuple[CandidateExplanations, FloatArray]:
        """Return which landmarks of the same ``kind`` (n,) observations in rows (m,), of
        ``kind_of`` (m,), fit, and the log-likelihood of each such pair."""
        views, observations = self.gathered.views, self.lines_only(rows)
        link = replace(self.link, pose_sigma_m=pose_m)
        claims = nearby_explanations(views, observations, kind_of, placed, kind, link)
        fits, score = claims.tested(views, observations, LandmarkPositions.of(placed), link)
        return claims.where(fits), score[fits]

    def initial_owner(self) -> IntArray:
        """Return for each observation (k,) whether it is ``FREE``, ``LABELLED``, or
        ``NO_LANDMARK`` (a mark on the camera).

        Labels of elements without a position are free: a track may give them one.
        """
        observations = self.gathered.observations
        rows = np.flatnonzero(self.is_detection)
        owner = np.where(self.is_detection, FREE, LABELLED)
        marks = marks_on_camera(
            observations,
            rows,
            self.class_id[rows],
            self.gathered.views,
            self.images,
            self.link.place.sigma_px,
        )
        owner[rows[marks]] = NO_LANDMARK
        owner[self.of_labels(~self.left_out, self.link.pose_sigma_m)] = LABELLED
        unplaced = np.append(~self.placed.ok, False)
        unplaced[self.left_out_with[self.left_out_with >= 0]] = False
        last = len(self.left_out)
        owner[unplaced[np.minimum(observations.landmark, last)]] = FREE
        return owner

    def of_labels(self, some: BoolArray, pose_m: float) -> IntArray:
        """Return the detections on labels of ``some`` label elements (n,), or in line with their
        landmarks, with poses ``pose_m`` off."""
        observations, is_line = self.gathered.observations, self.gathered.observations.is_line
        rows = np.flatnonzero(self.is_detection)
        kind_of = is_line[rows].astype(np.int64)
        kind = observations.of(is_line)[: len(some)].astype(np.int64)
        failure = np.where(some, self.placed.failure, "not asked for")
        placed = replace(self.placed, failure=failure)
        claims, _ = self.explained(rows, kind_of, placed, kind, pose_m)
        detection, label = self.on_labels()
        on = some[observations.landmark[label]]
        return np.concatenate([rows[claims.observation], detection[on]])

    def on_labels(self) -> tuple[IntArray, IntArray]:
        """Return pairs (p,) of a detection and a label that it lies on."""
        observations = self.gathered.observations
        labels = np.flatnonzero(~self.is_detection)
        labels = labels[np.argsort(observations.view[labels], kind="stable")]
        rows = np.flatnonzero(self.is_detection)
        view = observations.view[labels]
        first, last = (
            np.searchsorted(view, observations.view[rows], side=side) for side in ("left", "right")
        )
        label, pair = spans(first, last)
        label, detection = labels[label], rows[pair]
        near = _distance_px(observations, detection, label)
        sigma_px = self.link.place.sigma_px * observations.sigma_ratio[detection, 0]
        on = near <= _ON_LABEL_PX + _ON_LABEL_SIGMAS * sigma_px
        return detection[on], label[on]


def sigma_ratio_of(detection: Proposal, sigma_px: float) -> tuple[float, float]:
    """Return the sigmas of a detection, across and along, in multiples of ``sigma_px``."""
    along_px = detection.sigma_along_px or detection.sigma_px
    return (
        max(detection.sigma_px, _LEAST_SIGMA_PX) / sigma_px,
        max(along_px, _LEAST_SIGMA_PX) / sigma_px,
    )


def as_observation(detection: Proposal) -> Observation:
    """Return a detection as an observation of an element of its own; both have its id."""
    return Observation(
        id=detection.id,
        element_id=detection.id,
        frame_index=detection.frame_index,
        side=detection.side,
        anchor_px=detection.anchor_px,
        end_px=detection.end_px,
        anchor_known=detection.anchor_known,
        end_known=detection.end_known,
    )


def _distance_px(
    observations: ObservationArray, detection: IntArray, label: IntArray
) -> FloatArray:
    """Return the distances (p,) of detections from labels: of signs, of their centres; of poles,
    across the label in the middle of what both show of it. Infinite if they show no common part."""
    start, along = observations.anchor_px[label], observations.end_px[label]
    line = np.nan_to_num(along - start, nan=1.0)
    squared = np.maximum((line**2).sum(axis=1), 1e-9)

    def share(points: FloatArray) -> FloatArray:
        return np.asarray(((points - start) * line).sum(axis=1) / squared)

    ends = observations.anchor_px[detection], observations.end_px[detection]
    first, last = np.sort(np.stack([share(end) for end in ends]), axis=0)
    low, high = np.maximum(first, 0.0), np.minimum(last, 1.0)
    mixed = ((low + high) / 2.0 - share(ends[0])) / np.where(
        share(ends[1]) == share(ends[0]), 1.0, share(ends[1]) - share(ends[0])
    )
    point = ends[0] + mixed[:, None] * (ends[1] - ends[0]) - start
    across = np.abs(point[:, 0] * line[:, 1] - point[:, 1] * line[:, 0]) / np.sqrt(squared)
    is_line = observations.is_line
    both, neither = is_line[detection] & is_line[label], ~is_line[detection] & ~is_line[label]
    centres = np.linalg.norm(ends[0] - start, axis=1)
    return np.where(both & (low < high), across, np.where(neither, centres, np.inf))


_POSE_M = 0.15
"""Detections of a rejected landmark are recognized with poses this far off, of another pass ..."""
_NEAR_M, _SIGMAS = 0.25, 2.0
"""... and tracks that stand this near to it, or within so many sigmas."""
_SHARE = 0.5
"""A track is the rejected one with this share of its detections, or if this share of its own are
among them."""


def without_rejected(drive: DetectedDrive, owner: IntArray, tracks: Landmarks) -> IntArray:
    """Return the owner (k,) of the observations when ``tracks`` (t,) of what was left out, and the
    free detections of it, are rejected."""
    same = _same_detections(drive, owner, len(tracks.failure))
    lost = same | _same_place(drive, owner, tracks)
    owner = np.where(np.append(lost, [False] * 4)[owner] & drive.is_detection, REJECTED, owner)
    rows = drive.of_labels(drive.left_out, _POSE_M)
    owner[rows[owner[rows] == FREE]] = REJECTED
    owner[drive.left_out_with >= 0] = REJECTED
    return owner


def _same_detections(drive: DetectedDrive, owner: IntArray, count: int) -> BoolArray:
    """Return which tracks (count,) consist of what was left out."""
    observations, n = drive.gathered.observations, len(drive.left_out)
    element = drive.left_out_with.copy()
    detection, label = drive.on_labels()
    known = np.isin(observations.landmark[label], element[element >= 0])
    new = drive.left_out[observations.landmark[label]] & ~known
    element[detection[new]] = observations.landmark[label[new]]
    rows = np.flatnonzero((owner >= 0) & (element >= 0))
    pair, shared = np.unique(owner[rows] * n + element[rows], return_counts=True)
    detections = np.bincount(owner[(owner >= 0) & drive.is_detection], minlength=count)
    few = np.minimum(detections[pair // n], observations.seen[pair % n])
    result = np.zeros(count, dtype=np.bool_)
    result[(pair // n)[shared >= _SHARE * few]] = True
    unplaced = np.flatnonzero((owner >= 0) & ~drive.is_detection)
    result[owner[unplaced[drive.left_out[observations.landmark[unplaced]]]]] = True
    return result


def _same_place(drive: DetectedDrive, owner: IntArray, tracks: Landmarks) -> BoolArray:
    """Return which ``tracks`` (t,) stand where a landmark was left out, and are not seen beside
    it."""
    from scipy.spatial import cKDTree

    result = np.zeros(len(tracks.failure), dtype=np.bool_)
    rejected = np.flatnonzero(drive.left_out & drive.placed.ok)
    ok = np.flatnonzero(tracks.ok)
    if not len(rejected) or not len(ok):
        return result
    at_m, _, sigma_m = ground_positions(drive.placed)
    track_m, _, track_sigma_m = ground_positions(tracks)
    reach = _NEAR_M + _SIGMAS * (track_sigma_m[ok] + sigma_m[rejected].max())
    near = cKDTree(at_m[rejected]).query_ball_point(track_m[ok], reach)
    beside = _seen_beside(drive, owner)
    for track, others in zip(ok.tolist(), near, strict=True):
        for other in rejected[np.asarray(others, dtype=np.int64)].tolist():
            if (track, other) not in beside:
                result[track] |= _is_near(tracks, track, drive.placed, other)
    return result


def _seen_beside(drive: DetectedDrive, owner: IntArray) -> set[tuple[int, int]]:
    """Return the pairs of a track and a left-out element that one image shows apart."""
    view = drive.gathered.observations.view
    rejected = np.flatnonzero(drive.left_out_with >= 0)
    shown: dict[int, set[int]] = {}
    for row in rejected.tolist():
        shown.setdefault(int(view[row]), set()).add(int(drive.left_out_with[row]))
    rows = np.flatnonzero((owner >= 0) & drive.is_detection & (drive.left_out_with < 0))
    return {
        (int(owner[row]), element)
        for row in rows[np.isin(view[rows], view[rejected])].tolist()
        for element in shown[int(view[row])]
    }


def _is_near(tracks: Landmarks, track: int, placed: Landmarks, other: int) -> bool:
    """Return whether a track and a landmark, both poles or both signs, may be one."""
    is_line = np.isfinite([tracks.end_m[track, 0], placed.end_m[other, 0]])
    if is_line[0] != is_line[1]:
        return False
    both = [(landmarks, row) for landmarks, row in ((tracks, track), (placed, other))]
    positions, spreads = zip(*(_position(*one, is_line[0]) for one in both), strict=True)
    away = positions[0] - positions[1]
    spread = spreads[0] + spreads[1] + (_NEAR_M / _SIGMAS) ** 2 * np.eye(len(away))
    return bool(away @ np.linalg.solve(spread, away) <= _SIGMAS**2)


def _position(landmarks: Landmarks, row: int, is_line: bool) -> tuple[FloatArray, FloatArray]:
    """Return where a pole stands on the ground plane, or a sign hangs, with its covariance."""
    if not is_line:
        return landmarks.anchor_m[row], landmarks.covariance_m2[row, :3, :3]
    half = np.hstack([np.eye(2, 3), np.eye(2, 3)]) / 2.0
    middle = (landmarks.anchor_m[row, :2] + landmarks.end_m[row, :2]) / 2.0
    return middle, half @ landmarks.covariance_m2[row] @ half.T
