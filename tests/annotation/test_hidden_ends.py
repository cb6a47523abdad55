"""Where the ground is, and whether the bottom of a pole is seen."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from semviz.annotator.drawing.hidden_ends import GroundModel
from semviz_core.common.arrays import FloatArray

DRIVE: FloatArray = np.array([[x, 0.0, 101.65] for x in range(8)], dtype=np.float64)
NOTHING: FloatArray = np.zeros((0, 3))


def standing(*heights: float) -> FloatArray:
    return np.array([[10.0 + 5.0 * k, 4.0, height] for k, height in enumerate(heights)])


def test_without_any_bottom_the_drive_tells_roughly() -> None:
    ground = GroundModel(DRIVE, NOTHING)
    height, sigma = ground.height_m(np.array([10.0, 3.0, 101.0]))
    assert abs(height - 100.0) < 0.01
    assert sigma > 0.25
    assert ground.is_below(np.array([10.0, 3.0, 101.2]), 0.02)
    assert not ground.is_below(np.array([10.0, 3.0, 100.5]), 0.02)


@given(st.floats(-0.6, 0.6))
def test_bottoms_tell_better_whatever_the_height_of_the_camera(off: float) -> None:
    ground = GroundModel(DRIVE, standing(100.0 + off, 100.05 + off, 99.95 + off))
    above = np.array([14.0, -4.0, 100.0 + off])
    assert not ground.is_below(above, 0.02)
    assert ground.is_below(np.array([14.0, -4.0, 100.6 + off]), 0.02)


def test_one_bottom_that_is_none_does_not_move_the_ground() -> None:
    ground = GroundModel(DRIVE, standing(100.0, 101.1, 100.0, 100.0))
    assert abs(ground.height_m(np.array([14.0, 4.0, 100.0]))[0] - 100.0) < 0.05


def test_what_is_not_known_well_is_not_hidden() -> None:
    ground = GroundModel(DRIVE, standing(100.0, 100.0, 100.0))
    bottom = np.array([14.0, 4.0, 100.7])
    assert ground.is_below(bottom, 0.02)
    assert not ground.is_below(bottom, 0.4)
