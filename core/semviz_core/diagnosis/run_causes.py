"""Find what is wrong in many frames of a run at once: assumptions, alignment, calibration.

Each frame's image supports a pose near the true one. Over the frames, its offset is constant in
the map's axes if the map is shifted, constant in the camera's axes if the extrinsic is wrong, and
proportional to the motion if times differ. The likeliest of these is named.

A wrong calibration leaves residuals of one pattern in all frames. Focal length, principal point
and roll are estimated jointly and linearly from all pairs of a run. If the true pose is unknown,
each frame's pose is estimated too, with its prior, and marginalized (Schur complement). Only
errors that no pose explains remain.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from semviz_core.base.frame import adjoint
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.diagnosis.assumptions import assumption_faults, check_assumptions
from semviz_core.diagnosis.fault import EvidenceItem, Fault, FaultKind, RunFault
from semviz_core.diagnosis.frame_causes import Misalignment, image_pose
from semviz_core.diagnosis.reference import (
    FrameReference,
    ProgressCallback,
    no_progress,
    whitened_rows,
)
from semviz_core.localization.association import associate
from semviz_core.localization.prior_residuals import MOST_ROWS, prior_rows
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.localization.search import REFINED_COVARIANCE
from semviz_core.localization.upright import assumed_upright

PATTERNS = ("focal length", "principal point, across", "principal point, up or down", "roll")
UNITS = ("%", "px", "px", "deg")
IN_UNITS: FloatArray = np.array([100.0, 1.0, 1.0, np.rad2deg(1.0)])
"""Factors from the estimated quantities (share, px, px, rad) to ``UNITS``."""
LEAST: FloatArray = np.array([0.5, 2.0, 2.0, 0.3])
"""Smallest faults, in ``UNITS``: less is within the accuracy of calibrations."""
LEAST_SIGMAS = 6.0
NEEDED_PAIRS = 12
OFF_SIGMAS = 4.0
EXPLAINED, EXPLAINED_BLIND = 0.4, 0.1
"""Share of all squared residuals that a pattern must explain, with and without the true poses: a
moved element looks like a pattern too. Estimated poses absorb most of the pattern."""
_SCALES = (30.0, 15.0, 8.0, 4.0, 4.0)
"""Sigmas beyond which rows are down-weighted, per iteration."""
_STEP = np.array([1e-4, 0.1, 0.1])


class WrongCalibration(NamedTuple):
    """An error of the calibration, and what is left with it."""

    fault: Fault
    cost: float
    """As ``residual_cost``."""


def residual_cost(cases: Sequence[FrameReference]) -> float:
    """Return the sum of squared residuals in sigmas, each at most ``OFF_SIGMAS`` squared."""
    return _cost([block for case in cases for block in _blocks(case)], np.zeros(len(PATTERNS)))


def find_calibration(
    cases: Sequence[FrameReference], watch: ProgressCallback = no_progress
) -> WrongCalibration | None:
    """Return the fault of the strongest pattern; None without one."""
    watched = watch(cases, "checking the calibration", len(cases))
    blocks = [block for case in watched for block in _blocks(case)]
    if sum(len(residual) // 2 for residual, _, _ in blocks) < NEEDED_PAIRS:
        return None
    value, sigma = _estimate(blocks)
    measured, strength = value * IN_UNITS, np.abs(value) / sigma
    significant = (strength > LEAST_SIGMAS) & (np.abs(measured) > LEAST)
    cost = _cost(blocks, value)
    explained = 1.0 - cost / _cost(blocks, np.zeros(len(PATTERNS)))
    least = EXPLAINED_BLIND if any(case.truth is None for case in cases) else EXPLAINED
    if not significant.any() or explained < least:
        return None
    k = int(np.argmax(np.where(significant, strength, 0.0)))
    also = " or mounting" if k else ""
    name = "roll of the mounting" if k == 3 else PATTERNS[k].split(",")[0] + also
    fault = Fault(
        "wrong calibration",
        f"The residuals of all frames fit an error of {measured[k]:+.1f} {UNITS[k]} in {name}.",
        (
            EvidenceItem(PATTERNS[k], float(measured[k]), UNITS[k]),
            EvidenceItem("strength", strength[k], "sigma"),
        ),
    )
    return WrongCalibration(fault, cost)


Block = tuple[FloatArray, FloatArray, FloatArray]
"""Whitened residuals (r,), their Jacobians for the calibration (r, 4) and the pose (r, 0 or 6)."""


def _blocks(case: FrameReference) -> Iterator[Block]:
    """Yield one block for a frame with pairs."""
    pairs = _pairs(case)
    if not len(pairs) or case.reference is None:
        return
    residual, by_pose = whitened_rows(case.problem, case.reference, pairs)
    by_camera = np.empty((len(residual), 4))
    for k in range(3):
        by_camera[:, k] = (
            whitened_rows(_changed(case, k), case.reference, pairs).residual - residual
        ) / _STEP[k]
    by_camera[:, 3] = by_pose[:, 5]
    if case.truth is not None:
        yield residual, by_camera, np.empty((len(residual), 0))
        return
    prior, slope = _prior_rows(case)
    yield (
        np.append(residual, prior),
        np.concatenate([by_camera, np.zeros((len(prior), 4))]),
        np.concatenate([by_pose, slope]),
    )


def _pairs(case: FrameReference) -> IntArray:
    """Return (k, 2) true pairs if known, else the nearest within a wide gate."""
    if case.ids is not None or case.reference is None:
        return case.same_class
    match, _ = associate(case.problem, *case.reference.writable(), REFINED_COVARIANCE)
    rows = np.flatnonzero(match >= 0)
    return np.column_stack([rows, match[rows]])


def _changed(case: FrameReference, k: int) -> PoseProblem:
    """Return the problem with one camera parameter of ``PATTERNS`` a step larger."""
    result = case.localization
    K = result.camera.K.copy()
    if k == 0:
        K[[0, 1], [0, 1]] *= 1.0 + _STEP[0]
    else:
        K[k - 1, 2] += _STEP[k]
    return PoseProblem.of(replace(result.camera, K=K), result.observed, case.nearby, case.detector)


def _prior_rows(case: FrameReference) -> tuple[FloatArray, FloatArray]:
    assert case.reference is not None
    residual, slope = np.zeros(MOST_ROWS), np.zeros((MOST_ROWS, 6))
    known = PriorRecord.of(assumed_upright(case.prior))
    count = prior_rows(known, *case.reference.writable(), residual, slope)
    return residual[:count], slope[:count]


def _estimate(blocks: Sequence[Block]) -> tuple[FloatArray, FloatArray]:
    """Return (4,) values and sigmas; rows that fit no calibration end with almost no weight."""
    value: FloatArray = np.zeros(4)
    information = np.eye(4)
    for scale in _SCALES:
        information, gradient = 1e-6 * np.eye(4), np.zeros(4)
        for residual, by_camera, by_pose in blocks:
            remaining = residual + by_camera @ value
            root = 1.0 / (1.0 + (remaining / scale) ** 2)  # root of the Geman-McClure weight
            A, r = _without_pose(
                root[:, None] * by_camera, root[:, None] * by_pose, root * residual
            )
            information += A.T @ A
            gradient -= A.T @ r
        value = np.asarray(np.linalg.solve(information, gradient), dtype=np.float64)
    return value, np.sqrt(np.diag(np.linalg.inv(information)))


def _cost(blocks: Sequence[Block], value: FloatArray) -> float:
    """Return the sum of squares, each row at most ``OFF_SIGMAS`` squared."""
    remaining = (r + A @ value for A, r in (_without_pose(A, J, r) for r, A, J in blocks))
    return sum(float(np.minimum(rows**2, OFF_SIGMAS**2).sum()) for rows in remaining)


def _without_pose(
    by_camera: FloatArray, by_pose: FloatArray, residual: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return Jacobian and residual projected orthogonally to the pose Jacobian."""
    if not by_pose.shape[1]:
        return by_camera, residual
    Q, _ = np.linalg.qr(by_pose)
    return by_camera - Q @ (Q.T @ by_camera), residual - Q @ (Q.T @ residual)


NEEDED_FRAMES = 3
LEAST_FRAMES_SHARE = 0.1
"""Share of the frames in which an assumption must be wrong to be a fault of the run."""
LEAST_NATS = 20.0
"""Log-likelihood that an alignment must add, beyond its own parameters."""
RIVAL_NATS = 6.0
"""Alignments closer than this in log-likelihood cannot be told apart."""
LEAST_OFFSET_M, LEAST_OFFSET_RAD = 0.1, float(np.deg2rad(0.2))
"""A smaller offset is within the accuracy of poses and maps."""
MOST_CHI2 = 50.0
"""Squared sigmas of one frame's offset count up to this."""
MODEL_SHARE = 0.1
"""Accuracy of the models: motion between frames is not even."""
_ROUNDS = 8


def assumption_run_faults(
    cases: Sequence[FrameReference], watch: ProgressCallback = no_progress
) -> list[RunFault]:
    """Return the assumptions that are wrong in many frames, those of most frames first.

    A frame without a true pose and status ``ok`` is solved again without each assumption.
    """
    reported: dict[FaultKind, list[tuple[int, Fault]]] = defaultdict(list)
    for row, case in enumerate(watch(cases, "testing priors and sigmas", len(cases))):
        for fault in _assumptions(case):
            reported[fault.kind].append((row, fault))
    needed = max(NEEDED_FRAMES, LEAST_FRAMES_SHARE * len(cases))
    faults = [
        _assumption_fault(kind, frames, len(cases))
        for kind, frames in reported.items()
        if len(frames) >= needed
    ]
    return sorted(faults, key=lambda fault: -len(fault.frames))


def _assumptions(case: FrameReference) -> tuple[Fault, ...]:
    if case.truth is not None or case.localization.status == "ok":
        return assumption_faults(case)
    cause = check_assumptions(case)
    return () if cause is None else (cause,)


def _assumption_fault(
    kind: FaultKind, reported: Sequence[tuple[int, Fault]], total: int
) -> RunFault:
    """Return the fault of a run, with the evidence of the frame in the middle."""
    ordered = sorted((fault for _, fault in reported), key=lambda fault: fault.evidence[0].value)
    middle = ordered[len(ordered) // 2]
    return RunFault(
        kind,
        f"In {len(reported)} of {total} frames, typically: {middle.sentence}",
        (EvidenceItem("frames", len(reported)), *middle.evidence),
        frames=tuple(row for row, _ in reported),
    )


@dataclass(frozen=True, eq=False)
class Alignment:
    """One offset of all frames."""

    fault: RunFault
    offsets: FloatArray
    """(frames, 6) of the image's pose from the true one, as modelled."""

    def corrected(self, cases: Sequence[FrameReference]) -> list[FrameReference]:
        """Return the frames with true poses that fit the map."""
        return [
            case if case.truth is None else replace(case, truth=Pose.exp(offset) @ case.truth)
            for case, offset in zip(cases, self.offsets, strict=True)
        ]


def find_alignment(cases: Sequence[FrameReference]) -> Alignment | None:
    """Return what is shifted in all frames; None if nothing is, or without true poses."""
    images = [image_pose(case) for case in cases]
    measured = [row for row, image in enumerate(images) if image is not None]
    if len(measured) < NEEDED_FRAMES or any(case.truth is None for case in cases):
        return None
    fits = [_fitted(model, cases, images, measured) for model in MODELS]
    best = max(fits, key=lambda fit: fit.nats)
    if best.nats < LEAST_NATS or not best.is_large:
        return None
    rivals = [fit for fit in fits if fit is not best and fit.nats > best.nats - RIVAL_NATS]
    return Alignment(_alignment_fault(best, rivals, measured), best.offsets)


@dataclass(frozen=True)
class AlignmentModel:
    """One cause of offsets: ``offset = basis @ value`` in each frame."""

    kind: FaultKind
    name: str
    basis: Callable[[Sequence[FrameReference], int], FloatArray]
    """Return (6, p) for the frame at a position."""


def _by_map(cases: Sequence[FrameReference], row: int) -> FloatArray:
    """Return (6, 4) the offsets of a map that moves along x, y, z or turns about z.

    It turns about the middle of the run, so that turn and shift are independent.
    """
    truth = cases[row].truth
    assert truth is not None
    middle = np.mean([_center(case) for case in cases], axis=0)
    about = Pose(np.eye(3), middle)
    twists = adjoint(truth @ about)
    return np.asarray(twists[:, [0, 1, 2, 5]])


def _by_camera(cases: Sequence[FrameReference], row: int) -> FloatArray:
    return np.eye(6)


def _by_time(cases: Sequence[FrameReference], row: int) -> FloatArray:
    """Return (6, 1) the motion of the camera from frame to frame."""
    before, after = cases[max(row - 1, 0)].truth, cases[min(row + 1, len(cases) - 1)].truth
    assert before is not None
    assert after is not None
    steps = min(row + 1, len(cases) - 1) - max(row - 1, 0)
    return np.asarray((after @ before.inverse()).log()[:, None] / steps)


MODELS = (
    AlignmentModel("misaligned map", "the map is shifted or turned", _by_map),
    AlignmentModel("wrong extrinsic", "the camera is mounted elsewhere", _by_camera),
    AlignmentModel("time offset", "images and poses have different times", _by_time),
)


@dataclass(frozen=True, eq=False)
class _Fit:
    model: AlignmentModel
    value: FloatArray
    """(p,)"""
    offsets: FloatArray
    """(frames, 6)"""
    nats: float
    """Log-likelihood above that of no offset, less half of p log n (BIC)."""

    @property
    def is_large(self) -> bool:
        size_m = np.linalg.norm(self.offsets[:, :3], axis=1)
        angle = np.linalg.norm(self.offsets[:, 3:], axis=1)
        return bool(np.median(size_m) > LEAST_OFFSET_M or np.median(angle) > LEAST_OFFSET_RAD)


def _fitted(
    model: AlignmentModel,
    cases: Sequence[FrameReference],
    images: Sequence[Misalignment | None],
    measured: Sequence[int],
) -> _Fit:
    """Fit one model to the measured offsets by reweighted least squares."""
    bases = [model.basis(cases, row) for row in range(len(cases))]
    value: FloatArray = np.zeros(bases[0].shape[1])
    for _ in range(_ROUNDS):
        information = 1e-9 * np.eye(len(value))
        gradient = np.zeros(len(value))
        for row in measured:
            image = images[row]
            assert image is not None
            A, b = _whitened(image, bases[row])
            weight = 1.0 / (1.0 + ((b - A @ value) ** 2).sum() / MOST_CHI2) ** 2
            information += weight * A.T @ A
            gradient += weight * A.T @ b
        value = np.asarray(np.linalg.solve(information, gradient))
    nats = 0.0
    for row in measured:
        image = images[row]
        assert image is not None
        A, b = _whitened(image, bases[row])
        left = min(float(((b - A @ value) ** 2).sum()), MOST_CHI2)
        nats += 0.5 * (min(float((b**2).sum()), MOST_CHI2) - left)
    nats -= 0.5 * len(value) * float(np.log(len(measured)))
    return _Fit(model, value, np.array([basis @ value for basis in bases]), nats)


def _whitened(image: Misalignment, basis: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return basis (6, p) and offset (6,), divided by the root of the offset's covariance."""
    size = np.repeat([np.linalg.norm(image.offset[:3]), np.linalg.norm(image.offset[3:])], 3)
    factor = np.linalg.cholesky(image.covariance + np.diag((MODEL_SHARE * size) ** 2))
    return np.linalg.solve(factor, basis), np.linalg.solve(factor, image.offset)


def _alignment_fault(best: _Fit, rivals: Sequence[_Fit], measured: Sequence[int]) -> RunFault:
    sentence = f"In {len(measured)} frames all elements are off together: {_described(best)}."
    if rivals:
        others = " or ".join(rival.model.name for rival in rivals)
        sentence += f" This drive cannot tell it from another cause: {others}."
    evidence = [EvidenceItem("frames", len(measured)), EvidenceItem("strength", best.nats, "nats")]
    return RunFault(best.model.kind, sentence, tuple(evidence), frames=tuple(measured))


def _described(fit: _Fit) -> str:
    """Return the cause with its size, as people read it."""
    value = fit.value
    if fit.model.kind == "time offset":
        late = "later" if value[0] > 0.0 else "earlier"
        return f"the images are {abs(value[0]):.2f} frames {late} than their poses"
    if fit.model.kind == "wrong extrinsic":
        x, y, z = -value[:3]
        angle_deg = np.rad2deg(np.linalg.norm(value[3:]))
        return (
            f"the camera is mounted {_toward(x, 'right', 'left')}, {_toward(y, 'down', 'up')} and "
            f"{_toward(z, 'ahead', 'back')} of where its extrinsic says, turned by "
            f"{angle_deg:.1f} deg"
        )
    shift, turn_deg = -value[:3], np.rad2deg(-value[3])
    return (
        f"the map is shifted by {shift[0]:+.2f}, {shift[1]:+.2f}, {shift[2]:+.2f} m (x, y, z) and "
        f"turned by {turn_deg:+.2f} deg"
    )


def _toward(value_m: float, positive: str, negative: str) -> str:
    return f"{abs(value_m):.2f} m {positive if value_m > 0.0 else negative}"


def _center(case: FrameReference) -> FloatArray:
    assert case.truth is not None
    return case.truth.inverse().translation
