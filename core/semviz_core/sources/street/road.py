"""The road: a smooth centreline on an inclined plane, and its cross-section."""

from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import FloatArray

LANE_M = 3.4
PARKING_M = 2.1
KERB_M = LANE_M + PARKING_M
"""From the centreline to the kerb."""
KERB_HEIGHT_M = 0.12
PAVEMENT_M = KERB_M + 2.6
"""From the centreline to the pavement's far edge."""

_STEP_M = 0.5


@dataclass(frozen=True, eq=False)
class Road:
    """A centreline, known from ``s_m[0]`` to ``s_m[-1]``.

    A place on the street is (s, d, h): metres along the centreline, to the left of it, and above
    the road's plane.
    """

    s_m: FloatArray
    """(k,) increasing."""
    xy_m: FloatArray
    """(k, 2)"""
    heading_rad: FloatArray
    """(k,) continuous."""
    slope: FloatArray
    """(2,) rise of the ground along x and y."""

    def heading(self, s_m: float | FloatArray) -> FloatArray:
        """(n,) direction of the road, from x towards y."""
        return np.asarray(np.interp(s_m, self.s_m, self.heading_rad))

    def forward(self, s_m: float) -> FloatArray:
        """(3,) horizontal unit vector along the road."""
        heading = float(self.heading(s_m))
        return np.array([np.cos(heading), np.sin(heading), 0.0])

    def left(self, s_m: float) -> FloatArray:
        """(3,) horizontal unit vector to the left of the road."""
        x, y, _ = self.forward(s_m)
        return np.array([-y, x, 0.0])

    def at(
        self, s_m: float | FloatArray, d_m: float | FloatArray, h_m: float | FloatArray = 0.0
    ) -> FloatArray:
        """Places in the map frame: (n, 3), or (3,) for a single place."""
        s, d, h = np.broadcast_arrays(*(np.asarray(one, dtype=float) for one in (s_m, d_m, h_m)))
        heading = self.heading(s)
        x = np.interp(s, self.s_m, self.xy_m[:, 0]) - np.sin(heading) * d
        y = np.interp(s, self.s_m, self.xy_m[:, 1]) + np.cos(heading) * d
        return np.stack([x, y, self.slope[0] * x + self.slope[1] * y + h], axis=-1)

    def ground(self, points_m: FloatArray) -> FloatArray:
        """Points (..., 3) moved vertically to pavement height."""
        height = points_m[..., :2] @ self.slope + KERB_HEIGHT_M
        return np.concatenate([points_m[..., :2], height[..., None]], axis=-1)


def make_road(
    rng: np.random.Generator, begin_m: float, end_m: float, straight: list[tuple[float, float]]
) -> Road:
    """A winding road that is straight within the given (begin, end) stretches."""
    s = np.arange(begin_m, end_m + _STEP_M, _STEP_M)
    curvature = np.zeros_like(s)
    for wavelength in (75.0, 120.0, 190.0):
        phase = rng.uniform(0.0, 2.0 * np.pi)
        curvature += rng.uniform(0.5, 1.0) / 350.0 * np.sin(2.0 * np.pi * s / wavelength + phase)
    for begin, end in straight:
        outside = np.maximum(begin - s, s - end)
        curvature *= np.clip(outside / 15.0, 0.0, 1.0)
    heading = rng.uniform(-np.pi, np.pi) + np.cumsum(curvature) * _STEP_M
    steps = np.stack([np.cos(heading), np.sin(heading)], axis=1) * _STEP_M
    xy = np.cumsum(steps, axis=0)
    direction = rng.uniform(0.0, 2.0 * np.pi)
    slope = rng.uniform(0.0, 0.02) * np.array([np.cos(direction), np.sin(direction)])
    return Road(s, xy - xy[np.searchsorted(s, 0.0)], heading, slope)
