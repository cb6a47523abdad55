"""Poses that something beside the search proposes, settled and ranked among its modes."""

import numpy as np

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.frame import Prior
from semviz_core.pose import Pose, nearest_rotation
from semviz_core.solving.scene import Known, Scene
from semviz_core.solving.search import APART_M, APART_RAD, Modes, apart, camera_pose, mode_near
from semviz_core.solving.upright import likely_ups, upright_view

MOST_PROPOSED = 12
"""A quarter of a millisecond each."""


def with_proposed(modes: Modes, scene: Scene, prior: Prior, pose: FloatArray) -> Modes:
    """The modes with those that upright poses (h, 5) lead to, best first.

    ``pose`` is as in ``hypotheses.Hypotheses``, without tilt; the first MOST_PROPOSED are followed.
    """
    chosen = np.pad(pose[:MOST_PROPOSED], ((0, 0), (0, 1)))
    if not len(chosen):
        return modes
    ups, up_sigma_rad = likely_ups(scene, Known.of(prior))
    view = upright_view(scene, ups[0], up_sigma_rad)
    found = [modes]
    for row in chosen:
        rotation, translation = camera_pose(view, row)
        found.append(mode_near(scene, prior, Pose(nearest_rotation(rotation), translation)))
    together = _joined(found)
    return _at(together, _distinct(together))


def _joined(found: list[Modes]) -> Modes:
    return Modes(
        sum(one.tried for one in found),
        sum(one.passed for one in found),
        np.concatenate([one.rotation for one in found]),
        np.concatenate([one.translation for one in found]),
        np.concatenate([one.score for one in found]),
        np.concatenate([one.match for one in found]),
        np.concatenate([one.gain for one in found]),
    )


def _distinct(modes: Modes) -> IntArray:
    """Rows, best first, without modes close to a better one."""
    kept: list[int] = []
    for row in np.argsort(-modes.score, kind="stable").tolist():
        here = modes.rotation[row], modes.translation[row]
        away, angle = apart(*here, modes.rotation[kept], modes.translation[kept])
        if not ((away <= APART_M) & (angle <= APART_RAD)).any():
            kept.append(row)
    return np.array(kept, dtype=np.int64)


def _at(modes: Modes, rows: IntArray) -> Modes:
    return Modes(
        modes.tried,
        modes.passed,
        modes.rotation[rows],
        modes.translation[rows],
        modes.score[rows],
        modes.match[rows],
        modes.gain[rows],
    )
