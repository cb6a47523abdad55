"""One pose of a rig: errors beside the bound, by its cameras, its motion and its shutters.

    OMP_NUM_THREADS=1 python bench/rig.py [--frames 100] [--first-seed 0] [--readout-ms 30]

Elements lie scattered around a car with four cameras, of which two have distorting lenses; they
fire up to 41 ms apart and see at most eight elements each (`tests/rig_frames.py`). `right`: within
1 m and 2 deg. `RMS/bound`: root mean square of the position error of right frames over that of the
Cramer-Rao bound of the same frames. `NEES`: of a degree of freedom, median and mean of right
frames. Times are processor time of whole frames.
"""

from dataclasses import dataclass
from time import process_time
from typing import NamedTuple

import numpy as np
import tests_support  # noqa: F401  tests beside bench
import tyro
from rig_frames import RigFrame, RigKind, bound, make_rig_frame, without_times

from semviz_core.localization.camera_views import BodyMotion
from semviz_core.localization.rig import localize_rig
from semviz_core.metrics.pose_errors import pose_error

FAST = BodyMotion(np.array([10.0, 0.0, 0.0]), np.array([0.0, 0.0, np.deg2rad(20.0)]))
"""10 m/s, in a curve of 20 deg/s."""
RIGHT_M, RIGHT_DEG = 1.0, 2.0


@dataclass(frozen=True)
class Options:
    frames: int = 100
    first_seed: int = 0
    readout_ms: float = 30.0


class Told(NamedTuple):
    right: bool
    ok: bool
    said: bool
    """That the stated sigma is too small."""
    off_m: float
    bound_m: float
    nees: float
    time_ms: float


def main(options: Options) -> None:
    readout_s, seeds = 1e-3 * options.readout_ms, range(options.frames)
    all_four = ("front", "left", "right", "back")
    moving = RigKind(all_four, FAST, readout_s)
    sets: dict[str, tuple[RigKind, bool]] = {
        "front": (RigKind(("front",)), True),
        "front, back": (RigKind(("front", "back")), True),
        "four": (RigKind(all_four), True),
        "four, 3 elements each": (RigKind(all_four, most_seen=3), True),
        "front, moving": (RigKind(("front",), FAST, readout_s), True),
        "front, moving, ignored": (RigKind(("front",), FAST, readout_s), False),
        "four, moving": (moving, True),
        "four, moving, ignored": (moving, False),
    }
    for name, (kind, knows) in sets.items():
        frames = (make_rig_frame(options.first_seed + seed, kind) for seed in seeds)
        told = [_told(frame if knows else without_times(frame), kind) for frame in frames]
        print(f"{name:28}", _row(told), flush=True)


def _told(frame: RigFrame, kind: RigKind) -> Told:
    start = process_time()
    found = localize_rig(frame.views, frame.submap, frame.prior, motion=kind.motion)[0]
    time_ms = (process_time() - start) * 1e3
    covariance, pose = found.covariance, found.T_camera_map
    bound_m = float(np.sqrt(np.trace(bound(frame, kind)[:3, :3])))
    if pose is None or covariance is None:
        return Told(False, False, False, np.nan, bound_m, np.nan, time_ms)
    off_m, off_deg = pose_error(pose, frame.T_first_map)
    right = off_m < RIGHT_M and off_deg < RIGHT_DEG
    off = (frame.T_first_map @ pose.inverse()).log()
    nees = float(off @ np.linalg.solve(covariance, off)) / 6.0
    said = "stated sigma" in found.reason
    return Told(bool(right), found.status == "ok", said, off_m, bound_m, nees, time_ms)


def _row(told: list[Told]) -> str:
    right, ok, said, off_m, bound_m, nees, time_ms = (
        np.array(column) for column in zip(*told, strict=True)
    )
    rms = np.sqrt(np.mean(off_m[right] ** 2) / np.mean(bound_m[right] ** 2))
    return (
        f"right {right.mean():6.1%}  ok {ok.mean():6.1%}  false ok {(ok & ~right).mean():5.1%}  "
        f"sigma said too small {said.mean():4.0%}  {np.median(off_m[right]):.3f} m  "
        f"RMS/bound {rms:.2f}  NEES {np.median(nees[right]):.2f} {nees[right].mean():.2f}  "
        f"{np.median(time_ms):.1f} ms"
    )


if __name__ == "__main__":
    main(tyro.cli(Options))
