"""Method `direct`: classes alone fix the matches, or it says that they don't."""

import numpy as np
import pytest

from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.pose import Pose
from semviz_core.localization.localizer import Localizer
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.research.evaluation.problems import CAMERA

AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # looks along the map's x
TRUE = Pose(AXES, -AXES @ np.array([2.0, -1.0, 1.65]))


def simple_scene(seed: int = 0) -> tuple[Elements2D, Elements3D, Prior]:
    """One pole and one sign of each kind, 15 m ahead."""
    anchor = np.array([[18.0, 3.0, 4.0], [20.0, -5.0, 2.4], [16.0, 2.0, 2.1], [24.0, -1.0, 2.8]])
    end = np.full((4, 3), np.nan)
    end[0] = [18.0, 3.0, 0.0]
    submap = Elements3D.from_ends([11, 12, 13, 14], anchor, end, [0, 1, 2, 3])
    noise = np.random.default_rng(seed).normal(0.0, 0.5, (2, 4, 2))
    end_px = np.full((4, 2), np.nan)
    end_px[0] = CAMERA.project(TRUE.apply(end[:1]))[0]
    observed = Elements2D.from_ends(
        CAMERA.project(TRUE.apply(anchor)) + noise[0], end_px + noise[1], [0, 1, 2, 3]
    )
    return observed, submap, Prior(np.array([6.0, 2.0, 1.7]), up_camera=AXES[:, 2])


@pytest.mark.parametrize("seed", range(5))
def test_a_simple_scene_is_solved(seed: int) -> None:
    observed, submap, prior = simple_scene(seed)
    found = Localizer("direct").localize(observed, submap, CAMERA, prior)
    assert found.status == "ok", found.reason
    assert found.T_camera_map is not None
    assert found.refinement is not None
    assert pose_error(found.T_camera_map, TRUE)[0] < 0.4
    assert found.refinement.pairs.tolist() == [[0, 0], [1, 1], [2, 2], [3, 3]]


def test_two_of_a_class_cannot_be_told_apart() -> None:
    observed, submap, prior = simple_scene()
    twice = observed[[0, 0, 1, 2]]
    found = Localizer("direct").localize(twice, submap, CAMERA, prior)
    assert found.status == "cannot"
    assert found.T_camera_map is None
    assert found.reason.startswith("Classes do not fix the matches: 2 seen and 1 mapped")


def test_a_wrong_match_is_not_answered() -> None:
    observed, submap, prior = simple_scene()
    anchor = submap.anchor_m.copy()
    anchor[1:, 1] = [9.0, -14.0, 11.0]
    far = Elements3D.from_ends(submap.id, anchor, submap.end_m, submap.class_id)
    found = Localizer("direct").localize(observed, far, CAMERA, prior)
    assert found.status == "cannot", found.reason
