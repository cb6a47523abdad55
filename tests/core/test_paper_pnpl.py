"""The paper's PnPL: eq. 7 as written, its gradient, and its optimum."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semviz_core.base.classes import POLE, ROUNDED
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.pose import Pose
from semviz_core.common.errors import SemvizError
from semviz_core.localization.matched.matches import Matches
from semviz_core.localization.matched.p3p_ransac import Objective, paper_pnpl
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.research.evaluation.problems import CAMERA

TRUTH = Pose.from_rotvec([0.02, -0.03, 0.01], [0.4, -0.2, 1.0])


def exact_matches() -> Matches:
    """Four poles and three signs before a camera, each with itself and a neighbour."""
    rng = np.random.default_rng(1)
    anchor = rng.uniform([-8.0, -5.0, 10.0], [8.0, -1.0, 35.0], (7, 3))
    end = np.where(np.arange(7)[:, None] < 4, anchor + np.array([0.1, 4.0, 0.2]), np.nan)
    classes = [POLE] * 4 + [ROUNDED] * 3
    submap = Elements3D.from_ends(np.arange(7), anchor, end, classes)
    seen = [CAMERA.project(TRUTH.apply(point)) for point in (anchor, end)]
    observed = Elements2D.from_ends(seen[0], seen[1], classes)
    own = np.column_stack([np.arange(7), np.arange(7)])
    pairs = np.concatenate([own, [[0, 1], [2, 3], [4, 5], [6, 5]]])
    return Matches.checked(observed, submap, CAMERA, pairs, np.full(len(pairs), 0.5))


MATCHES = exact_matches()
DIRECT = np.array([1.0] * 7 + [0.0] * 4)


def test_cost_is_eq_7_term_by_term() -> None:
    P = np.linspace(0.1, 1.0, len(MATCHES))
    T = Pose.from_rotvec([0.1, 0.05, -0.02], [0.2, 0.1, 0.3])
    expected = 0.0
    for weight, (i, j) in zip(P, MATCHES.pairs, strict=True):
        first = CAMERA.bearing(MATCHES.observed.anchor_px)[i]
        p = MATCHES.submap.anchor_m[j]
        q = T.apply(p)
        expected += weight * (1.0 - first @ q / np.linalg.norm(q))
        if MATCHES.observed.is_line[i]:
            last = CAMERA.bearing(MATCHES.observed.end_px)[i]
            normal = np.cross(first, last) / np.linalg.norm(np.cross(first, last))
            v = MATCHES.submap.end_m[j] - p
            q = T.apply(p + v / np.linalg.norm(v))
            expected += weight * (1.0 - np.linalg.norm(np.cross(normal, q / np.linalg.norm(q))))

    cost, _ = Objective.of(MATCHES, P, np.zeros(3))(np.array([0.1, 0.05, -0.02, 0.2, 0.1, 0.3]))
    assert cost == pytest.approx(expected, rel=1e-9)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6))
def test_gradient_is_that_of_the_cost(numbers: list[float]) -> None:
    objective = Objective.of(MATCHES, np.linspace(0.1, 1.0, len(MATCHES)), np.zeros(3))
    x, step = np.array(numbers), 1e-6
    slopes = [
        (objective(x + step * axis)[0] - objective(x - step * axis)[0]) / (2.0 * step)
        for axis in np.eye(6)
    ]
    assert objective(x)[1] == pytest.approx(slopes, rel=1e-5, abs=1e-7)


def test_direct_pnpl_finds_the_exact_pose() -> None:
    start = Pose.exp([0.8, -0.5, 0.6, 0.05, -0.04, 0.03]) @ TRUTH
    found = paper_pnpl(MATCHES, DIRECT, start)
    assert pose_error(found.T_camera_map, TRUTH) == pytest.approx((0.0, 0.0), abs=1e-3)
    assert found.cost < 1e-9
    assert found.iterations > 1


def test_wrong_pairs_pull_the_pose_as_the_paper_s_sum_does() -> None:
    soft = paper_pnpl(MATCHES, np.where(DIRECT > 0.0, 0.7, 0.3), TRUTH)
    assert pose_error(soft.T_camera_map, TRUTH)[0] > 0.5


@pytest.mark.parametrize("P", [np.zeros(11), -DIRECT, np.full(11, np.nan), np.ones(3)])
def test_impossible_p_is_refused(P: np.ndarray) -> None:
    with pytest.raises(SemvizError, match="P h"):
        paper_pnpl(MATCHES, P, TRUTH)
