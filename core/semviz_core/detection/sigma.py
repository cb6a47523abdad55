"""How far off what was measured is: a sigma predicted from evidence.

Its logarithm is linear in the evidence: the weights are those under which the errors on simulated
streets are likeliest (Gaussian). ``python bench/measure.py --fit`` made them on the streets with
seeds from 20_000; ``python bench/measure.py`` shows on others how honest they are.
"""

import math
from operator import mul

import numpy as np

from semviz_core.arrays import FloatArray

_LEAST_PX, _MOST_PX = 0.1, 20.0

WEIGHTS: dict[str, tuple[float, ...]] = {
    "line by ends": (-0.5879, 0.1347, -0.0218),
    "line by mask": (-0.0231, 0.2286, 1.3968, -0.3785),
    "line by box": (-1.8272, 0.0652, 0.4825),
    "line by edges": (
        -0.0097,
        -2.0475,
        1.0065,
        2.018,
        0.3096,
        -1.1548,
        -0.2141,
        0.2446,
        -0.0012,
        -0.0288,
        -0.3421,
        -0.165,
    ),
    "end by model": (-0.4965, 0.4274, -0.0339, -0.1062),
    "end by mask": (0.9126, 0.1494, 0.1965, 0.0032),
    "end by box": (2.9337, -0.4264, -0.0017, -0.2421),
    "end by rows": (2.0159, -0.1604, 0.5623, -0.0121, 0.2076, 0.763, -0.5946),
    "end by edges": (1.7957, -0.2751, 0.5542, 0.2017, 0.2801, 0.4383, 0.6177, 0.1182),
    "end at sign": (0.9865, -0.4037, 0.3323, 0.5758),
    "middle by box": (0.3274, -0.1659, 0.9445, 0),
    "middle by mask": (-2.3292, 0.6674, -0.4416, 1.8013),
    "middle by outline": (
        -3.4807,
        1.2667,
        -1.4563,
        0.7136,
        0.1503,
        0.0422,
        -0.0705,
        -0.581,
        0.4896,
        0.1274,
        0.4234,
    ),
}

KNOWN = (3.9834, 0.3478, 0.766, -1.1088, -3.619)
"""Of an end being the pole's own: a logistic function of what ``ends.end_evidence`` gives."""
SHAPE = np.array((-0.5517, 1.0032, -0.4515, -4.3408, 2.4783, 2.5478, -1.5764))
"""Of a sign's class, by ``middle.shape_evidence``."""
PAPER = (1.52, 4.51)
"""Sigmas in px, across and along, of the paper's measuring: what it is off by on the whole."""


def sigma_px(kind: str, evidence: FloatArray) -> float:
    """Of one coordinate of a ``kind`` of measurement; the first weight is the constant."""
    weights = WEIGHTS[kind]
    exponent = weights[0] + sum(map(mul, weights[1:], evidence.tolist()))
    return min(max(math.exp(min(exponent, 10.0)), _LEAST_PX), _MOST_PX)


def known(evidence: FloatArray) -> bool:
    """Whether an end is likelier than not the pole's own."""
    return bool(KNOWN[0] + np.dot(KNOWN[1:], evidence) > 0.0)
