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
    "line by mask": (-0.4004, 0.3345, 1.3398, -0.5),
    "line by box": (-1.6308, 0.1153, 0.4057),
    "line by edges": (
        1.2066,
        -1.7611,
        0.5522,
        1.7012,
        0.2056,
        -1.433,
        -0.2308,
        0.2629,
        -0.0601,
        -0.0198,
        -0.4213,
        -0.0654,
    ),
    "end by model": (0.0405, 0.3148, 0.067, -0.0372),
    "end by mask": (2.5992, -0.4176, -0.1665, 0.0717),
    "end by box": (3.285, -0.4306, 0.2107, -0.2986),
    "end by edges": (-0.6281, 0.6772, 0.8855, 0.4507, 0.6842, 0.5652),
    "end at sign": (2.0604, -0.4864, 0.0822),
    "middle by box": (0.3289, -0.1858, 0.8818, 0),
    "middle by mask": (-3.8468, 0.878, 1.3428, 2.5003),
    "middle by outline": (
        -2.4136,
        1.512,
        -1.4391,
        0.4908,
        0.1341,
        -0.1083,
        -0.0676,
        0.0651,
        0.0886,
        0.5082,
        0.8008,
    ),
}

KNOWN = (3.2615, 2.3067, 0.4713, 0.4877, -1.1301, -2.1752, -0.5634)
"""Of an end being the pole's own: a logistic function of what ``ends.end_evidence`` gives."""
SHAPE = np.array((-0.8429, 1.1302, -0.2874, -2.7176, 3.506, 1.9934, -3.8794))
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
