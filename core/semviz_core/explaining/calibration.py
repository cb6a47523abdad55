"""Residuals that follow a pattern over the image in all frames: a camera that is not as stated.

Focal length, principal point and roll are estimated together from all pairs of a run, linearly.
Where the true pose is not known, each frame's own pose is estimated beside them, with its prior,
and marginalized (Schur complement), so that only what no pose explains is left.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.explaining.case import Case, Watch, unwatched
from semviz_core.explaining.told import Evidence, Fault
from semviz_core.solving.association import associate
from semviz_core.solving.known import MOST_ROWS, known_rows
from semviz_core.solving.residuals import SURE, fill_rows, new_rows, whiten
from semviz_core.solving.scene import Known, Scene
from semviz_core.solving.search import COARSE
from semviz_core.solving.upright import assumed_upright

PATTERNS = ("focal length", "principal point, across", "principal point, up or down", "roll")
UNITS = ("%", "px", "px", "deg")
IN_UNITS: FloatArray = np.array([100.0, 1.0, 1.0, np.rad2deg(1.0)])
"""From what is estimated (share, px, px, rad) to ``UNITS``."""
LEAST: FloatArray = np.array([0.5, 2.0, 2.0, 0.3])
"""In ``UNITS``: less is within what calibrations are good for."""
LEAST_SIGMAS = 6.0
NEEDED_PAIRS = 12
OFF_SIGMAS = 4.0
EXPLAINED, EXPLAINED_BLIND = 0.4, 0.1
"""Of all squared residuals, a pattern must explain so much, with and without the true poses: a
moved element looks like a pattern too. Poses that are estimated take most of it up themselves."""
_SCALES = (30.0, 15.0, 8.0, 4.0, 4.0)
"""Sigmas beyond which rows count less, from round to round."""
_STEP = np.array([1e-4, 0.1, 0.1])


def calibration_fault(cases: Sequence[Case], watch: Watch = unwatched) -> Fault | None:
    """The strongest pattern, where there is one."""
    watched = watch(cases, "looking for a pattern over the image", len(cases))
    blocks = [one for case in watched for one in _blocks(case)]
    if sum(len(own) // 2 for own, _, _ in blocks) < NEEDED_PAIRS:
        return None
    value, sigma = _estimate(blocks)
    told, strength = value * IN_UNITS, np.abs(value) / sigma
    shown = (strength > LEAST_SIGMAS) & (np.abs(told) > LEAST)
    explained = 1.0 - _cost(blocks, value) / _cost(blocks, np.zeros(4))
    least = EXPLAINED_BLIND if any(case.truth is None for case in cases) else EXPLAINED
    if not shown.any() or explained < least:
        return None
    k = int(np.argmax(np.where(shown, strength, 0.0)))
    also = " or mounting" if k else ""
    name = "roll of the mounting" if k == 3 else PATTERNS[k].split(",")[0] + also
    return Fault(
        "wrong calibration",
        f"In all frames the image is off as by a {name} wrong by {told[k]:+.1f} {UNITS[k]}.",
        (
            Evidence(PATTERNS[k], float(told[k]), UNITS[k]),
            Evidence("strength", strength[k], "sigma"),
        ),
    )


Block = tuple[FloatArray, FloatArray, FloatArray]
"""Whitened residuals (r,), their derivatives by calibration (r, 4), and by the pose (r, 0 or 6)."""


def _blocks(case: Case) -> Iterator[Block]:
    """One block for each frame with pairs."""
    pairs = _pairs(case)
    if not len(pairs) or case.reference is None:
        return
    own, by_pose = _rows(case, case.scene, pairs)
    by_camera = np.empty((len(own), 4))
    for k in range(3):
        by_camera[:, k] = (_rows(case, _changed(case, k), pairs)[0] - own) / _STEP[k]
    by_camera[:, 3] = by_pose[:, 5]
    if case.truth is not None:
        yield own, by_camera, np.empty((len(own), 0))
        return
    prior, slope = _prior_rows(case)
    yield (
        np.append(own, prior),
        np.concatenate([by_camera, np.zeros((len(prior), 4))]),
        np.concatenate([by_pose, slope]),
    )


def _pairs(case: Case) -> IntArray:
    """(k, 2) true pairs where known; else the nearest, within much more than noise."""
    if case.ids is not None or case.reference is None:
        return case.same_class
    match, _ = associate(case.scene, case.reference.rotation, case.reference.translation, COARSE)
    rows = np.flatnonzero(match >= 0)
    return np.column_stack([rows, match[rows]])


def _rows(case: Case, scene: Scene, pairs: IntArray) -> tuple[FloatArray, FloatArray]:
    """Whitened residuals (r,) of all but bottoms, and derivatives by the pose (r, 6)."""
    assert case.reference is not None
    R, t = case.reference.rotation, case.reference.translation
    rows, own, by_pose = new_rows(), [], []
    for i, j in pairs:
        if (count := fill_rows(scene, R, t, i, j, rows)) < 2:
            continue
        peak = scene.seen[i]["known"][0] and scene.mapped[j]["known"][0]
        count = min(count, 3 if peak else 2)  # bottoms may be hidden
        whiten(scene, i, j, count, SURE, rows)
        own.append(rows["residual"][:count].copy())
        by_pose.append(rows["jacobian"][:count].copy())
    return np.concatenate(own), np.concatenate(by_pose)


def _changed(case: Case, k: int) -> Scene:
    """The scene of a camera with one parameter of ``PATTERNS`` a step larger."""
    one = case.localization
    K = one.camera.K.copy()
    if k == 0:
        K[[0, 1], [0, 1]] *= 1.0 + _STEP[0]
    else:
        K[k - 1, 2] += _STEP[k]
    return Scene.of(replace(one.camera, K=K), one.observed, case.nearby, case.detector)


def _prior_rows(case: Case) -> tuple[FloatArray, FloatArray]:
    assert case.reference is not None
    residual, slope = np.zeros(MOST_ROWS), np.zeros((MOST_ROWS, 6))
    known = Known.of(assumed_upright(case.localization.prior))
    pose = case.reference
    count = known_rows(known, pose.rotation, pose.translation, residual, slope)
    return residual[:count], slope[:count]


def _estimate(blocks: Sequence[Block]) -> tuple[FloatArray, FloatArray]:
    """(4,) values and sigmas; rows that fit no calibration count next to nothing in the end."""
    value: FloatArray = np.zeros(4)
    information = np.eye(4)
    for scale in _SCALES:
        information, gradient = 1e-6 * np.eye(4), np.zeros(4)
        for own, by_camera, by_pose in blocks:
            left = own + by_camera @ value
            root = 1.0 / (1.0 + (left / scale) ** 2)  # Geman and McClure's weight, its root
            A, r = _without_pose(root[:, None] * by_camera, root[:, None] * by_pose, root * own)
            information += A.T @ A
            gradient -= A.T @ r
        value = np.asarray(np.linalg.solve(information, gradient), dtype=np.float64)
    return value, np.sqrt(np.diag(np.linalg.inv(information)))


def _cost(blocks: Sequence[Block], value: FloatArray) -> float:
    """Sum of squares, no row more than ``OFF_SIGMAS`` squared."""
    left = (r + A @ value for A, r in (_without_pose(A, J, r) for r, A, J in blocks))
    return sum(float(np.minimum(one**2, OFF_SIGMAS**2).sum()) for one in left)


def _without_pose(
    by_camera: FloatArray, by_pose: FloatArray, own: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """What is left of rows once the best pose is taken out."""
    if not by_pose.shape[1]:
        return by_camera, own
    Q, _ = np.linalg.qr(by_pose)
    return by_camera - Q @ (Q.T @ by_camera), own - Q @ (Q.T @ own)
