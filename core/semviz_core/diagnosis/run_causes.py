"""Find what is wrong in many frames of a run at once, and say so: assumptions, and common causes.

An assumption that fails in many frames is a fault of the run. The causes of `common_causes` are
fitted to all frames together, by `cause_fits`. Each names the frames that it fixes: those healthy
once it is corrected, of the ones that are not, solved again.
"""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from semviz_core.base.frame import Odometry
from semviz_core.common.arrays import FloatArray
from semviz_core.diagnosis.assumptions import (
    FACTORS,
    check_assumptions,
    prior_faults,
    solve_with_prior,
    solve_with_sigma,
)
from semviz_core.diagnosis.cause_fits import RIVAL_NATS, CauseFit, RatedCause
from semviz_core.diagnosis.common_causes import CALIBRATIONS
from semviz_core.diagnosis.fault import EvidenceItem, Fault, FaultKind, RunFault
from semviz_core.diagnosis.frame_causes import likeliest_sigma_fault, sigma_gains
from semviz_core.diagnosis.joint_fit import JointFit, joint_fits
from semviz_core.diagnosis.odometry import DRIFTS, drift_sentence
from semviz_core.diagnosis.prior_offsets import PriorOffset
from semviz_core.diagnosis.reference import (
    FrameReference,
    ProgressCallback,
    is_healthy,
    no_progress,
)

NEEDED_FRAMES = 3
LEAST_FRAMES_SHARE = 0.1
"""Share of the frames in which an assumption must be wrong to be a fault of the run."""


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
    reported.pop("wrong detection sigma", None)  # the frames together tell more
    needed = max(NEEDED_FRAMES, LEAST_FRAMES_SHARE * len(cases))
    faults = [
        _assumption_fault(kind, frames, len(cases))
        for kind, frames in reported.items()
        if len(frames) >= needed
    ]
    sigma = _sigma_run_fault(cases)
    return sorted([*faults, *sigma], key=lambda fault: -len(fault.frames))


def joint_fault(
    cases: Sequence[FrameReference], odometry: Sequence[Odometry | None]
) -> RunFault | None:
    """Return the cause that poses, elements and odometry fitted together support, if any.

    No frame has a true pose; ``cases`` have the poses that odometry carries to them.
    """
    fits = joint_fits(cases, odometry)
    if not fits or not fits[0].is_fault:
        return None
    best = fits[0]
    rows = best.frames
    close = [fit for fit in fits[1:] if fit.is_fault and fit.nats > best.nats - RIVAL_NATS]
    rivals = {fit.cause.kind: fit.cause.name for fit in close if fit.cause.kind != best.cause.kind}
    if best.cause.kind == "wrong gravity prior":
        rivals["wrong calibration"] = "the camera is mounted rolled"
    size = float(best.value[np.argmax(np.abs(best.value))]) * best.cause.in_unit
    shown = f"{len(rows)} frames show it, fitted together."
    return RunFault(
        best.cause.kind,
        f"{_joint_size(best)}.{_rivals_sentence(list(rivals.values()))} {shown}",
        (
            EvidenceItem("frames", len(rows)),
            EvidenceItem(best.cause.name, size, best.cause.unit),
            EvidenceItem("strength", best.nats, "nats"),
        ),
        frames=rows,
        rivals=tuple(rivals),
    )


def _joint_size(fit: JointFit) -> str:
    """Return the cause with its size, as people read it."""
    kind, name, unit = fit.cause.kind, fit.cause.name, fit.cause.unit
    values = fit.value * fit.cause.in_unit
    size = abs(float(values[0]))
    for k, (drift, _, _) in enumerate(DRIFTS):
        if name == drift:
            return f"The odometry is wrong: {drift_sentence(k, float(values[0]))}"
    if kind == "wrong detection sigma":
        return f"The detections are about {size:.1f} times less accurate than they state"
    if kind == "wrong gravity prior":
        return f"The gravity prior is rolled by {size:.1f} deg"
    if kind in ("wrong heading prior", "wrong height prior"):
        return f"The {name} prior is {size:.1f} {unit} off"
    down = f" across and {values[-1]:+.1f} {unit} down" if len(values) > 1 else ""
    return f"The {name} is off by {values[0]:+.1f} {unit}{down}"


def _assumptions(case: FrameReference) -> tuple[Fault, ...]:
    if case.truth is not None or case.localization.status == "ok":
        return prior_faults(case)
    cause = check_assumptions(case)
    return () if cause is None else (cause,)


def _assumption_fault(
    kind: FaultKind, reported: Sequence[tuple[int, Fault]], total: int
) -> RunFault:
    """Return the fault of a run, with the evidence of the frame in the middle."""
    ordered = sorted((fault for _, fault in reported), key=lambda fault: fault.evidence[0].value)
    middle = ordered[len(ordered) // 2]
    also = " A camera that is mounted rolled looks the same." * (kind == "wrong gravity prior")
    return RunFault(
        kind,
        f"In {len(reported)} of {total} frames, typically: {middle.sentence}{also}",
        (EvidenceItem("frames", len(reported)), *middle.evidence),
        frames=tuple(row for row, _ in reported),
        rivals=("wrong calibration",) if also else (),
    )


def _sigma_run_fault(cases: Sequence[FrameReference]) -> list[RunFault]:
    """Return the fault of sigmas that all frames together tell, if any."""
    gains = {row: _sigma_gains(case) for row, case in enumerate(cases)}
    known = {row: gain for row, gain in gains.items() if gain is not None}
    if len(known) < NEEDED_FRAMES:
        return []
    fault = likeliest_sigma_fault(np.concatenate(list(known.values()), axis=1))
    if fault is None:
        return []
    return [
        RunFault(
            fault.kind,
            f"In {len(known)} of {len(cases)} frames together: {fault.sentence}",
            (EvidenceItem("frames", len(known)), *fault.evidence),
            frames=tuple(known),
        )
    ]


def _sigma_gains(case: FrameReference) -> FloatArray | None:
    """Return ``sigma_gains`` at the pose of a frame; if it has none, at that with larger sigmas."""
    if case.truth is not None or case.localization.status == "ok":
        return sigma_gains(case, case.localization)
    again = solve_with_sigma(case, FACTORS[-1])
    return sigma_gains(case, again) if again.status == "ok" else None


def cause_fault(
    best: RatedCause, rivals: Sequence[RatedCause], watch: ProgressCallback = no_progress
) -> RunFault:
    """Return the fault of a common cause, with the frames that are healthy once it is corrected."""
    fit = best.fit
    corrected = [fit.corrected(row) for row in range(len(fit.frames.cases))]
    watched = watch(corrected, "solving without the common cause", len(corrected))
    frames = tuple(row for row, case in enumerate(watched) if _is_fixed(case, fit))
    is_calibration = fit.cause in CALIBRATIONS
    sentence = _calibration_sentence(fit) if is_calibration else _offset_sentence(fit)
    sentence += _rivals_sentence([rival.fit.cause.name for rival in rivals])
    evidence = [EvidenceItem("frames", len(fit.frames.fitted))]
    if is_calibration:
        largest = float(fit.value[np.argmax(np.abs(fit.value))]) * fit.cause.in_unit
        evidence = [EvidenceItem(fit.cause.name, largest, fit.cause.unit)]
    evidence.append(EvidenceItem("strength", best.nats, "nats"))
    return RunFault(fit.cause.kind, sentence, tuple(evidence), frames=frames)


def prior_offset_fault(
    offsets: Sequence[PriorOffset],
    corrected: Sequence[FrameReference],
    watch: ProgressCallback = no_progress,
) -> RunFault:
    """Return the fault of what all position priors have in common, ``offsets`` by likelihood.

    Its frames are those of ``corrected`` that are healthy, solved with their corrected prior.
    """
    best, *rivals = offsets
    watched = watch(corrected, "solving with corrected priors", len(corrected))
    frames = tuple(row for row, case in enumerate(watched) if _is_healthy_again(case))
    return RunFault(
        best.pattern.kind,
        f"In {len(best.row)} frames, the position priors are off alike: {_prior_sentence(best)}."
        + _rivals_sentence([rival.pattern.name for rival in rivals]),
        (
            EvidenceItem("frames", len(best.row)),
            EvidenceItem("off", best.size_m, "m"),
            EvidenceItem("strength", best.nats, "nats"),
        ),
        frames=frames,
    )


def _prior_sentence(offset: PriorOffset) -> str:
    value = offset.value
    if offset.pattern.kind == "time offset":
        late = "later" if value[0] > 0.0 else "earlier"
        return f"the images are {abs(value[0]):.2f} frames {late} than their priors"
    if offset.pattern.kind == "wrong extrinsic":
        ahead, left = _toward(value[0], "ahead", "back"), _toward(value[1], "left", "right")
        return f"they are those of a point {ahead} and {left} of the camera"
    return (
        f"the images show the camera {-value[0]:+.2f}, {-value[1]:+.2f} m (x, y) from there, so "
        "the map is shifted by that, or the priors are in another datum"
    )


def _rivals_sentence(names: Sequence[str]) -> str:
    if not names:
        return ""
    return f" This drive cannot tell it from another cause: {' or '.join(names)}."


def _is_healthy_again(case: FrameReference) -> bool:
    """Whether a frame is healthy, solved again with its prior if it is not."""
    if is_healthy(case.localization, case.truth):
        return True
    given = case.localization.prior is not None
    return given and is_healthy(solve_with_prior(case, case.prior), case.truth)


def _is_fixed(case: FrameReference, fit: CauseFit) -> bool:
    """Whether a corrected frame is healthy; with another calibration, it is solved again."""
    if fit.cause in CALIBRATIONS:
        return _is_healthy_again(case)
    return is_healthy(case.localization, case.truth)


def _calibration_sentence(fit: CauseFit) -> str:
    values, unit = fit.value * fit.cause.in_unit, fit.cause.unit
    size = f"{values[0]:+.1f} {unit}"
    if len(values) > 1:
        size += f" across and {values[1]:+.1f} {unit} down"
    return f"The residuals of all frames fit an error of {size} in {fit.cause.name}."


def _offset_sentence(fit: CauseFit) -> str:
    """Return the cause with its size, as people read it."""
    frames = len(fit.frames.fitted)
    return f"In {frames} frames all elements are off together: {_described(fit)}."


def _described(fit: CauseFit) -> str:
    value: FloatArray = fit.value
    kind = fit.cause.kind
    if kind == "time offset":
        late = "later" if value[0] > 0.0 else "earlier"
        return f"the images are {abs(value[0]):.2f} frames {late} than their poses"
    if kind == "wrong extrinsic":
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
