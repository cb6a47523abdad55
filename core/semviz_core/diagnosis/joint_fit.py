"""Find the one cause that a run without true poses supports, by a fit of all that it measured.

A cause is as likely as what it adds to the log-likelihood once all poses and elements may follow
it (`joint_solution`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from semviz_core.base.frame import Odometry
from semviz_core.base.pose import Pose, so3_exp
from semviz_core.common.arrays import FloatArray
from semviz_core.diagnosis.assumptions import raised
from semviz_core.diagnosis.common_causes import CALIBRATIONS
from semviz_core.diagnosis.fault import FaultKind
from semviz_core.diagnosis.joint_solution import Change, Measured, Solution, fitted
from semviz_core.diagnosis.reference import FrameReference
from semviz_core.localization.problem import PoseProblem

MOST_FRAMES = 30
"""Frames one after the other that are fitted together."""
NEEDED_FRAMES, NEEDED_PAIRS = 3, 8
LEAST_NATS = 8.0
"""Log-likelihood that a cause must add, beyond its parameters and without its best element."""
SIGMA_SCALES = (1.5, 2.0, 3.0, 4.0, 6.0)


@dataclass(frozen=True)
class JointCause:
    """A cause with p parameters: of odometry, camera or priors, or the scale of sigmas."""

    kind: FaultKind
    name: str
    change: Change
    step: tuple[float, ...] = (1e-4,)
    """(p,) for derivatives."""
    unit: str = ""
    in_unit: float = 1.0
    least: float = 0.0
    """Smallest fault in ``unit``."""


@dataclass(frozen=True, eq=False)
class JointFit:
    """A cause, its likeliest parameters, and what it adds to the log-likelihood (nats)."""

    cause: JointCause
    value: FloatArray
    """(p,)"""
    frames: tuple[int, ...]
    """Rows of the frames that were fitted."""
    nats: float
    nats_without_best: float

    @property
    def is_fault(self) -> bool:
        size = float(np.abs(self.value).max()) * self.cause.in_unit
        return self.nats_without_best > LEAST_NATS and size > self.cause.least


def _longer(measured: Measured, value: FloatArray) -> Measured:
    return _moved(measured, 1.0 / (1.0 + value[0]), 0.0)


def _turned(measured: Measured, value: FloatArray) -> Measured:
    return _moved(measured, 1.0, -float(value[0]))


def _moved(measured: Measured, factor: float, turn_rad: float) -> Measured:
    turn = Pose.from_rotvec(np.array([0.0, turn_rad, 0.0]), np.zeros(3))
    steps = []
    for k, step in measured.steps:
        motion = step.T_now_before
        motion = turn @ Pose(motion.rotation, factor * motion.translation)
        steps.append((k, Odometry(motion, step.covariance)))
    return replace(measured, steps=tuple(steps))


def _seen_through(number: int) -> Change:
    camera = CALIBRATIONS[number].camera
    assert camera is not None

    def change(measured: Measured, value: FloatArray) -> Measured:
        problems = tuple(
            PoseProblem.of(
                camera(case.localization.camera, value), case.localization.observed,
                case.nearby, case.detector,
            )
            for case in measured.cases
        )  # fmt: skip
        return replace(measured, problems=problems)

    return change


def _rolled(measured: Measured, value: FloatArray) -> Measured:
    turn = so3_exp(np.array([0.0, 0.0, value[0]]))
    priors = tuple(
        prior if prior.up_camera is None else replace(prior, up_camera=turn @ prior.up_camera)
        for prior in measured.priors
    )
    return replace(measured, priors=priors)


def _headed(measured: Measured, value: FloatArray) -> Measured:
    priors = tuple(
        prior if prior.heading_rad is None
        else replace(prior, heading_rad=prior.heading_rad - float(value[0]))
        for prior in measured.priors
    )  # fmt: skip
    return replace(measured, priors=priors)


def _lower(measured: Measured, value: FloatArray) -> Measured:
    priors = tuple(raised(prior, -float(value[0])) for prior in measured.priors)
    return replace(measured, priors=priors)


JOINT_CAUSES = (
    JointCause("wrong odometry", "length", _longer, unit="%", in_unit=100.0, least=1.0),
    JointCause(
        "wrong odometry", "yaw", _turned,
        unit="deg per step", in_unit=float(np.rad2deg(1.0)), least=0.1,
    ),
    JointCause(
        "wrong calibration", "focal length", _seen_through(0),
        unit="%", in_unit=100.0, least=0.5,
    ),
    JointCause(
        "wrong calibration", "principal point or mounting", _seen_through(1),
        step=(0.1, 0.1), unit="px", least=2.0,
    ),
    JointCause(
        "wrong gravity prior", "roll", _rolled,
        unit="deg", in_unit=float(np.rad2deg(1.0)), least=0.3,
    ),
    JointCause(
        "wrong heading prior", "heading", _headed,
        unit="deg", in_unit=float(np.rad2deg(1.0)), least=1.0,
    ),
    JointCause("wrong height prior", "height", _lower, unit="m", least=0.3),
)  # fmt: skip
SIGMA = JointCause(
    "wrong detection sigma", "true over stated sigma", lambda measured, value: measured, least=1.8
)


def joint_fits(
    cases: Sequence[FrameReference], odometry: Sequence[Odometry | None]
) -> list[JointFit]:
    """Return all causes, fitted, the likeliest first; none if too little is known.

    ``cases`` have the poses from which the fit starts, ``odometry`` the motion of each from the
    one before.
    """
    rows = _fitted_rows(cases)
    steps = [odometry[now] if now == before + 1 else None for before, now in pairwise(rows)]
    measured = Measured.of([cases[row] for row in rows], steps)
    if len(rows) < NEEDED_FRAMES or len(measured.element) < NEEDED_PAIRS:
        return []
    nothing = fitted(measured)
    found = {
        cause: fitted(measured, nothing, cause.change, np.array(cause.step))
        for cause in JOINT_CAUSES
    }
    found[SIGMA] = min(
        (_scaled(measured, nothing, scale) for scale in SIGMA_SCALES),
        key=lambda fit: float(fit.cost.sum()),
    )
    fits = [_rated(cause, rows, fit, nothing, measured) for cause, fit in found.items()]
    return sorted(fits, key=lambda fit: -fit.nats)


def _scaled(measured: Measured, nothing: Solution, scale: float) -> Solution:
    fit = fitted(replace(measured, sigma_scale=scale), nothing)
    return replace(fit, value=np.array([scale]))


def _rated(
    cause: JointCause,
    rows: Sequence[int],
    fit: Solution,
    nothing: Solution,
    measured: Measured,
) -> JointFit:
    gain = nothing.cost - fit.cost
    nats = float(gain.sum() - 0.5 * len(cause.step) * np.log(len(measured.element)))
    without_best = nats - float(gain[1:].max(initial=0.0))
    return JointFit(cause, fit.value, tuple(rows), nats, without_best)


def _fitted_rows(cases: Sequence[FrameReference]) -> list[int]:
    """Return the frames that are fitted: of those with a pose, MOST_FRAMES one after the other with
    the most detections."""
    usable = [row for row, case in enumerate(cases) if case.localization.status == "ok"]
    seen = np.cumsum([0, *(len(cases[row].localization.observed) for row in usable)])
    count = min(len(usable), MOST_FRAMES)
    first = int(np.argmax(seen[count:] - seen[: len(seen) - count]))
    return usable[first : first + count]
