"""Localizing a drive, frame after frame, on one screen: ``Tracker``."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.camera import Camera
from semviz_core.detector_model import DetectorModel
from semviz_core.elements import Elements2D
from semviz_core.frame import Belief, Prior
from semviz_core.localization import Localization
from semviz_core.localize import Localizer
from semviz_core.pose import Pose
from semviz_core.semantic_map import SemanticMap
from semviz_core.sequence.belief import JointBelief
from semviz_core.sequence.filter import driven
from semviz_core.sequence.hypotheses import Hypotheses, Hypothesis
from semviz_core.sequence.odometry import STANDSTILL, Odometry
from semviz_core.sequence.sight import Reading, Sight

CROP_M = 50.0
"""Radius of the submap where none is given; detectors see about 40 m far."""
LOST_NATS = 30.0
"""Lost once the last frames are explained so much better by a camera somewhere else."""
LOST_SIGMA_M = 1.0
"""Lost once the position is not known any better along some direction."""

TrackStatus = Literal["starting", "ok", "lost"]


@dataclass(frozen=True, eq=False)
class Track:
    """The answer for one frame of a drive."""

    status: TrackStatus
    """``starting``: several poses are still possible; ``ok``; ``lost``: searching again."""
    reason: str
    """One sentence in plain words, with numbers; never empty."""
    T_camera_map: Pose | None
    """None unless ``ok``."""
    covariance: FloatArray | None
    """(6, 6) of the left perturbation of T_camera_map: metres, then radians."""
    element_id: IntArray
    """(m,) mapped element of each observed one, -1 for none."""
    localization: Localization | None = None
    """The frame by itself, where it was searched."""


@dataclass(frozen=True, eq=False)
class _Course:
    """What is remembered from frame to frame while the pose is known."""

    belief: JointBelief
    motion: Odometry = STANDSTILL
    """The last step of odometry."""
    guesses: int = 0
    """Steps since without odometry."""
    trust_nats: float = 0.0
    """By how much the last frames are explained better here than elsewhere, in sum, cut off at 0:
    a cumulative sum test (Page 1954)."""


class Tracker:
    """Follows one camera through one map. Call ``step`` with every frame, in order."""

    def __init__(
        self,
        camera: Camera,
        semantic_map: SemanticMap,
        detector: DetectorModel | None = None,
        localizer: Localizer | None = None,
        start: Belief | None = None,
        crop_m: float = CROP_M,
    ) -> None:
        """``start``: where the camera is known to be before the first step. ``crop_m``: radius of
        the submap; people label further than detectors see."""
        self._camera, self._map, self._crop_m = camera, semantic_map, crop_m
        self._detector = detector or DetectorModel()
        self._localizer = localizer or Localizer(classes=semantic_map.classes)
        self._hypotheses = Hypotheses(self._localizer)
        self._status: TrackStatus = "starting" if start is None else "ok"
        self._course = None if start is None else _Course(JointBelief.start(start))

    def step(self, observed: Elements2D, odometry: Odometry | None, prior: Prior) -> Track:
        """The pose at the next frame.

        ``odometry`` is the way from the frame before, None where there is none (as at the first).
        """
        if self._course is None:
            return self._search(observed, odometry, prior)
        return self._follow(self._course, observed, odometry, prior)

    def _follow(
        self, course: _Course, observed: Elements2D, odometry: Odometry | None, prior: Prior
    ) -> Track:
        """A frame later, where the pose is known."""
        guesses = 0 if odometry else course.guesses + 1
        way = odometry or course.motion.guessed(guesses)
        center_m = (way.T_now_before @ course.belief.T_camera_map).inverse().translation
        sight = self._sight(observed, center_m, prior)
        belief, reading = driven(course.belief, way, sight)
        trust = course.trust_nats + reading.log_likelihood - reading.log_elsewhere
        course = _Course(belief, odometry or course.motion, guesses, min(trust, 0.0))
        if reason := _lost(course):
            # what was believed stays in the race: it may yet win
            self._hypotheses = Hypotheses(self._localizer, [Hypothesis(belief, ())])
            self._status, self._course = "lost", None
            return Track("lost", reason, None, None, np.full(len(observed), -1))
        self._course = course
        return _answer(belief, reading, sight)

    def _search(self, observed: Elements2D, odometry: Odometry | None, prior: Prior) -> Track:
        """A frame later, where several poses are possible, or none is known."""
        if odometry is None:  # the frames before cannot be tied to this one
            self._hypotheses = Hypotheses(self._localizer)
        sight = self._sight(observed, prior.position_m, prior)
        frame = self._hypotheses.step(odometry or STANDSTILL, sight)
        if reason := self._hypotheses.undecided():
            return Track(self._status, reason, None, None, np.full(len(observed), -1), frame)
        best = self._hypotheses.alive[0]
        self._status, self._course = "ok", _Course(best.belief, odometry or STANDSTILL)
        return _answer(best.belief, best.readings[-1], sight, frame)

    def _sight(self, observed: Elements2D, center_m: FloatArray, prior: Prior) -> Sight:
        submap = self._map.crop(center_m, self._crop_m)
        return Sight(self._camera, self._detector, observed, submap, prior)


def _lost(course: _Course) -> str:
    """Why the belief is given up; empty while it holds."""
    if course.trust_nats < -LOST_NATS:
        nats = -course.trust_nats
        return f"Another place explains what was seen in the last frames better by {nats:.0f} nats."
    if (sigma := course.belief.sigma_m) > LOST_SIGMA_M:
        return f"The position is known only to {sigma:.1f} m, {LOST_SIGMA_M:g} m needed."
    return ""


def _answer(
    belief: JointBelief, reading: Reading, sight: Sight, frame: Localization | None = None
) -> Track:
    element_id = np.full(len(sight.observed), -1)
    element_id[reading.pairs[:, 0]] = reading.element_id
    reason = (
        f"{len(reading.pairs)} of {reading.seen} elements fit, known to {belief.sigma_m:.2f} m."
    )
    pose = belief.pose
    return Track("ok", reason, pose.T_camera_map, pose.covariance, element_id, frame)
