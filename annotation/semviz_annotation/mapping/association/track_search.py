"""Search for the landmarks that rays of detections have in common.

Each ray is cut into cells of inverse range, and every other image votes for the cells where one of
its rays passes. The cell with most votes is a candidate. It is refined by weighted least squares
over one ray per image, and rated: each ray is weighed against a false detection that happens to lie
there, each image without one against a missed detection. Candidates claim their rays in the order
of that rating, and the search is repeated on the rest. A false detection finds no such company.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from semviz_annotation.mapping.association.ground_rays import DriveImages, GroundRays
from semviz_annotation.mapping.association.ray_votes import (
    BIN_M,
    RayScene,
    claimed,
    refined,
    voted_ranges,
)
from semviz_core.base.detector_model import DetectorModel
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.progress import OnCount

_WINDOW_M = 60.0
"""Images farther than this before or after a detection along the drive are not searched: a second
pass makes a track of its own, and tracks are merged afterwards."""
_RECALL_RANGE = 0.02, 0.98
"""No landmark is missed, or found, for sure."""
_AT_ONCE = 2000
"""Number of rays searched at once, between two reports of progress."""


@dataclass(frozen=True)
class SearchOptions:
    """When rays have a landmark in common."""

    min_frames: int = 4
    """Least number of positions of the camera from which it is detected."""
    pose_sigma_m: float = 0.02
    """Error of poses in each direction from frame to frame."""
    least_log_odds: float = 3.0
    """Least log-odds that it exists."""
    most_sigma_m: float = 10.0
    """Largest standard deviation of its position, in the worst direction."""
    recall: tuple[float, ...] = (0.5, 0.5, 0.5, 0.5, 0.3, 0.2, 0.1, 0.1, 0.1)
    """Share of the landmarks in view that are detected, by range in bins of 10 m."""
    good_ends: tuple[float, float] = (0.7, 0.7)
    """Share of known tops and bottoms of poles that are where the detector says."""

    def of_detector(self, model: DetectorModel) -> "SearchOptions":
        """Return these options with the measured rates of a detector."""
        range_m = BIN_M * (np.arange(len(self.recall), dtype=np.float64) + 0.5)
        recall = np.clip(model.recall_at(range_m), *_RECALL_RANGE)
        top, bottom = self.good_ends
        return replace(
            self,
            recall=tuple(recall.tolist()),
            good_ends=(top, min(bottom, 1.0 - model.hidden_bottoms)),
        )


class FoundTracks(NamedTuple):
    """n tracks, and the track of each of k rays."""

    track: IntArray
    """(k,) -1 for none"""
    at_m: FloatArray
    """(n, 2) where they stand"""
    log_odds: FloatArray
    """(n,) that they exist"""


def search_tracks(
    rays: GroundRays,
    image: IntArray,
    kind: IntArray,
    images: DriveImages,
    expected: BoolArray,
    options: SearchOptions,
    on_progress: OnCount,
) -> FoundTracks:
    """Return the tracks of rays of each class ``kind`` (k,), seen in image (k,).

    ``expected`` (v,) tells images that a detector has processed. Rays that are not sound, and those
    from where a frame was taken before, have no track. ``on_progress`` counts rays.
    """
    track = np.full(len(image), -1)
    places: list[FloatArray] = [np.zeros((0, 2))]
    odds: list[FloatArray] = [np.zeros(0)]
    usable = rays.sound & images.is_key[image]
    total, done, count = int(usable.sum()), 0, 0
    for class_id in np.unique(kind[usable]).tolist():
        rows = np.flatnonzero(usable & (kind == class_id))
        rows = rows[np.argsort(image[rows], kind="stable")]
        scene = _scene(rays, rows, image[rows], images, expected & images.is_key, options)
        found = _Search(scene, options).run(partial(_show, on_progress, done, total))
        some = found.track >= 0
        track[rows[some]] = found.track[some] + count
        places.append(found.at_m)
        odds.append(found.log_odds)
        count, done = count + len(found.at_m), done + len(rows)
    return FoundTracks(track, np.concatenate(places), np.concatenate(odds))


def _show(on_progress: OnCount, before: int, total: int, done: int) -> None:
    on_progress(before + done, total)


def _scene(
    rays: GroundRays,
    rows: IntArray,
    image: IntArray,
    images: DriveImages,
    expected: BoolArray,
    options: SearchOptions,
) -> RayScene:
    v = len(images.path_m)
    counts = np.bincount(image, minlength=v)
    is_line = np.isfinite(rays.slope[rows, 1])
    width = np.arctan(images.edges[:, 1]) - np.arctan(images.edges[:, 0])
    height = images.size_px[:, 1] / images.focal_px
    area = width if is_line.all() else width * height
    return RayScene(
        origin=np.ascontiguousarray(rays.origin_m[rows]),
        direction=np.ascontiguousarray(rays.direction[rows]),
        sigma=rays.sigma_rad[rows],
        slope=np.where(is_line, np.nan, rays.slope[rows, 0]),
        slope_sigma=rays.slope_sigma[rows],
        ends=np.where(is_line[:, None] & rays.known[rows], rays.slope[rows], np.nan),
        image=image,
        begin=np.concatenate([[0], np.cumsum(counts)]),
        path=images.path_m,
        center=images.center_m,
        forward=images.forward,
        edges=images.edges,
        span=float(np.median(height)),
        area=area,
        keyframe=images.keyframe,
        expected=expected,
        recall=np.array(options.recall),
        good_ends=np.array(options.good_ends),
    )


class TrackCandidates(NamedTuple):
    """s candidates, each the best one on its ray."""

    start: IntArray
    """(s,) the ray"""
    at_m: FloatArray
    """(s, 2)"""
    height_m: FloatArray
    """(s,) of signs"""
    log_odds: FloatArray
    """(s,)"""
    frames: IntArray
    """(s,) number of camera positions that detect it"""

    def where(self, rows: BoolArray) -> "TrackCandidates":
        return TrackCandidates(
            self.start[rows],
            self.at_m[rows],
            self.height_m[rows],
            self.log_odds[rows],
            self.frames[rows],
        )


class _Search:
    """The search for landmarks of one class."""

    def __init__(self, scene: RayScene, options: SearchOptions) -> None:
        self._scene, self._options = scene, options
        self._free = np.ones(len(scene.image), dtype=np.bool_)
        self._window = _windows(scene.path)

    def run(self, on_progress: Callable[[int], None]) -> FoundTracks:
        """Search until no candidate is left that exists; ``on_progress`` gets the number of rays
        that need no more search, about."""
        track = np.full(len(self._free), -1)
        places: list[FloatArray] = [np.zeros((0, 2))]
        odds: list[FloatArray] = [np.zeros(0)]
        starts, count = np.arange(len(track)), 0
        while len(starts):
            candidates = self._candidates(starts, on_progress)
            exists = candidates.log_odds >= self._options.least_log_odds
            candidates = candidates.where(exists & (candidates.frames >= self._options.min_frames))
            chosen = self._claim(candidates, track, count)
            if not len(chosen):
                break
            places.append(candidates.at_m[chosen])
            odds.append(candidates.log_odds[chosen])
            count += len(chosen)
            starts = candidates.start[self._free[candidates.start]]
        return FoundTracks(track, np.concatenate(places), np.concatenate(odds))

    def _candidates(self, starts: IntArray, on_progress: Callable[[int], None]) -> TrackCandidates:
        scene, options, parts = self._scene, self._options, []
        free = np.bincount(scene.image[self._free], minlength=len(scene.path))
        clutter = np.asarray(np.maximum(free, 1), dtype=np.float64)
        for first in range(0, len(starts), _AT_ONCE):
            some = starts[first : first + _AT_ONCE]
            ranges = voted_ranges(scene, self._window, options.pose_sigma_m, some, self._free)
            values = refined(
                scene,
                self._window,
                options.pose_sigma_m,
                options.most_sigma_m,
                some,
                ranges,
                self._free,
                clutter,
            )
            parts.append(TrackCandidates(some, *values))
            on_progress(len(self._free) - len(starts) + first + len(some))
        return TrackCandidates(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def _claim(self, candidates: TrackCandidates, track: IntArray, count: int) -> IntArray:
        """Let candidates claim their rays, the best first; see ``claimed``."""
        order = np.argsort(-candidates.log_odds, kind="stable")
        return np.asarray(
            claimed(
                self._scene,
                self._window,
                self._options.pose_sigma_m,
                order,
                candidates.start,
                candidates.at_m,
                candidates.height_m,
                self._free,
                track,
                count,
            )
        )


def _windows(path_m: FloatArray) -> IntArray:
    """Return the first and last image (v, 2), excluded, to search for each image."""
    return np.stack(
        [
            np.searchsorted(path_m, path_m - _WINDOW_M),
            np.searchsorted(path_m, path_m + _WINDOW_M, side="right"),
        ],
        axis=1,
    )
