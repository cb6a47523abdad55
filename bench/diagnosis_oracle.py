"""What an oracle names in a run without true poses: no test that knows less can name more.

It knows all true correspondences, starts at the true poses, and knows the kind that it has to tell
from none. Poses are unknown to it as to any test: what they can follow is no evidence. It names a
kind from 3 nats on (BIC), odds of 20 to 1. A wrong extrinsic and a time offset change nothing but
the true poses, which are not given. A rolled mounting turns gravity as a wrong gravity prior does.
Faults of single elements are named as with true poses and ids.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import tests_support  # noqa: F401
from support.planted_runs import PlantedRun

from semviz_core.common.arrays import FloatArray
from semviz_core.diagnosis.fault import FaultKind
from semviz_core.diagnosis.joint_fit import JOINT_CAUSES, SIGMA, SIGMA_SCALES, JointCause
from semviz_core.diagnosis.joint_solution import Measured, Solution, fitted
from semviz_core.diagnosis.reference import FrameReference
from semviz_core.research.evaluation.problems import DETECTOR

NAMED_NATS = 3.0
OF_TRUTH: tuple[FaultKind, ...] = ("wrong extrinsic", "time offset")


def _shifted(measured: Measured, value: FloatArray) -> Measured:
    by_m = np.append(value, 0.0)
    priors = tuple(replace(prior, position_m=prior.position_m + by_m) for prior in measured.priors)
    return replace(measured, priors=priors)


CAUSES = (*JOINT_CAUSES, JointCause("misaligned map", "shift", _shifted, step=(1e-3, 1e-3)))
KINDS = {*(cause.kind for cause in CAUSES), SIGMA.kind, *OF_TRUTH}
"""That concern a run as a whole."""


def nats(drive: PlantedRun, kind: FaultKind) -> float:
    """Return what a kind of ``KINDS`` adds to the log-likelihood of a run without true poses, less
    half of p log n for its p parameters."""
    measured = _measured(drive)
    nothing = fitted(measured)
    each = 0.5 * float(np.log(len(measured.element)))
    fits = _fits(measured, nothing, kind)
    gains = [float((nothing.cost - fit.cost).sum()) - p * each for p, fit in fits]
    return max(gains, default=0.0)


def _fits(measured: Measured, nothing: Solution, kind: FaultKind) -> Iterator[tuple[int, Solution]]:
    """Yield numbers of parameters and fits of a kind."""
    if kind == SIGMA.kind:
        for scale in SIGMA_SCALES:
            yield 1, fitted(replace(measured, sigma_scale=scale), nothing)
    for cause in CAUSES:
        if cause.kind == kind:
            yield len(cause.step), fitted(measured, nothing, cause.change, np.array(cause.step))


def _measured(drive: PlantedRun) -> Measured:
    cases = [
        FrameReference(
            replace(found, status="ok", T_camera_map=truth.T_camera_map),
            drive.semantic_map, DETECTOR, None, truth.element_id,
        )
        for found, truth in drive.frames
    ]  # fmt: skip
    return Measured.of(cases, drive.odometry[1:])
