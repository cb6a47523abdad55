"""Planted faults of poses and calibration: how many are found, named, and repaired.

    OMP_NUM_THREADS=1 python bench/pose_faults.py [--seeds 2000 2001] [--tracks FOLDER]
    OMP_NUM_THREADS=1 python bench/pose_faults.py --kitti /data/kitti

Streets of 40 frames are rendered, and points are tracked once; --tracks keeps those. Each fault is
planted with exact poses, and with errors of 1 cm and 0.02 deg from frame to frame.

Columns. found: named as what it is, and where it is (half of its frames). also: drives in which
something else was named as well. before, after: largest rotation error of a frame, median and 95 %
of the drives, for the given poses and the refined. stated: what that of the refined poses would be
by their covariance, which is what images and given poses tell. alarms: healthy drives with anything
named.
"""

import argparse
import pickle
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tests_support  # noqa: F401
from support.planted_pose_faults import (
    POSE_FAULTS,
    PlantedFault,
    noisy,
    with_baseline,
    with_right_image_moved,
)

from semviz_core.base.camera import Rig
from semviz_core.base.frame import Dataset, Frame
from semviz_core.common.arrays import FloatArray
from semviz_core.datasets.kitti import KittiSequence
from semviz_core.pose_checks.faults import (
    FaultKind,
    PoseCheck,
    check_drive,
    pose_covariance,
    refined_frames,
)
from semviz_core.pose_checks.image_motions import ImageMotions, motions_of
from semviz_core.pose_checks.tracks import PointTracks, tracks_of
from semviz_core.simulation.layout import StreetOptions
from semviz_core.simulation.street import Street

FRAMES = 40
DRAWS = 50
NOISE = ((0.0, 0.0), (0.01, 0.02))
"""Errors of poses, m and deg."""
WINDOW = 20
"""Frames of the healthy stretches that alarms are counted in, beside whole drives."""


@dataclass(frozen=True, eq=False)
class Drive:
    """A healthy drive and its tracks."""

    name: str
    frames: tuple[Frame, ...]
    rig: Rig
    tracks: list[PointTracks]
    motions: ImageMotions

    def window(self, first: int, count: int) -> tuple[tuple[Frame, ...], ImageMotions]:
        frames = self.frames[first : first + count]
        return frames, motions_of(self.tracks[first : first + count - 1], frames, self.rig)


@dataclass(frozen=True)
class Trial:
    """The outcome of one planted fault."""

    found: bool
    also: bool
    before_deg: float
    after_deg: float
    after_m: float
    stated_deg: FloatArray
    """(DRAWS,) worst rotation of a frame, drawn from the covariance of the refined poses."""


def opened(dataset: Dataset, name: str, folder: Path | None) -> Drive:
    path = None if folder is None else folder / f"{name}.pkl"
    if path is not None and path.exists():
        tracks = pickle.loads(path.read_bytes())
    else:
        tracks = list(tracks_of(dataset, dataset.frames))
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(pickle.dumps(tracks))
    motions = motions_of(tracks, dataset.frames, dataset.rig)
    return Drive(name, dataset.frames, dataset.rig, tracks, motions)


def trial(
    truth: Sequence[Frame], planted: PlantedFault, kinds: Sequence[FaultKind], check: PoseCheck
) -> Trial:
    named = [fault for fault in check.faults if fault.kind in kinds]
    if planted.first is not None and planted.last is not None:
        wanted = set(range(planted.first, planted.last + 1))
        named = [
            fault
            for fault in named
            if 2 * len(wanted & set(range(fault.first, fault.last + 1))) >= len(wanted)
        ]
    before, _ = errors(truth, planted.frames)
    after, after_m = errors(truth, refined_frames(check))
    also = len(check.faults) > len(named)
    return Trial(bool(named), also, before, after, after_m, stated_deg(check))


def stated_deg(check: PoseCheck) -> FloatArray:
    """Return draws (DRAWS,) of the largest rotation error of refined poses as they are stated."""
    rows = np.flatnonzero(check.refinement.poses.known)
    covariance = pose_covariance(check, {frame.index for frame in check.frames}).at(rows)
    drawn = np.random.default_rng(0).multivariate_normal(
        np.zeros(len(covariance)), covariance, DRAWS, check_valid="ignore", method="eigh"
    )
    turns = np.linalg.norm(drawn.reshape(DRAWS, len(rows), 6)[:, :, 3:], axis=2)
    return np.asarray(np.rad2deg(turns.max(axis=1)))


def errors(truth: Sequence[Frame], frames: Sequence[Frame]) -> tuple[float, float]:
    """Return the largest error of a frame: rotation (deg) and position (m)."""
    both = [
        (first.T_map_camera.inverse() @ second.T_map_camera).log()
        for first, second in zip(truth, frames, strict=True)
        if first.T_map_camera is not None and second.T_map_camera is not None
    ]
    off = np.array(both)
    turn, shift = np.linalg.norm(off[:, 3:], axis=1), np.linalg.norm(off[:, :3], axis=1)
    return float(np.rad2deg(turn.max())), float(shift.max())


def trials_of_fault(drives: Sequence[Drive], name: str, known: set[FaultKind]) -> Iterator[Trial]:
    plant, kinds = POSE_FAULTS[name]
    for number, drive in enumerate(drives):
        for level, noise in enumerate(NOISE):
            rng = np.random.default_rng([number, level])
            planted = plant(noisy(drive.frames, *noise, rng), rng)
            check = check_drive(planted.frames, drive.motions, drive.rig)
            yield trial(drive.frames, planted, kinds, without(check, known - set(kinds)))


def without(check: PoseCheck, kinds: set[FaultKind]) -> PoseCheck:
    """Leave out what is known to be wrong with a drive."""
    from dataclasses import replace

    return replace(check, faults=tuple(f for f in check.faults if f.kind not in kinds))


def rig_trials(drives: Sequence[Drive], name: str, known: set[FaultKind]) -> Iterator[Trial]:
    kind: FaultKind = "baseline" if name.startswith("baseline") else "right image"
    for number, drive in enumerate(drives):
        sign = 1.0 if number % 2 else -1.0
        rig, tracks = drive.rig, drive.tracks
        if kind == "baseline":
            rig = with_baseline(rig, 1.0 + sign * 0.01)
        else:
            offset = np.array([sign, 0.0] if name.endswith("across") else [0.0, sign]) * 0.45
            tracks = [with_right_image_moved(track, offset) for track in tracks]
        motions = motions_of(tracks, drive.frames, rig)
        for level, noise in enumerate(NOISE):
            frames = noisy(drive.frames, *noise, np.random.default_rng([number, level]))
            check = without(check_drive(frames, motions, rig), known - {kind})
            yield trial(drive.frames, PlantedFault(frames), (kind,), check)


RIG_FAULTS = ("baseline, 1 %", "right image 0.45 px across", "right image 0.45 px down")


def healthy(drives: Sequence[Drive], known: set[FaultKind]) -> Iterator[tuple[str, PoseCheck]]:
    for number, drive in enumerate(drives):
        last = len(drive.frames) - WINDOW
        windows = {(0, len(drive.frames)), *((first, WINDOW) for first in range(0, last + 1, 5))}
        for first, count in sorted(windows):
            frames, motions = drive.window(first, count)
            for level, noise in enumerate(NOISE):
                rng = np.random.default_rng([number, level, first])
                given = noisy(frames, *noise, rng)
                check = check_drive(given, motions, drive.rig)
                yield f"{drive.name} {first}:{first + count} noise {level}", without(check, known)


def show(name: str, trials: Sequence[Trial]) -> None:
    found = np.mean([one.found for one in trials])
    also = np.mean([one.also for one in trials])
    before = np.median([one.before_deg for one in trials])
    after = np.percentile([one.after_deg for one in trials], [50, 95])
    after_m = np.percentile([one.after_m for one in trials], [50, 95])
    stated = np.percentile([one.stated_deg for one in trials], [50, 95])
    print(
        f"| {name} | {len(trials)} | {found:.0%} | {also:.0%} | {before:.2f} | "
        f"{after[0]:.3f}, {after[1]:.3f} | {stated[0]:.3f}, {stated[1]:.3f} | "
        f"{after_m[0]:.3f}, {after_m[1]:.3f} |",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="*", default=list(range(2000, 2020)))
    parser.add_argument("--kitti", type=Path, help="root of KITTI: plant into sequence 02 instead")
    parser.add_argument("--tracks", type=Path, help="folder that keeps tracks")
    arguments = parser.parse_args()
    if arguments.kitti is not None:
        drives = [opened(KittiSequence(arguments.kitti), "kitti02", arguments.tracks)]
        own = check_drive(drives[0].frames, drives[0].motions, drives[0].rig)
        known = {fault.kind for fault in own.faults}
        print("as it is:", *(fault.text for fault in own.faults), sep="\n  ")
        drives *= 10  # other places of the same faults
    else:
        known = set()
        drives = [
            opened(Street(seed, StreetOptions(FRAMES)), f"street{seed}-{FRAMES}", arguments.tracks)
            for seed in arguments.seeds
        ]
    print("| fault | drives | found | also | before, deg | after, deg | stated, deg | after, m |")
    print("|---|---|---|---|---|---|---|---|")
    for name in POSE_FAULTS:
        show(name, list(trials_of_fault(drives, name, known)))
    for name in RIG_FAULTS:
        show(name, list(rig_trials(drives[: 2 if arguments.kitti else None], name, known)))
    checks = list(healthy(drives[: 1 if arguments.kitti else None], known))
    alarms = [(name, check) for name, check in checks if check.faults]
    print(f"alarms: {len(alarms)} of {len(checks)} healthy drives")
    for name, check in alarms:
        print(" ", name, "; ".join(fault.text for fault in check.faults))


if __name__ == "__main__":
    main()
