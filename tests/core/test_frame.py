"""The prior is checked where it enters."""

from typing import Any

import numpy as np
import pytest

from semviz_core.base.frame import Prior
from semviz_core.common.errors import SemvizError

GOOD: dict[str, Any] = {"position_m": [1.0, 2.0, 3.0]}


def test_only_the_position_is_needed() -> None:
    prior = Prior(**GOOD)
    assert prior.position_m.dtype == np.float64
    assert prior.up_camera is None
    assert prior.heading_rad is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"position_m": [1.0, 2.0]}, "position_m has shape"),
        ({"position_m": [1.0, np.nan, 2.0]}, "position_m holds NaN"),
        ({"horizontal_sigma_m": 0.0}, "horizontal_sigma_m is "),
        ({"vertical_sigma_m": -1.0}, "vertical_sigma_m is "),
        ({"up_sigma_rad": float("nan")}, "up_sigma_rad holds NaN"),
        ({"heading_sigma_rad": 0.0}, "heading_sigma_rad is "),
        ({"heading_rad": float("nan")}, "heading_rad holds NaN"),
        ({"up_camera": [0.0, -2.0, 0.0]}, "up_camera must have length 1"),
        ({"up_camera": [0.0, -1.0]}, "up_camera has shape"),
    ],
)
def test_wrong_priors_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SemvizError, match=message):
        Prior(**(GOOD | changes))
