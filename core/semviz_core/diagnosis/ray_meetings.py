"""Find where rays of unmatched detections meet, more often than false detections do by chance.

Two rays always meet, and among the rays of many false detections so do three or more. So the frames
that have a point in view are asked which is likelier: a landmark, which most of them detect, or
false detections, as many as there are beside it, anywhere in the image. What hides a landmark hides
it in all frames of a visit. A point counts if chance gives fewer than ``ALLOWED`` of them among
all points where two rays meet (an a-contrario test: Desolneux, Moisan, Morel, IJCV 2000).
"""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from semviz_core.base.detector_model import DetectorModel
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray, unit_vectors
from semviz_core.diagnosis.reference import FrameReference

NEEDED_FRAMES = 3
MEET_RAD = float(np.deg2rad(0.7))
"""Largest angle, seen from the camera, between a ray and a point it passes through."""
LEAST_PARALLAX_RAD = float(np.deg2rad(3.0))
NEAREST_M, FURTHEST_M = 2.0, 60.0
"""Range of the distance from a camera to a landmark, if the detector reaches so far."""
ALLOWED = 0.01
"""Expected number of points in a run that are due to chance."""
HIDDEN = 0.1
"""Probability that a landmark is hidden throughout a visit."""
VISIT_GAP = 3
"""Frames without a landmark in view after which the next one is another visit."""


@dataclass(frozen=True, eq=False)
class UnmatchedRays:
    """k unmatched detections as rays in the ground plane."""

    frame: IntArray
    """(k,) position in the run."""
    row: IntArray
    """(k,) observed row in that frame."""
    class_id: IntArray
    center_m: FloatArray
    """(k, 2) of the camera."""
    toward: FloatArray
    """(k, 2) unit."""

    @classmethod
    def of(
        cls, cases: Sequence[FrameReference], rows: Sequence[tuple[int, int]]
    ) -> "UnmatchedRays":
        """Return the rays of detections (frame, observed row)."""
        frame, row = np.array(rows, dtype=np.int64).reshape(-1, 2).T
        rays, centers = np.empty((len(rows), 2)), np.empty((len(rows), 2))
        class_id = np.empty(len(rows), dtype=np.int64)
        for k, (position, i) in enumerate(rows):
            case = cases[position]
            assert case.reference is not None
            back = case.reference.inverse()
            ray = (back.rotation @ case.problem.seen[i]["anchor_ray"])[:2]
            rays[k], centers[k] = ray / np.linalg.norm(ray), back.translation[:2]
            class_id[k] = case.localization.observed.class_id[i]
        return cls(frame, row, class_id, centers, rays)


@dataclass(frozen=True, eq=False)
class Views:
    """What n frames have in view, in the ground plane."""

    center_m: FloatArray
    """(n, 2) of the camera."""
    ahead: FloatArray
    """(n, 2) unit."""
    half_rad: float
    """Half of the horizontal angle of view."""
    detector: DetectorModel

    @property
    def furthest_m(self) -> float:
        return min(self.detector.reach_m, FURTHEST_M)

    @classmethod
    def of(cls, cases: Sequence[FrameReference]) -> "Views":
        """Return the views of one or more frames that have a reference pose."""
        back = [case.reference.inverse() for case in cases if case.reference is not None]
        ahead = np.array([pose.rotation[:2, 2] for pose in back])
        camera = cases[0].localization.camera
        return cls(
            np.array([pose.translation[:2] for pose in back]),
            unit_vectors(ahead),
            float(np.arctan(0.5 * camera.width / camera.K[0, 0])),
            cases[0].detector,
        )

    def of_point(self, at_m: FloatArray) -> tuple[BoolArray, FloatArray]:
        """Return which frames (n,) have a point (2,) in view, and the recall (n,) there."""
        offset = at_m - self.center_m
        away_m = np.linalg.norm(offset, axis=1)
        shown = (offset * self.ahead).sum(axis=1) > np.cos(self.half_rad) * away_m
        shown &= (away_m > NEAREST_M) & (away_m < self.furthest_m)
        return shown, self.detector.recall_at(np.minimum(away_m, self.furthest_m))


@dataclass(frozen=True, eq=False)
class RayMeeting:
    """A point where rays meet."""

    at_m: FloatArray
    """(2,)"""
    rays: IntArray
    """Rows of ``UnmatchedRays`` that pass through it, from three or more frames."""
    nats: float
    """Log-likelihood ratio of a landmark and chance, without two of the rays, which always meet."""


class RayMeetings:
    """The points where rays of one class and of several frames meet."""

    def __init__(self, rays: UnmatchedRays, views: Views) -> None:
        self._rays, self._views = rays, views
        self._free = np.ones(len(rays.row), dtype=bool)

    def found(self) -> list[RayMeeting]:
        """Return the points, the likeliest first. Each ray belongs to at most one."""
        best = {ray: self._best_on(ray) for ray in range(len(self._rays.row))}
        queue = [(-point.nats, ray) for ray, point in best.items() if point is not None]
        heapq.heapify(queue)
        found = []
        while queue and -queue[0][0] > self._needed_nats:
            _, ray = heapq.heappop(queue)
            point = best[ray]
            if point is not None and not self._free[point.rays].all():  # rays are used up
                point = best[ray] = self._best_on(ray) if self._free[ray] else None
                if point is not None:
                    heapq.heappush(queue, (-point.nats, ray))
            elif point is not None:
                self._free[point.rays] = False
                found.append(point)
        return found

    @cached_property
    def _needed_nats(self) -> float:
        """By the number of points where two rays meet."""
        rays = range(len(self._rays.row))
        free = np.ones(len(self._rays.row), dtype=bool)
        tried = sum(len(self._crossings(ray, self._others(ray, free))) for ray in rays) / 2
        return float(np.log(max(tried, 1.0) / ALLOWED))

    def _others(self, index: int, free: BoolArray) -> IntArray:
        """Return the rays of the class of one, around it, of all frames."""
        rays = self._rays
        away_m = np.linalg.norm(rays.center_m - rays.center_m[index], axis=1)
        same_class = free & (rays.class_id == rays.class_id[index])
        return np.flatnonzero(same_class & (away_m < FURTHEST_M))

    def _best_on(self, index: int) -> RayMeeting | None:
        """Return the point on one ray that the rays of most frames pass."""
        rays, rows = self._rays, self._others(index, self._free)
        at_m = self._crossings(index, rows)
        if not len(at_m):
            return None
        passes = self._passes(rows, at_m)
        frames = [len(np.unique(rays.frame[rows[chosen]])) for chosen in passes]
        best = rows[passes[int(np.argmax(frames))]]
        placed_m = self._nearest_to(best, at_m[int(np.argmax(frames))])
        met = rows[self._passes(rows, placed_m[None])[0]]
        if len(np.unique(rays.frame[met])) < NEEDED_FRAMES:
            return None
        return RayMeeting(placed_m, met, self._nats(placed_m, met))

    def _nearest_to(self, rows: IntArray, start_m: FloatArray) -> FloatArray:
        """Return the point (2,) that rays pass by the smallest angles, near ``start_m``."""
        center_m, toward = self._rays.center_m[rows], self._rays.toward[rows]
        weight = np.linalg.norm(start_m - center_m, axis=1)[:, None]
        normal = np.stack([-toward[:, 1], toward[:, 0]], axis=1) / weight
        return np.asarray(np.linalg.lstsq(normal, (normal * center_m).sum(axis=1), rcond=None)[0])

    def _crossings(self, index: int, rows: IntArray) -> FloatArray:
        """Return (c, 2) where ray ``index`` crosses those of other frames, ahead of both."""
        rays = self._rays
        rows = rows[rays.frame[rows] != rays.frame[index]]
        a, b = rays.toward[index], rays.toward[rows]
        cross = a[0] * b[:, 1] - a[1] * b[:, 0]
        wide = np.abs(cross) > np.sin(LEAST_PARALLAX_RAD)
        offset = rays.center_m[rows[wide]] - rays.center_m[index]
        b, cross = b[wide], cross[wide]
        along_a = (offset[:, 0] * b[:, 1] - offset[:, 1] * b[:, 0]) / cross
        along_b = (offset[:, 0] * a[1] - offset[:, 1] * a[0]) / cross
        ahead = (np.minimum(along_a, along_b) > NEAREST_M) & (along_a < self._views.furthest_m)
        return np.asarray(rays.center_m[index] + along_a[ahead, None] * a)

    def _passes(self, rows: IntArray, at_m: FloatArray) -> BoolArray:
        """Return (c, len(rows)) whether rays pass through points (c, 2)."""
        rays = self._rays
        offset = at_m[:, None] - rays.center_m[rows]
        toward = rays.toward[rows]
        aside = offset[..., 0] * toward[:, 1] - offset[..., 1] * toward[:, 0]
        ahead = (offset * toward).sum(axis=-1)
        near = np.abs(aside) < np.tan(MEET_RAD) * ahead
        return np.asarray(near & (ahead > NEAREST_M) & (ahead < self._views.furthest_m))

    def _nats(self, at_m: FloatArray, met: IntArray) -> float:
        """Return ``RayMeeting.nats`` of a point through which the rays ``met`` pass."""
        shown, recall = self._views.of_point(at_m)
        seen = np.zeros(len(shown), dtype=bool)
        seen[self._rays.frame[met]] = True
        chance = self._chance(met)
        gain = np.log(np.where(seen, recall / chance, (1.0 - recall) / (1.0 - chance)))
        frames = np.flatnonzero(seen | shown)
        visits = np.split(gain[frames], np.flatnonzero(np.diff(frames) > VISIT_GAP) + 1)
        of_visits = [np.log1p(-HIDDEN) + visit.sum() for visit in visits]
        total = np.logaddexp(of_visits, np.log(HIDDEN)).sum()
        return float(total - np.sort(gain[seen])[-2:].sum())

    def _chance(self, met: IntArray) -> float:
        """Return the probability that a frame has a false detection towards a point.

        Their number is that of the other rays of the class, and one more.
        """
        others = int((self._rays.class_id == self._rays.class_id[met[0]]).sum()) - len(met) + 1
        share = MEET_RAD / self._views.half_rad
        return min(others * share / len(self._views.center_m), 0.5)
