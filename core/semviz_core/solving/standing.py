"""Mapped elements as the search compares them: where they stand, how high, and what may be them."""

import numpy as np

from semviz_core.arrays import IntArray
from semviz_core.compiled import compiled
from semviz_core.solving.scene import Record, RecordArray, Scene

STANDING = np.dtype(
    [
        ("place_m", float, (2,)),
        ("height_m", float, (2,)),  # of anchor and end
        ("known", np.uint8, (2,)),
        ("first", np.int64),  # compatible observed rows: partner[first:last]
        ("last", np.int64),
    ],
    align=True,
)
"""A mapped element; small records lie close together in memory."""
HIDDEN_CHI2 = 9.0
"""A bottom that is seen further above the mapped one, by more of its variance, is hidden."""


@compiled
def standing_elements(scene: Scene) -> tuple[RecordArray, IntArray]:
    """(n,) STANDING, and the observed rows they refer to."""
    standing = np.zeros(len(scene.mapped), STANDING)
    partner = np.empty(len(scene.candidate), dtype=np.int64)
    count = 0
    for j in range(len(standing)):
        a, e = scene.mapped[j].anchor_m, scene.mapped[j].end_m
        standing[j].place_m[0], standing[j].place_m[1] = 0.5 * (a[0] + e[0]), 0.5 * (a[1] + e[1])
        standing[j].height_m[0], standing[j].height_m[1] = a[2], e[2]
        standing[j].known[:] = scene.mapped[j].known
        standing[j].first = count
        for i in range(len(scene.seen)):
            if scene.compatible[i, j]:
                partner[count] = i
                count += 1
        standing[j].last = count
    return standing, partner


@compiled
def compare_slopes(
    setting: Record,
    seen: Record,
    mapped: Record,
    near: float,
    camera_height_m: float,
    up_sigma_rad: float,
    position_m: float,
    height_m: float,
    tilt_rad: float,
) -> tuple[float, float, float, int]:
    """How well the slopes of an observed element (SIGHT) fit a mapped one 1 / ``near`` metres away.

    ``position_m`` and ``height_m`` are sigmas of the camera's place, ``up_sigma_rad`` of its up;
    it looks up by ``tilt_rad`` more than the level frame says. Returns chi2, the product of the
    variances behind it, nats for bottoms that are or are not hidden, and the number of slopes.
    """
    chi2, variance, nats, count = 0.0, 1.0, 0.0, 0
    own = seen.slope_sigma**2 + up_sigma_rad**2
    for end in range(2):
        if not (seen.known[end] and mapped.known[end]):
            continue
        slope = tilted_slope(seen, end, tilt_rad)
        off = (mapped.height_m[end] - camera_height_m) * near - slope
        spread = own + (height_m**2 + (position_m * slope) ** 2) * near * near
        if end == 1 and setting.hidden_bottoms > 0.0:
            if off < 0.0 and off * off > HIDDEN_CHI2 * spread:
                nats += setting.log_hidden
                continue
            nats += setting.log_visible
        chi2 += off * off / spread
        variance *= spread
        count += 1
    return chi2, variance, nats, count


@compiled
def tilted_slope(seen: Record, end: int, tilt_rad: float) -> float:
    """The slope of an end if the camera looks up by ``tilt_rad`` more; to first order."""
    slope = seen.slope[end]
    return slope + tilt_rad * seen.azimuth[0] * (1.0 + slope * slope)
