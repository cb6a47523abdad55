"""Find what is wrong in many frames of a run at once: assumptions, and the alignment with the map.

Each frame's image supports a pose near the true one. Over the frames, its offset is constant in
the map's axes if the map is shifted, constant in the camera's axes if the extrinsic is wrong, and
proportional to the motion if times differ. The likeliest of these is named.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from semviz_core.base.frame import adjoint
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.diagnosis.alignment import Misalignment, image_pose
from semviz_core.diagnosis.assumptions import assumption_faults, check_assumptions
from semviz_core.diagnosis.fault import EvidenceItem, Fault, FaultKind, RunFault
from semviz_core.diagnosis.reference import FrameReference, ProgressCallback, no_progress

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
