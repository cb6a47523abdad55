"""Test what the solver assumed beside the image: the parts of the prior, and the stated sigma.

Each assumption has an innovation: its disagreement with a pose, in sigmas. With ground truth, that
is the true pose. Without, the frame is solved again without the assumption, so that the pose is
the image's alone. An assumption is the cause of a failure if it disagrees by more than chance and
the frame is healthy without it: one wrong assumption explains what looks like several faults.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from semviz_core.base.elements import Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose, heading_rad
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.diagnosis.fault import EvidenceItem, Fault, FaultKind
from semviz_core.diagnosis.frame_causes import LEAST_SCALE, sigma_fault, with_sigma_scaled
from semviz_core.diagnosis.reference import FrameReference, is_healthy
from semviz_core.localization.heading_votes import DEFAULT_EFFORT, WIDE, Effort
from semviz_core.localization.localizer import NEEDED_ELEMENTS, Localizer
from semviz_core.localization.prior_residuals import MOST_ROWS, prior_rows
from semviz_core.localization.problem import PriorRecord
from semviz_core.localization.residuals import EXACT_POSE
from semviz_core.localization.upright import ASSUMED_UP_SIGMA_RAD

SEEN_M = 40.0
"""Range of detections beyond the possible positions of the camera."""


def solve_with_prior(case: FrameReference, prior: Prior) -> Localization:
    """Return the frame solved with another prior, in the submap around that prior."""
    moved_m = float(np.linalg.norm((prior.position_m - case.prior.position_m)[:2]))
    submap = case.localization.submap
    if moved_m > 0.0 or prior.horizontal_sigma_m > case.prior.horizontal_sigma_m:
        submap = _around(case, prior)
    return _solved(case, submap, prior)


def solve_with_sigma(case: FrameReference, factor: float) -> Localization:
    """Return the frame solved with larger sigmas of the detections."""
    return _solved(with_sigma_scaled(case, factor), case.localization.submap, case.prior)


def solve_with_more_effort(case: FrameReference) -> Localization:
    """Return the frame solved by the widest search."""
    return _solved(case, case.localization.submap, case.prior, WIDE)


def solve_in_wide_submap(case: FrameReference) -> Localization:
    """Return the frame solved in a submap with all that it may have detected."""
    return _solved(case, _around(case, case.prior), case.prior)


def _solved(
    case: FrameReference, submap: Elements3D, prior: Prior, effort: Effort = DEFAULT_EFFORT
) -> Localization:
    """Return the frame solved again; as it is if its input is none that ``Localizer`` takes, for
    example of another localizer."""
    result = case.localization
    localizer = Localizer(classes=case.semantic_map.classes, detector=case.detector, effort=effort)
    try:
        return localizer.localize(result.observed, submap, result.camera, prior)
    except SemvizError:
        return result


def _around(case: FrameReference, prior: Prior) -> Elements3D:
    return case.semantic_map.crop(prior.position_m, 3.0 * prior.horizontal_sigma_m + SEEN_M)


LIMITS = {1: 4.0, 2: 4.4}
"""Innovations (sigmas) that chance exceeds once in 16,000 frames, by the number of rows."""
WIDER = 6.0
"""Factor on the sigma of a position that is left open."""
HEIGHT_STEP_M, HEIGHT_STEPS = 1.0, (-3, -2, -1, 1, 2, 3)
"""Heights that are tried where the height is left open."""
FACTORS = (2.0, 4.0)
"""On the stated sigma of detections, with which a frame is solved again."""


@dataclass(frozen=True)
class PriorPart:
    """One part of the prior."""

    kind: FaultKind
    name: str
    rows: slice
    """Of ``prior_rows`` for a prior with gravity and heading."""
    unit: str
    sigma: Callable[[Prior], float]
    """In ``unit``."""
    corrected: Callable[[Prior, Pose], Prior]
    """Return the prior with this part as it is at the pose T_camera_map."""
    without: Callable[[Prior], tuple[Prior, ...]]
    """Return priors that leave this part open; together they cover what it may be."""
    is_given: Callable[[Prior], bool] = lambda prior: True


def _heading_at(prior: Prior, pose: Pose) -> Prior:
    return replace(prior, heading_rad=heading_rad(pose.inverse()))


def _height_at(prior: Prior, pose: Pose) -> Prior:
    residual, _ = _rows(HEIGHT, prior, pose)
    return raised(prior, float(residual[0]) * prior.vertical_sigma_m)


def raised(prior: Prior, by_m: float) -> Prior:
    """Return the prior with camera and road higher by ``by_m``."""
    up_m = np.array([0.0, 0.0, by_m])
    road_m = None if prior.road_m is None else prior.road_m + up_m
    return replace(prior, position_m=prior.position_m + up_m, road_m=road_m)


def _other_heights(prior: Prior) -> tuple[Prior, ...]:
    vague = replace(prior, vertical_sigma_m=max(prior.vertical_sigma_m, HEIGHT_STEP_M / 2.0))
    return tuple(raised(vague, step * HEIGHT_STEP_M) for step in HEIGHT_STEPS)


def _position_at(prior: Prior, pose: Pose) -> Prior:
    center_m = pose.inverse().translation
    return replace(prior, position_m=np.append(center_m[:2], prior.position_m[2]))


HEADING = PriorPart(
    "wrong heading prior", "heading prior", slice(5, 6), "deg",
    sigma=lambda prior: float(np.rad2deg(prior.heading_sigma_rad)),
    corrected=_heading_at,
    without=lambda prior: (replace(prior, heading_rad=None),),
    is_given=lambda prior: prior.heading_rad is not None,
)  # fmt: skip
GRAVITY = PriorPart(
    "wrong gravity prior", "gravity prior", slice(3, 5), "deg",
    sigma=lambda prior: float(np.rad2deg(prior.up_sigma_rad)),
    corrected=lambda prior, pose: replace(prior, up_camera=pose.rotation[:, 2]),
    without=lambda prior: (
        replace(prior, up_sigma_rad=max(ASSUMED_UP_SIGMA_RAD, prior.up_sigma_rad)),
    ),
    is_given=lambda prior: prior.up_camera is not None,
)  # fmt: skip
HEIGHT = PriorPart(
    "wrong height prior", "height prior", slice(2, 3), "m",
    sigma=lambda prior: prior.vertical_sigma_m,
    corrected=_height_at,
    without=_other_heights,
)  # fmt: skip
POSITION = PriorPart(
    "wrong position prior", "position prior", slice(0, 2), "m",
    sigma=lambda prior: prior.horizontal_sigma_m,
    corrected=_position_at,
    without=lambda prior: (replace(prior, horizontal_sigma_m=WIDER * prior.horizontal_sigma_m),),
)  # fmt: skip
PRIOR_PARTS = (HEADING, GRAVITY, HEIGHT, POSITION)


def assumption_faults(case: FrameReference) -> tuple[Fault, ...]:
    """Return the assumptions that disagree with the reference, the worst first."""
    if case.reference is None:
        return ()
    sigma = sigma_fault(case, case.localization)
    return (*prior_faults(case), *([] if sigma is None else [sigma]))


def prior_faults(case: FrameReference) -> tuple[Fault, ...]:
    """Return the parts of the prior that disagree with the reference, the worst first."""
    tests = [_prior_test(part, case) for part in _given_parts(case)]
    far = [test for test in tests if test.is_fault]
    far.sort(key=lambda test: -test.excess)
    return tuple(test.fault for test in far)


def position_fault(case: FrameReference) -> Fault | None:
    """Return the fault of a position prior that is further off than chance allows."""
    if case.reference is None or case.localization.prior is None:
        return None
    test = _prior_test(POSITION, case)
    return test.fault if test.is_fault else None


def solved_without_heading(case: FrameReference) -> FrameReference:
    """Return the frame solved again without its heading prior; as it is without one."""
    prior = case.localization.prior
    if prior is None or prior.heading_rad is None:
        return case
    again = solve_with_prior(case, replace(prior, heading_rad=None))
    return replace(case, localization=again)


def _given_parts(case: FrameReference) -> tuple[PriorPart, ...]:
    prior = case.localization.prior
    return () if prior is None else tuple(part for part in PRIOR_PARTS if part.is_given(prior))


def check_assumptions(case: FrameReference) -> Fault | None:
    """Return the wrong assumption without which the frame is healthy; None without any."""
    if len(case.localization.observed) < NEEDED_ELEMENTS or case.localization.prior is None:
        return None
    causes = list(_causes(case))
    return max(causes, key=lambda cause: cause[0])[1] if causes else None


def _causes(case: FrameReference) -> Iterator[tuple[float, Fault]]:
    """Yield the assumptions without which the frame is healthy, with their excess."""
    for part in _given_parts(case):
        test = _tested_again(part, case)
        if test is not None and test.is_fault:
            yield test.excess, test.fault
    sigma = _sigma_tested_again(case)
    if sigma is not None:
        yield sigma.evidence[0].value / LEAST_SCALE, sigma


def _tested_again(part: PriorPart, case: FrameReference) -> "_PriorTest | None":
    """Compare a part with the truth, or with the pose found without it; None if neither heals."""
    prior = case.prior
    if case.truth is not None:
        test = _prior_test(part, case)
        healed = test.is_fault and is_healthy(
            solve_with_prior(case, part.corrected(prior, case.truth)), case.truth
        )
        return test if healed else None
    tests = []
    for other in part.without(prior):
        again = solve_with_prior(case, other)
        if again.status == "ok":
            tests.append(_innovation(part, prior, again))
    return max(tests, key=lambda test: test.excess, default=None)


def _sigma_tested_again(case: FrameReference) -> Fault | None:
    """Return the fault of sigmas with larger ones of which the frame is healthy."""
    for factor in FACTORS:
        again = solve_with_sigma(case, factor)
        if is_healthy(again, case.truth):
            return sigma_fault(case, again)
    return None


@dataclass(frozen=True, eq=False)
class _PriorTest:
    """A part of the prior, compared with a pose."""

    part: PriorPart
    prior: Prior
    residual: FloatArray
    """(k,) in sigmas of the prior."""
    covariance: FloatArray
    """(k, k) of ``residual`` if the prior is right."""

    @cached_property
    def sigmas(self) -> float:
        return float(np.sqrt(self.residual @ np.linalg.solve(self.covariance, self.residual)))

    @property
    def excess(self) -> float:
        """Innovation over its limit."""
        return self.sigmas / LIMITS[len(self.residual)]

    @property
    def is_fault(self) -> bool:
        return self.excess > 1.0

    @property
    def fault(self) -> Fault:
        part, stated = self.part, self.part.sigma(self.prior)
        off = float(np.linalg.norm(self.residual)) * stated
        return Fault(
            part.kind,
            f"The {part.name} is {off:.1f} {part.unit} off, {self.sigmas:.1f} sigma: it states "
            f"± {stated:.2g} {part.unit}.",
            (EvidenceItem("off", off, part.unit), EvidenceItem("innovation", self.sigmas, "sigma")),
        )


def _prior_test(part: PriorPart, case: FrameReference) -> _PriorTest:
    """Compare a part of the prior with the reference pose.

    An estimate follows the prior, so its residual has the covariance I - J P J^T.
    """
    assert case.reference is not None
    residual, J = _rows(part, case.prior, case.reference)
    identity = np.eye(len(residual))
    if case.truth is not None:
        return _PriorTest(part, case.prior, residual, identity)
    spread = J @ case.reference_covariance @ J.T
    least = 0.05 * identity  # an estimate that only follows the prior says nothing about it
    return _PriorTest(part, case.prior, residual, np.maximum(identity - spread, least))


def _innovation(part: PriorPart, prior: Prior, again: Localization) -> _PriorTest:
    """Compare a part of the prior with the pose found without it."""
    assert again.T_camera_map is not None
    residual, J = _rows(part, prior, again.T_camera_map)
    covariance = EXACT_POSE if again.covariance is None else again.covariance
    return _PriorTest(part, prior, residual, np.eye(len(residual)) + J @ covariance @ J.T)


def _rows(part: PriorPart, prior: Prior, pose: Pose) -> tuple[FloatArray, FloatArray]:
    """Return the residual (k,) of one part, in its sigmas, and its Jacobian (k, 6)."""
    up = pose.rotation[:, 2] if prior.up_camera is None else prior.up_camera
    heading = 0.0 if prior.heading_rad is None else prior.heading_rad
    known = PriorRecord.of(replace(prior, up_camera=up, heading_rad=heading))
    residual, jacobian = np.zeros(MOST_ROWS), np.zeros((MOST_ROWS, 6))
    prior_rows(known, *pose.writable(), residual, jacobian)
    return residual[part.rows], jacobian[part.rows]
