"""What is checked of a sequence before anybody works with it: the sizes of its images, its poses.

Each check raises SemvizError only where it is sure, names what is wrong and says that nothing was
loaded. ``sides`` has the check that reads images, ``calibration`` what changed since another time.
"""

from collections.abc import Sequence

import numpy as np

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.camera import Rig
from semviz_core.errors import SemvizError
from semviz_core.frame import Frame

RESIZED = 1.25
"""Images whose middle is this many times nearer or further than the principal point, in both
directions alike, were resized after the calibration. Cropping moves one of the two, or both apart.
"""
ALIKE = 1.15

STEP_M = 1.0
"""Directions are taken over so much of the way: of shorter steps they are noise."""
FEWEST_STEPS = 5
STEADY = 0.9
STEADIER = 0.05
"""Mean length of unit steps: 1 where all lead the same way. KITTI's own, in any window of 20 frames
or more: 0.02 at most above those of its inverted poses, and 0.89 at least by themselves."""
MOSTLY = 0.8
"""Of the steps."""
JUMP_M_S = 60.0
JUMP = 5.0
"""A jump is faster than both: 60 m/s, and five times the usual speed."""


def check_sizes(rig: Rig) -> None:
    """Refuses a camera whose calibration is plainly for images of another size."""
    for side, camera in (("left", rig.left), ("right", rig.right)):
        if camera is None:
            continue
        cx, cy = camera.K[:2, 2]
        across, down = (2.0 * cx + 1.0) / camera.width, (2.0 * cy + 1.0) / camera.height
        size = f"{camera.width}x{camera.height}"
        if not (0.0 < across < 2.0 and 0.0 < down < 2.0) or _resized(across, down):
            raise SemvizError(
                f"the {side} images are {size}, but the calibration is for about "
                f"{2.0 * cx:.0f}x{2.0 * cy:.0f} (principal point {cx:.1f} {cy:.1f}). Nothing was "
                "loaded; use the images' own size, or scale the calibration with them"
            )


def _resized(across: float, down: float) -> bool:
    smaller, larger = sorted((across, down))
    if smaller <= 0.0 or larger / smaller > ALIKE:
        return False
    return smaller > RESIZED or larger < 1.0 / RESIZED


def check_poses(frames: Sequence[Frame]) -> None:
    """Refuses poses that jump, or that were given the wrong way round.

    A vehicle moves along one direction of its camera's axes. Where it turns, only poses that are
    the right way round (``T_map_camera``) say so: that shows inverted ones, whichever way the
    camera looks. Where it goes straight, or round in a circle, both do; then poses that don't lead
    ahead are refused.
    """
    posed = [(frame, frame.T_map_camera) for frame in frames if frame.T_map_camera is not None]
    if len(posed) < 2:
        return
    R = np.array([pose.rotation for _, pose in posed])
    t = np.array([pose.translation for _, pose in posed])
    _check_direction(R, t)
    _check_jumps([frame for frame, _ in posed], t)


def _check_direction(R: FloatArray, t: FloatArray) -> None:
    """``T_map_camera`` by its rotations (n, 3, 3) and translations (n, 3)."""
    rows = _apart(t)
    if len(rows) <= FEWEST_STEPS:
        return
    R, t = R[rows], t[rows]
    R_inverse = R.transpose(0, 2, 1)
    given = _directions(R, t)
    inverted = _directions(R_inverse, -np.einsum("nij,nj->ni", R_inverse, t))
    gain = _steadiness(inverted) - _steadiness(given)
    if gain > STEADIER and _steadiness(inverted) > STEADY:
        raise SemvizError(
            "the poses are inverted (T_camera_map where T_map_camera is expected): as given, the "
            "camera moves now this way, now that; turned round, always the same way. "
            "Nothing was loaded"
        )
    if abs(gain) <= STEADIER and (where := _elsewhere(given)):
        raise SemvizError(
            f"the camera moves {where}: the poses are inverted (T_camera_map where T_map_camera "
            "is expected). Nothing was loaded"
        )


def _check_jumps(frames: Sequence[Frame], t: FloatArray) -> None:
    gaps_m = np.linalg.norm(np.diff(t, axis=0), axis=1)
    gaps_s = np.diff([frame.time_s for frame in frames])
    speeds = gaps_m / np.maximum(gaps_s, max(float(np.median(gaps_s)), 1e-3))
    worst = int(speeds.argmax())
    if speeds[worst] > max(JUMP_M_S, JUMP * float(np.median(speeds))):
        one, two = frames[worst], frames[worst + 1]
        raise SemvizError(
            f"the poses jump: frame {two.index} is {gaps_m[worst]:.1f} m from frame {one.index}, "
            f"{gaps_s[worst]:.2f} s later. Nothing was loaded"
        )


def _apart(t: FloatArray) -> IntArray:
    """Rows of ``t`` (n, 3), each at least ``STEP_M`` from the one before."""
    rows = [0]
    for row in range(1, len(t)):
        if np.abs(step := t[row] - t[rows[-1]]).sum() >= STEP_M and step @ step >= STEP_M**2:
            rows.append(row)
    return np.array(rows)


def _directions(R: FloatArray, t: FloatArray) -> FloatArray:
    """(k, 3) unit: the steps of ``T_map_camera`` (R (n, 3, 3), t (n, 3)) in the camera's axes."""
    steps = np.einsum("nij,ni->nj", R[:-1], np.diff(t, axis=0))
    lengths = np.linalg.norm(steps, axis=1)
    return np.asarray(steps[lengths > 0.0] / lengths[lengths > 0.0, None])


def _steadiness(directions: FloatArray) -> float:
    return float(np.linalg.norm(directions.mean(axis=0))) if len(directions) else 0.0


def _elsewhere(directions: FloatArray) -> str:
    """Where most steps lead, if not ahead: within 60 degrees of the optical axis."""
    z = directions[:, 2]
    for where, share in (("backwards", (z < -0.5).mean()), ("sideways", (np.abs(z) <= 0.5).mean())):
        if share >= MOSTLY:
            return f"{where} in {share:.0%} of its steps"
    return ""
