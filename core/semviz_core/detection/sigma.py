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
    "line by ends": (0.2844, -0.0253, 0.0294),
    "line by mask": (-0.4274, 0.3331, 1.2956, -0.4972),
    "line by box": (-1.6308, 0.1153, 0.4057),
    "line by edges": (
        0.985,
        -1.9555,
        0.5767,
        1.9608,
        0.2107,
        -1.2307,
        -0.23,
        0.2627,
        -0.0508,
        0.0323,
        -0.4528,
        -0.0838,
    ),
    "end by model": (0.0426, 0.3147, 0.0682, -0.0367),
    "end by mask": (2.5877, -0.413, -0.1595, 0.0707),
    "end by box": (3.2862, -0.4269, 0.2218, -0.2974),
    "end by edges": (-0.5834, 0.6984, 0.8564, 0.4636, 0.7088, 0.5761),
    "end at sign": (2.645, -0.7119, 0.2304),
    "middle by box": (0.3289, -0.1858, 0.8818, 0),
    "middle by mask": (-3.8468, 0.878, 1.3428, 2.5003),
    "middle by outline": (
        -2.6874,
        3.2289,
        -2.4767,
        0.4087,
        0.1354,
        -0.137,
        -0.0782,
        0.7474,
        -0.5673,
        0.4965,
        0.7674,
    ),
}

KNOWN = (3.523, 0.1935, 0.58, -0.8288, -2.966)
"""Of an end being the pole's own: a logistic function of what ``ends.end_evidence`` gives."""
SHAPE = np.array((-1.2325, 1.1285, 0.104, -2.901, 4.3654, 4.0635, -3.2827))
"""Of a sign's class, by ``middle.shape_evidence``."""
PAPER = (1.62, 3.62)
"""Sigmas in px, across and along, of the paper's measuring: what it is off by on the whole."""


def sigma_px(kind: str, evidence: FloatArray) -> float:
    """Of one coordinate of a ``kind`` of measurement; the first weight is the constant."""
    weights = WEIGHTS[kind]
    exponent = weights[0] + sum(map(mul, weights[1:], evidence.tolist()))
    return min(max(math.exp(min(exponent, 10.0)), _LEAST_PX), _MOST_PX)


def known(evidence: FloatArray) -> bool:
    """Whether an end is likelier than not the pole's own."""
    return bool(KNOWN[0] + np.dot(KNOWN[1:], evidence) > 0.0)
