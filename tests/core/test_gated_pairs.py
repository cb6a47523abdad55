"""What association leaves out by angles alone would be no pair."""

import numpy as np
from problem_frames import frames

from semviz_core.localization.association import NEAR_COSINE, all_gains, pair_gain
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.residuals import EXACT_POSE, new_rows
from semviz_core.research.evaluation.problems import DETECTOR


def test_no_pair_is_left_out_by_its_angle() -> None:
    fitting = 0
    for frame in frames(6):
        problem = PoseProblem.of(frame.camera, frame.observed, frame.submap, DETECTOR)
        R, t = frame.T_camera_map.writable()
        gains = all_gains(problem, R, t)
        ahead = frame.submap.anchor_m @ R.T + t
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        near = problem.seen["anchor_ray"] @ ahead.T >= NEAR_COSINE
        for i, j in np.argwhere(near & problem.compatible):
            gain = pair_gain(problem, R, t, int(i), int(j), EXACT_POSE, new_rows())
            assert gain == gains[i, j] or gain < 0.0  # which no pair is made of
            fitting += gain > -np.inf
        assert (gains[~(near & problem.compatible)] == -np.inf).all()
    assert fitting > 20
