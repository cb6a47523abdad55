"""Find and name what is wrong with poses and stereo calibration: common causes before single ones.

First come explanations of the whole drive: axes, time, heights, then the calibration of the rig.
What remains are stretches of frames that refining moves. A fault is named only if it is large
enough to matter and many times its sigma.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, Literal, TypeAlias

import numpy as np

from semviz_core.base.camera import Rig
from semviz_core.base.frame import Frame
from semviz_core.common.arrays import BoolArray, FloatArray
from semviz_core.pose_checks import whole_drive
from semviz_core.pose_checks.comparison import (
    BASELINE,
    RIGHT_U,
    RIGHT_V,
    DrivePoses,
    PoseComparison,
    compare,
    rows_of_runs,
)
from semviz_core.pose_checks.image_motions import ImageMotions
from semviz_core.pose_checks.pose_covariance import PoseCovariance
from semviz_core.pose_checks.refinement import PoseRefinement, refine, stretches

FaultKind: TypeAlias = Literal[
    "axes", "time", "heights", "baseline", "right image", "frozen", "turned", "shifted"
]
LEAST_TURN_RAD, LEAST_SHIFT_M = float(np.deg2rad(0.2)), 0.12
"""Smaller moves of poses are not named."""
LEAST_SCALE, LEAST_OFFSET_PX = 0.005, 0.2
SCALE_FLOOR, OFFSET_FLOOR_PX = 0.0012, 0.02
"""Errors of the estimates, on top of their sigma."""
SIGMAS = 4.0
FROZEN_SHARE = 0.02
FROZEN_PX = 1.0
"""A pose is frozen if it moves less than this share of what the images show, and those show
parallax of so many pixels."""
MIN_FROZEN = 2
"""Pairs of frames in a row."""
MIN_MEASURED = 0.5
"""Share of pairs that the images must measure for a check."""


@dataclass(frozen=True)
class PoseFault:
    """One fault. ``first`` and ``last`` are frame numbers."""

    kind: FaultKind
    first: int
    last: int
    text: str
    """What is wrong, one line."""
    remedy: str
    """What to do, one line."""
    turn_deg: float = 0.0
    """Largest turn of the given poses against the images."""
    shift_m: float = 0.0
    """Largest shift of the given poses against the images."""
    value: float | None = None
    """time: frames; heights: m; baseline: the true one, m; right image: px."""
    sigmas: float | None = None
    """Value over its sigma."""


@dataclass(frozen=True, eq=False)
class PoseCheck:
    """All that images say about the poses of a drive."""

    frames: tuple[Frame, ...]
    motions: ImageMotions
    comparison: PoseComparison
    """Of the poses after the corrections of the whole drive."""
    refinement: PoseRefinement
    """Of those poses, against the given ones after the same corrections."""
    faults: tuple[PoseFault, ...]
    measured: float
    """Share of the pairs with poses that the images measure."""

    @property
    def is_checked(self) -> bool:
        """False if the images show too little."""
        return self.measured >= MIN_MEASURED and bool(self.comparison.compared.any())

    @property
    def unchecked(self) -> tuple[tuple[int, int], ...]:
        """First and last frame of each stretch whose poses the images say too little about."""
        known = np.array([frame.T_map_camera is not None for frame in self.frames])
        is_open = known[:-1] & known[1:] & ~self.comparison.compared
        edges = np.flatnonzero(np.diff(np.concatenate([[False], is_open, [False]])))
        numbers = [frame.index for frame in self.frames]
        return tuple(
            (numbers[first], numbers[last]) for first, last in edges.reshape(-1, 2).tolist()
        )

    @property
    def wrong_frames(self) -> tuple[int, ...]:
        """Frames of faults that do not hold for the whole drive."""
        local = [fault for fault in self.faults if fault.kind in LOCAL_KINDS]
        return tuple(
            frame.index
            for frame in self.frames
            if any(fault.first <= frame.index <= fault.last for fault in local)
        )

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        sigma = self.comparison.pose_sigma
        rig = self.comparison.rig
        return {
            "checked": self.is_checked,
            "frames": len(self.frames),
            "pairs_measured": int(self.comparison.compared.sum()),
            "unchecked": [list(stretch) for stretch in self.unchecked],
            "faults": [asdict(fault) for fault in self.faults],
            "good_poses": {
                "sigma_m": [round(float(value), 5) for value in sigma[:3]],
                "sigma_deg": [round(float(value), 5) for value in np.rad2deg(sigma[3:])],
            },
            "rig": {
                "baseline_ratio": float(np.exp(rig.values[BASELINE])),
                "right_image_px": [float(rig.values[RIGHT_U]), float(rig.values[RIGHT_V])],
                "sigma": [float(value) for value in rig.sigma],
            },
            "pairs": list(self._pairs()),
        }

    def _pairs(self) -> Iterator[dict[str, Any]]:
        for row in np.flatnonzero(self.comparison.compared).tolist():
            innovation = self.comparison.innovation[row]
            yield {
                "before": self.frames[row].index,
                "now": self.frames[row + 1].index,
                "shift_m": [round(float(value), 5) for value in innovation[:3]],
                "turn_deg": [round(float(value), 5) for value in np.rad2deg(innovation[3:])],
                "sigmas": round(float(np.sqrt(self.comparison.chi2[row])), 2),
            }


LOCAL_KINDS: Final = ("frozen", "turned", "shifted")
RIG_KINDS: Final = ("baseline", "right image")
"""Faults of the calibration, which other poses do not repair."""
_REFINE: Final = "refine them, or leave these frames out: semviz poses choose"


def check_drive(frames: Sequence[Frame], motions: ImageMotions, rig: Rig) -> PoseCheck:
    """Return the faults of the poses of ``frames`` and of ``rig`` against the images' motions."""
    given = DrivePoses.of(frames)
    faults: list[PoseFault] = []
    first, last = frames[0].index, frames[-1].index
    poses = given
    for correct, describe in _EXPLANATIONS:
        correction = correct(poses, motions)
        if correction is not None:
            faults.append(describe(correction, first, last))
            poses = correction.poses
    comparison = compare(poses, motions)
    faults += _rig_faults(comparison, rig, first, last)
    refinement = refine(poses, motions, comparison)
    if comparison.compared.any():
        faults += _local_faults(frames, poses, motions, refinement)
    pairs = max(int(given.pair_known.sum()), 1)
    measured = float((given.pair_known & motions.is_measured).sum() / pairs)
    return PoseCheck(tuple(frames), motions, comparison, refinement, tuple(faults), measured)


def _axes_fault(correction: whole_drive.Correction, first: int, last: int) -> PoseFault:
    return PoseFault(
        "axes",
        first,
        last,
        correction.text,
        "convert the pose file: semviz poses refine writes it with the right axes",
    )


def _time_fault(correction: whole_drive.Correction, first: int, last: int) -> PoseFault:
    late = correction.value
    word = "late" if late > 0.0 else "early"
    return PoseFault(
        "time",
        first,
        last,
        f"the poses are {abs(late):.2g} frames {word}: one offset of time explains all",
        "correct the times of the pose file, or take semviz poses refine, which shifts them",
        value=round(late, 3),
    )


def _height_fault(correction: whole_drive.Correction, first: int, last: int) -> PoseFault:
    return PoseFault(
        "heights",
        first,
        last,
        f"all heights are the same, but in the images they differ by {correction.value:.2f} m",
        "give poses with heights, or take semviz poses refine, which takes them from the images",
        value=round(correction.value, 3),
    )


_EXPLANATIONS: Final = (
    (whole_drive.corrected_axes, _axes_fault),
    (whole_drive.corrected_time, _time_fault),
    (whole_drive.corrected_heights, _height_fault),
)


def _rig_faults(comparison: PoseComparison, rig: Rig, first: int, last: int) -> Iterator[PoseFault]:
    errors = comparison.rig
    scale, scale_sigma = errors.values[BASELINE], np.hypot(errors.sigma[BASELINE], SCALE_FLOOR)
    if abs(scale) > max(LEAST_SCALE, SIGMAS * scale_sigma):
        right_m = rig.baseline_m * float(np.exp(scale))
        yield PoseFault(
            "baseline",
            first,
            last,
            f"distances between poses are {abs(np.expm1(scale)):.1%} "
            f"{'longer' if scale > 0.0 else 'shorter'} than stereo measures them: a baseline of "
            f"{right_m:.4f} m instead of {rig.baseline_m:.4f} m would agree",
            "check the right camera's calibration, or the scale of the poses",
            value=round(right_m, 5),
            sigmas=round(float(abs(scale) / scale_sigma), 1),
        )
    offset = errors.values[[RIGHT_U, RIGHT_V]]
    sigma = np.hypot(errors.sigma[[RIGHT_U, RIGHT_V]], OFFSET_FLOOR_PX)
    significant = np.abs(offset) > np.maximum(LEAST_OFFSET_PX, SIGMAS * sigma)
    if significant.any():
        words = [f"{abs(offset[0]):.2f} px to the {'right' if offset[0] > 0.0 else 'left'}"]
        words += [f"{abs(offset[1]):.2f} px {'down' if offset[1] > 0.0 else 'up'}"]
        shown = " and ".join(np.array(words)[significant])
        yield PoseFault(
            "right image",
            first,
            last,
            f"the right image lies {shown} of where its calibration puts it",
            "correct the principal point of the right camera by that, or rectify again",
            value=round(float(np.linalg.norm(offset[significant])), 3),
            sigmas=round(float((np.abs(offset) / sigma).max()), 1),
        )


def _local_faults(
    frames: Sequence[Frame], poses: DrivePoses, motions: ImageMotions, refinement: PoseRefinement
) -> Iterator[PoseFault]:
    frozen = _frozen_frames(poses, motions)
    runs = stretches(refinement, LEAST_SHIFT_M, LEAST_TURN_RAD)
    for first, last in rows_of_runs(frozen):
        yield _stretch_fault("frozen", frames, refinement, first, last)
    for first, last in runs:
        if frozen[first : last + 1].any():
            continue
        turn, shift = _largest(refinement, first, last)
        kind: FaultKind = "turned" if turn / LEAST_TURN_RAD >= shift / LEAST_SHIFT_M else "shifted"
        yield _stretch_fault(kind, frames, refinement, first, last)


def _frozen_frames(poses: DrivePoses, motions: ImageMotions) -> BoolArray:
    """Return (n,) frames with the pose of the frame before, although the images move."""
    seen = motions.parallax_px > FROZEN_PX
    moved = np.linalg.norm(motions.translation_m, axis=1)
    if not motions.has_stereo:
        moved = np.full(len(moved), float(np.median(poses.step_m())))
    still = poses.pair_known & motions.is_measured & seen
    still &= poses.step_m() < FROZEN_SHARE * moved
    frozen = np.zeros(len(poses), dtype=bool)
    for first, last in rows_of_runs(still):
        if last - first + 1 >= MIN_FROZEN:
            frozen[first + 1 : last + 2] = True
    return frozen


def _largest(refinement: PoseRefinement, first: int, last: int) -> tuple[float, float]:
    """Return the largest turn (rad) and shift (m) of a stretch."""
    rows = slice(first, last + 1)
    turn = np.linalg.norm(refinement.turn_rad[rows], axis=1).max()
    return float(turn), float(np.linalg.norm(refinement.shift_m[rows], axis=1).max())


def _stretch_fault(
    kind: FaultKind, frames: Sequence[Frame], refinement: PoseRefinement, first: int, last: int
) -> PoseFault:
    turn, shift = _largest(refinement, first, last)
    where = (
        f"frame {frames[first].index}"
        if first == last
        else f"frames {frames[first].index}-{frames[last].index}"
    )
    words = {
        "frozen": "the pose stands still while the images move",
        "turned": f"poses turned by up to {np.rad2deg(turn):.1f} deg "
        f"{_side(refinement.turn_rad[first : last + 1])}, shifted by up to {shift:.2f} m",
        "shifted": f"poses shifted by up to {shift:.2f} m, turned by up to "
        f"{np.rad2deg(turn):.1f} deg",
    }
    return PoseFault(
        kind,
        frames[first].index,
        frames[last].index,
        f"{where}: {words[kind]}",
        _REFINE,
        turn_deg=round(float(np.rad2deg(turn)), 3),
        shift_m=round(shift, 3),
    )


def _side(turns: FloatArray) -> str:
    """Return where the largest of turns (k, 3), in camera axes, leads."""
    largest = turns[int(np.linalg.norm(turns, axis=1).argmax())]
    axis = int(np.abs(largest).argmax())
    positive = largest[axis] > 0.0
    return (("up", "down"), ("right", "left"), ("clockwise", "counterclockwise"))[axis][
        0 if positive else 1
    ]


def suspicions(frames: Sequence[Frame]) -> tuple[str, ...]:
    """Return what poses show without any image: constant heights, poses that stand still."""
    poses = DrivePoses.of(frames)
    if int(poses.known.sum()) < MIN_FROZEN + 2:
        return ()
    step_m = poses.step_m()
    usual_m = float(np.median(step_m[poses.pair_known])) if poses.pair_known.any() else 0.0
    found = []
    if (
        usual_m > 10.0 * whole_drive.FLAT_M
        and float(np.ptp(poses.center_m[poses.known, 2])) < whole_drive.FLAT_M
    ):
        found.append("all heights are the same")
    still = poses.pair_known & (step_m < 1e-9) & (usual_m > 0.05)
    for first, last in rows_of_runs(still):
        if last - first + 1 >= MIN_FROZEN:
            found.append(
                f"frames {frames[first].index}-{frames[last + 1].index} have exactly one pose"
            )
    return tuple(found)


def pose_covariance(check: PoseCheck, refined: Collection[int]) -> PoseCovariance:
    """Return the errors of the poses if the frames ``refined`` have refined ones."""
    index = np.array([frame.index for frame in check.frames], dtype=np.int64)
    return PoseCovariance.of(index, refined, check.refinement, check.comparison)


def refined_frames(check: PoseCheck) -> tuple[Frame, ...]:
    """Return the frames with refined poses; None where there was none."""
    poses = check.refinement.poses
    from semviz_core.base.pose import Pose

    return tuple(
        replace(frame, T_map_camera=Pose(poses.rotation[row], poses.center_m[row]))
        if poses.known[row]
        else replace(frame, T_map_camera=None)
        for row, frame in enumerate(check.frames)
    )
