"""Track one camera through one map, frame after frame.

Call Tracker.step with every frame, in order. While the pose is undecided, several hypotheses are
kept side by side until one of them is reliable.
"""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.elements import Elements2D
from semviz_core.base.frame import STANDSTILL, Belief, Odometry, Prior
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.localization.localizer import Localizer
from semviz_core.tracking.association import (
    FrameAssociation,
    JointBelief,
    TrackingFrame,
    associate_frame,
)
from semviz_core.tracking.ekf import predict_and_update, update_by_pairs, update_by_prior

WINDOW = 30
"""Number of frames that score the hypotheses."""
MOST = 12
"""Most hypotheses kept."""
GIVEN_UP_NATS = 40.0
"""Hypotheses that explain the window worse than the best by more are dropped."""
SAME_M, SAME_RAD = 0.5, float(np.deg2rad(1.0))
"""Poses closer than both are one hypothesis."""
COMMIT_NATS, COMMIT_FRAMES, COMMIT_ELEMENTS, COMMIT_SHARE, COMMIT_SIGMA_M = 30.0, 5, 5, 0.6, 0.3
"""The best hypothesis is reliable if it meets all limits: nats ahead of the next, frames with
detections, different elements paired, share of the observed elements paired, sigma of its
position."""
CONFIRMATIONS = 2
"""So many frames localized at the hypothesis when searched alone, none elsewhere between, replace
the limits of frames, elements and share: a map that lacks half of what is seen never meets them."""
CONFIRMED_APART_M = 0.5
"""A frame that is less far from the last confirmation sees the same again, and confirms nothing."""
NEW_SIGMA = np.repeat([3.0, 0.1], 3)
"""Sigmas of a new hypothesis before its first frame: metres, radians."""
GATE_SIGMA = np.repeat([0.3, float(np.deg2rad(0.5))], 3)
"""Sigmas of a mode of the search when its elements are paired: metres, radians."""


@dataclass(frozen=True, eq=False)
class TrackHypothesis:
    belief: JointBelief
    associations: tuple[FrameAssociation, ...]
    """Of the frames in the window, oldest first."""
    fix_nats: float = 0.0
    """Log-likelihood of the newest fix; earlier fixes share its error and add nothing."""
    confirmations: int = 0
    """Frames whose own localization was ``ok`` at this pose, since the last that was elsewhere."""
    moved_m: float = np.inf
    """Way driven since the last confirmation."""

    @property
    def log_likelihood(self) -> float:
        """Log-likelihood (nats) of the window and the newest fix."""
        return _total(self.associations) + self.fix_nats

    @property
    def elements(self) -> int:
        """Number of different mapped elements paired in the window."""
        return len(
            {element_id for frame in self.associations for element_id in frame.element_id.tolist()}
        )


@dataclass(eq=False)
class HypothesisSet:
    """Hypotheses that explain the frames so far, until one of them is reliable."""

    localizer: Localizer
    alive: list[TrackHypothesis] = field(default_factory=list)
    """Best first."""
    _window: list[tuple[Odometry, TrackingFrame]] = field(default_factory=list)
    """Frames, oldest first, each with the odometry from the frame before."""

    def step(self, odometry: Odometry, frame: TrackingFrame, prior: Prior) -> Localization:
        """Process the next frame; return its own localization, which seeds new hypotheses."""
        self._window = [*self._window, (odometry, frame)][-WINDOW:]
        self.alive = [_propagated(old, odometry, frame) for old in self.alive]
        single = self.localizer.localize(frame.observed, frame.submap, frame.camera, prior)
        self.alive += [new for T in self._new_modes(single) if (new := self._hypothesis_at(T))]
        self.alive = [
            _confirmed(replace(each, fix_nats=_fix_nats(each.belief, prior)), single)
            for each in self.alive
        ]
        self._prune()
        return single

    def undecided(self) -> str:
        """Return why the best hypothesis is not reliable yet; empty once it is."""
        if not self.alive:
            return "No pose explains what was seen."
        best = self.alive[0]
        rivals = [sum(matched.log_elsewhere for matched in best.associations)]
        rivals += [hypothesis.log_likelihood for hypothesis in self.alive[1:]]
        gap = best.log_likelihood - max(rivals)
        if best.confirmations < CONFIRMATIONS and (reason := _unsupported(best)):
            return reason
        if best.belief.sigma_m > COMMIT_SIGMA_M:
            return f"The best pose is known only to {best.belief.sigma_m:.1f} m."
        if gap < COMMIT_NATS:
            return f"{len(self.alive)} poses are left, the next only {gap:.0f} nats worse."
        return ""

    def _new_modes(self, single: Localization) -> list[Pose]:
        """Return poses that explain the newest frame nearly as well as its best one, and that no
        hypothesis has yet."""
        if single.search is None or not len(single.search.score):
            return []
        worse = single.search.score[0] - single.search.score
        known = [hypothesis.belief.T_camera_map for hypothesis in self.alive]
        return [
            T for T, nats in zip(single.search.T_camera_map, worse, strict=True)
            if nats < GIVEN_UP_NATS and not any(is_same_pose(T, pose) for pose in known)
        ]  # fmt: skip

    def _hypothesis_at(self, T_camera_map: Pose) -> TrackHypothesis | None:
        """Return a hypothesis at the newest frame, scored backwards through the window; None if the
        earlier frames contradict it."""
        best = self.alive[0].associations if self.alive else ()
        odometry, frame = self._window[-1]
        nearby = JointBelief.start(Belief(T_camera_map, np.diag(GATE_SIGMA**2)))
        unknown = JointBelief.start(Belief(T_camera_map, np.diag(NEW_SIGMA**2)))
        belief = update_by_pairs(
            update_by_prior(unknown, frame, 1), frame, associate_frame(nearby, frame)
        )
        associations: tuple[FrameAssociation, ...] = (associate_frame(belief, frame),)
        earlier = belief
        for odometry_before, frame in reversed(self._window[:-1]):
            earlier, association = predict_and_update(earlier, odometry.inverse(), frame)
            odometry = odometry_before
            associations = (association, *associations)
            if _total(best[-len(associations) :]) - _total(associations) > GIVEN_UP_NATS:
                return None
        return TrackHypothesis(belief, associations)

    def _prune(self) -> None:
        ranked = sorted(self.alive, key=lambda hypothesis: -hypothesis.log_likelihood)
        kept: list[TrackHypothesis] = []
        for hypothesis in ranked:
            worse = ranked[0].log_likelihood - hypothesis.log_likelihood
            T = hypothesis.belief.T_camera_map
            if worse < GIVEN_UP_NATS and not any(
                is_same_pose(T, better.belief.T_camera_map) for better in kept
            ):
                kept.append(hypothesis)
        self.alive = kept[:MOST]


def is_same_pose(T_camera_map: Pose, other: Pose) -> bool:
    """Return whether two poses are too close to be different hypotheses."""
    shift = T_camera_map.inverse().translation - other.inverse().translation
    cosine = 0.5 * (np.trace(T_camera_map.rotation @ other.rotation.T) - 1.0)
    return bool(np.linalg.norm(shift) < SAME_M and cosine > np.cos(SAME_RAD))


def _propagated(
    hypothesis: TrackHypothesis, odometry: Odometry, frame: TrackingFrame
) -> TrackHypothesis:
    belief, association = predict_and_update(hypothesis.belief, odometry, frame)
    associations = (*hypothesis.associations, association)[-WINDOW:]
    moved_m = hypothesis.moved_m + float(np.linalg.norm(odometry.T_now_before.translation))
    return replace(hypothesis, belief=belief, associations=associations, moved_m=moved_m)


def _confirmed(hypothesis: TrackHypothesis, single: Localization) -> TrackHypothesis:
    """Return the hypothesis after the newest frame was localized alone."""
    if single.status != "ok" or single.T_camera_map is None:
        return hypothesis
    if not is_same_pose(hypothesis.belief.T_camera_map, single.T_camera_map):
        return replace(hypothesis, confirmations=0, moved_m=np.inf)
    if hypothesis.moved_m < CONFIRMED_APART_M:
        return hypothesis
    return replace(hypothesis, confirmations=hypothesis.confirmations + 1, moved_m=0.0)


def _unsupported(best: TrackHypothesis) -> str:
    """Return why the frames so far do not support a hypothesis enough; empty if they do."""
    seen = sum(matched.seen for matched in best.associations)
    paired = sum(len(matched.pairs) for matched in best.associations)
    if (frames := sum(matched.seen > 0 for matched in best.associations)) < COMMIT_FRAMES:
        return f"{frames} frames with elements so far, {COMMIT_FRAMES} needed."
    if best.elements < COMMIT_ELEMENTS:
        return f"{best.elements} mapped elements found so far, {COMMIT_ELEMENTS} needed."
    if paired < COMMIT_SHARE * seen:
        return f"The best pose explains only {paired} of {seen} elements of the last frames."
    return ""


def _total(associations: tuple[FrameAssociation, ...]) -> float:
    return sum(association.log_likelihood for association in associations)


def _fix_nats(belief: JointBelief, prior: Prior) -> float:
    off = belief.T_camera_map.inverse().translation[:2] - prior.position_m[:2]
    return -0.5 * float(off @ off) / prior.horizontal_sigma_m**2


CROP_M = 50.0
"""Default radius of the submap; detectors reach about 40 m."""
LOST_NATS = 30.0
"""The track is lost once a camera elsewhere explains the last frames better by this much."""
LOST_SIGMA_M = 1.0
"""The track is lost once the sigma of the position along some direction is larger."""

TrackStatus = Literal["starting", "ok", "lost"]


@dataclass(frozen=True, eq=False)
class TrackedPose:
    """The result of one frame of a sequence."""

    status: TrackStatus
    """``starting``: several poses are still possible; ``ok``; ``lost``: searching again."""
    reason: str
    """One sentence with numbers; never empty."""
    T_camera_map: Pose | None
    """None unless ``ok``."""
    covariance: FloatArray | None
    """(6, 6) of the left perturbation of T_camera_map: metres, then radians."""
    element_id: IntArray
    """(m,) mapped element of each observed one, -1 for none."""
    localization: Localization | None = None
    """The single-frame result, if the frame was searched."""


@dataclass(frozen=True, eq=False)
class _TrackState:
    """The state from frame to frame while the pose is known."""

    belief: JointBelief
    motion: Odometry = STANDSTILL
    """The last step of odometry."""
    guesses: int = 0
    """Number of steps since then, without odometry."""
    trust_nats: float = 0.0
    """Sum over the last frames of the log-likelihood here over that elsewhere, at most 0: a
    cumulative sum test (Page 1954)."""


class Tracker:
    """Track one camera through one map. Call ``step`` with every frame, in order."""

    def __init__(
        self,
        camera: Camera,
        semantic_map: SemanticMap,
        detector: DetectorModel | None = None,
        localizer: Localizer | None = None,
        start: Belief | None = None,
        crop_m: float = CROP_M,
    ) -> None:
        """Start the track.

        ``start`` is the known pose before the first step, if any. ``crop_m`` is the radius of the
        submap: maps hold elements beyond the reach of detectors.
        """
        self._camera, self._map, self._crop_m = camera, semantic_map, crop_m
        self._detector = detector or DetectorModel()
        self._localizer = localizer or Localizer(classes=semantic_map.classes)
        self._hypotheses = HypothesisSet(self._localizer)
        self._status: TrackStatus = "starting" if start is None else "ok"
        self._state = None if start is None else _TrackState(JointBelief.start(start))
        self._passed: Odometry | None = None  # motion over frames left out since the last search

    def step(
        self, observed: Elements2D, odometry: Odometry | None, prior: Prior | None
    ) -> TrackedPose:
        """Return the pose at the next frame.

        ``odometry`` is the motion since the frame before, None if unknown (as for the first).
        ``prior`` is None for a frame without a fix.
        """
        if self._state is not None:
            return self._follow(self._state, observed, odometry, prior)
        if self._passed is not None:
            odometry = None if odometry is None else self._passed.followed_by(odometry)
            self._passed = None
        if prior is None:
            return self._pass(observed, odometry)
        return self._search(observed, odometry, prior)

    def _follow(
        self,
        state: _TrackState,
        observed: Elements2D,
        odometry: Odometry | None,
        prior: Prior | None,
    ) -> TrackedPose:
        """Process a frame while the pose is known."""
        guesses = 0 if odometry else state.guesses + 1
        motion = odometry or state.motion.guessed(guesses)
        center_m = (motion.T_now_before @ state.belief.T_camera_map).inverse().translation
        frame = self._frame(observed, center_m, prior)
        belief, association = predict_and_update(state.belief, motion, frame)
        trust = state.trust_nats + association.log_likelihood - association.log_elsewhere
        state = _TrackState(belief, odometry or state.motion, guesses, min(trust, 0.0))
        if reason := _lost(state):
            # the belief stays a hypothesis: it may yet prove right
            self._hypotheses = HypothesisSet(self._localizer, [TrackHypothesis(belief, ())])
            self._status, self._state = "lost", None
            return TrackedPose("lost", reason, None, None, np.full(len(observed), -1))
        self._state = state
        return _tracked_pose(belief, association, frame)

    def _search(self, observed: Elements2D, odometry: Odometry | None, prior: Prior) -> TrackedPose:
        """Process a frame while several poses are possible, or none is known."""
        if odometry is None:  # earlier frames cannot be related to this one
            self._hypotheses = HypothesisSet(self._localizer)
        frame = self._frame(observed, prior.position_m, prior)
        single = self._hypotheses.step(odometry or STANDSTILL, frame, prior)
        if reason := self._hypotheses.undecided():
            return TrackedPose(self._status, reason, None, None, np.full(len(observed), -1), single)
        best = self._hypotheses.alive[0]
        self._status, self._state = "ok", _TrackState(best.belief, odometry or STANDSTILL)
        return _tracked_pose(best.belief, best.associations[-1], frame, single)

    def _pass(self, observed: Elements2D, odometry: Odometry | None) -> TrackedPose:
        """Leave out a frame that cannot be searched; keep its motion for the next."""
        if odometry is None:
            self._hypotheses = HypothesisSet(self._localizer)
        self._passed = odometry
        reason = "The frame has no prior, so it is unknown which part of the map to search."
        return TrackedPose(self._status, reason, None, None, np.full(len(observed), -1))

    def _frame(
        self, observed: Elements2D, center_m: FloatArray, prior: Prior | None
    ) -> TrackingFrame:
        submap = self._map.crop(center_m, self._crop_m)
        return TrackingFrame(self._camera, self._detector, observed, submap, prior)


def _lost(state: _TrackState) -> str:
    """Return why the track is lost; empty if it is not."""
    if state.trust_nats < -LOST_NATS:
        nats = -state.trust_nats
        return f"Another place explains what was seen in the last frames better by {nats:.0f} nats."
    if (sigma := state.belief.sigma_m) > LOST_SIGMA_M:
        return f"The position is known only to {sigma:.1f} m, {LOST_SIGMA_M:g} m needed."
    return ""


def _tracked_pose(
    belief: JointBelief,
    association: FrameAssociation,
    frame: TrackingFrame,
    single: Localization | None = None,
) -> TrackedPose:
    element_id = np.full(len(frame.observed), -1)
    element_id[association.pairs[:, 0]] = association.element_id
    fitting = f"{len(association.pairs)} of {association.seen} elements"
    reason = f"{fitting} fit, known to {belief.sigma_m:.2f} m."
    pose = belief.pose
    return TrackedPose("ok", reason, pose.T_camera_map, pose.covariance, element_id, single)
