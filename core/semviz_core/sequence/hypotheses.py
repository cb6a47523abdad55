"""Where the camera may be while that is not yet decided: several beliefs, driven side by side.

Each is weighed by how well it explains the last frames TOGETHER. One that is found late is driven
backwards through the frames before, so that all are weighed by the same frames.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from semviz_core.frame import Belief
from semviz_core.localization import Localization
from semviz_core.localize import Localizer
from semviz_core.pose import Pose
from semviz_core.sequence.belief import JointBelief
from semviz_core.sequence.filter import driven, informed, updated
from semviz_core.sequence.odometry import Odometry
from semviz_core.sequence.sight import Reading, Sight, read

WINDOW = 30
"""Frames by which beliefs are weighed."""
MOST = 12
"""Beliefs kept."""
GIVEN_UP_NATS = 40.0
"""Those that explain the window worse than the best by more are given up."""
SAME_M, SAME_RAD = 0.5, float(np.deg2rad(1.0))
"""Beliefs closer than both are one."""
COMMIT_NATS, COMMIT_FRAMES, COMMIT_ELEMENTS, COMMIT_SHARE, COMMIT_SIGMA_M = 30.0, 5, 5, 0.6, 0.3
"""Committed when the best explains the window better than any other by so much, over so many frames
with detections, with so many different elements and this share of what was seen, and knows its
position this well."""
BIRTH_SIGMA = np.repeat([3.0, 0.1], 3)
"""How little is known of a new belief before its first frame: metres, radians."""
GATE_SIGMA = np.repeat([0.3, float(np.deg2rad(0.5))], 3)
"""How far off a mode of the search may be when its elements are paired."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    belief: JointBelief
    readings: tuple[Reading, ...]
    """Of the frames in the window, oldest first."""
    fix_nats: float = 0.0
    """Of the newest fix; those before it are off by about the same and say nothing new."""

    @property
    def log_likelihood(self) -> float:
        """Nats by which it explains the window and the newest fix."""
        return _total(self.readings) + self.fix_nats

    @property
    def elements(self) -> int:
        """How many mapped elements it found in the window."""
        return len({id for one in self.readings for id in one.element_id.tolist()})


@dataclass(eq=False)
class Hypotheses:
    """Takes frames until one hypothesis is left that can be relied on."""

    localizer: Localizer
    alive: list[Hypothesis] = field(default_factory=list)
    """Best first."""
    _window: list[tuple[Odometry, Sight]] = field(default_factory=list)
    """Frames, oldest first, and the way to each from the one before."""

    def step(self, odometry: Odometry, sight: Sight) -> Localization:
        """Take the next frame; its own localization seeds new hypotheses."""
        self._window = [*self._window, (odometry, sight)][-WINDOW:]
        self.alive = [_later(one, odometry, sight) for one in self.alive]
        frame = self.localizer.localize(sight.observed, sight.submap, sight.camera, sight.prior)
        self.alive += [one for T in self._new_modes(frame) if (one := self._born(T))]
        self.alive = [replace(one, fix_nats=_fix_nats(one.belief, sight)) for one in self.alive]
        self._prune()
        return frame

    def undecided(self) -> str:
        """Why the best cannot be relied on yet; empty once it can."""
        if not self.alive:
            return "No pose explains what was seen."
        best = self.alive[0]
        seen = sum(one.seen for one in best.readings)
        paired = sum(len(one.pairs) for one in best.readings)
        rivals = [sum(one.log_elsewhere for one in best.readings)]
        rivals += [one.log_likelihood for one in self.alive[1:]]
        gap = best.log_likelihood - max(rivals)
        if (frames := sum(one.seen > 0 for one in best.readings)) < COMMIT_FRAMES:
            return f"{frames} frames with elements so far, {COMMIT_FRAMES} needed."
        if best.elements < COMMIT_ELEMENTS:
            return f"{best.elements} mapped elements found so far, {COMMIT_ELEMENTS} needed."
        if paired < COMMIT_SHARE * seen:
            return f"The best pose explains only {paired} of {seen} elements of the last frames."
        if best.belief.sigma_m > COMMIT_SIGMA_M:
            return f"The best pose is known only to {best.belief.sigma_m:.1f} m."
        if gap < COMMIT_NATS:
            return f"{len(self.alive)} poses are left, the next only {gap:.0f} nats worse."
        return ""

    def _new_modes(self, frame: Localization) -> list[Pose]:
        """Poses that explain the newest frame nearly as well as its best, where none is yet."""
        if frame.search is None or not len(frame.search.score):
            return []
        worse = frame.search.score[0] - frame.search.score
        return [
            T for T, nats in zip(frame.search.T_camera_map, worse, strict=True)
            if nats < GIVEN_UP_NATS
            and not any(same(T, one.belief.T_camera_map) for one in self.alive)
        ]  # fmt: skip

    def _born(self, T_camera_map: Pose) -> Hypothesis | None:
        """A hypothesis at the newest frame, weighed backwards through the window; None where the
        frames before contradict it."""
        best = self.alive[0].readings if self.alive else ()
        odometry, sight = self._window[-1]
        about = JointBelief.start(Belief(T_camera_map, np.diag(GATE_SIGMA**2)))
        unknown = JointBelief.start(Belief(T_camera_map, np.diag(BIRTH_SIGMA**2)))
        belief = updated(informed(unknown, sight, 1), sight, read(about, sight))
        readings: tuple[Reading, ...] = (read(belief, sight),)
        then = belief
        for odometry_before, sight in reversed(self._window[:-1]):
            then, reading = driven(then, odometry.inverse(), sight)
            odometry = odometry_before
            readings = (reading, *readings)
            if _total(best[-len(readings) :]) - _total(readings) > GIVEN_UP_NATS:
                return None
        return Hypothesis(belief, readings)

    def _prune(self) -> None:
        ranked = sorted(self.alive, key=lambda one: -one.log_likelihood)
        kept: list[Hypothesis] = []
        for one in ranked:
            worse = ranked[0].log_likelihood - one.log_likelihood
            T = one.belief.T_camera_map
            if worse < GIVEN_UP_NATS and not any(same(T, o.belief.T_camera_map) for o in kept):
                kept.append(one)
        self.alive = kept[:MOST]


def same(T_camera_map: Pose, other: Pose) -> bool:
    """Whether two poses are too close to be different answers."""
    away = T_camera_map.inverse().translation - other.inverse().translation
    cosine = 0.5 * (np.trace(T_camera_map.rotation @ other.rotation.T) - 1.0)
    return bool(np.linalg.norm(away) < SAME_M and cosine > np.cos(SAME_RAD))


def _later(one: Hypothesis, odometry: Odometry, sight: Sight) -> Hypothesis:
    belief, reading = driven(one.belief, odometry, sight)
    return Hypothesis(belief, (*one.readings, reading)[-WINDOW:])


def _total(readings: tuple[Reading, ...]) -> float:
    return sum(one.log_likelihood for one in readings)


def _fix_nats(belief: JointBelief, sight: Sight) -> float:
    off = belief.T_camera_map.inverse().translation[:2] - sight.prior.position_m[:2]
    return -0.5 * float(off @ off) / sight.prior.horizontal_sigma_m**2
