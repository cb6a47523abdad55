"""Tracks of what a person left out: found like all others, and then given up.

A rejected track is recognized by its detections. Another detector's is recognized by lying on the
labels of the rejected one, and one of another pass by where it stands. Two tracks that one image
shows apart are two objects, however near they stand.
"""

import numpy as np

from semviz_annotation.mapping.association.candidates import ground_positions
from semviz_annotation.mapping.association.detected_drive import FREE, REJECTED, DetectedDrive
from semviz_annotation.mapping.placement.landmarks import Landmarks
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray

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
