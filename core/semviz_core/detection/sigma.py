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
    "line by ends": (-0.1109, -0.0696, 0.3786),
    "line by mask": (1.0091, -0.1197, 1.6611, -0.0911),
    "line by box": (-1.7229, -0.0206, 0.4456),
    "line by edges": (
        0.4826,
        -1.0948,
        0.7555,
        0.8464,
        0.4171,
        -0.8344,
        -0.1262,
        0.5127,
        0.2309,
        0.0738,
        -0.4923,
        -0.3118,
    ),
    "end by model": (-0.3216, 0.4723, 0.3143, -0.1503),
    "end by mask": (1.7402, 0.0401, 0.5069, -0.1553),
    "end by box": (0.6107, -0.1042, -0.4913, 0.11),
    "end by rows": (0.1737, -0.2075, 0.8196, 0.8653, 0.166, 0.1069, -0.2355),
    "end by edges": (2.2413, -0.2798, 0.7658, 0.5277, -0.3384, 0.4224, 0.4052, 0.1667),
    "end at sign": (2.6734, -0.8495, 0.3372, 0.4302),
    "middle by box": (0.6093, -0.2213, 0.3221, 0),
    "middle by mask": (-2.9763, 0.7614, 0.9497, 3.0552),
    "middle by outline": (
        -3.4662,
        3.768,
        -3.1183,
        0.6287,
        -0.0105,
        0.0073,
        -0.0849,
        -0.2683,
        0.6684,
        0.2526,
        0.5581,
    ),
}

CHOSEN = {"across": (0.6232, 1.3036), "along": (0.621, 0.9382), "middle": (0.9229, 1.5179)}
"""Of the least sigma among several, which is often the least by luck: constant and factor of what
its logarithm becomes. Fitted last, by ``python bench/measure_chosen.py``."""
KNOWN = (3.4748, 1.3858, 1.2949, -1.8758, -3.6015)
"""Of an end being the pole's own: a logistic function of what ``ends.end_evidence`` gives."""
SHAPE = np.array((-0.1859, 0.7102, -0.5243, -3.4111, 4.0103, 3.3384, -0.9434))
"""Of a sign's class, by ``middle.shape_evidence``."""
PAPER = (1.38, 4.11)
"""Sigmas in px, across and along, of the paper's measuring: what it is off by on the whole."""


def sigma_px(kind: str, evidence: FloatArray) -> float:
    """Of one coordinate of a ``kind`` of measurement; the first weight is the constant."""
    weights = WEIGHTS[kind]
    exponent = weights[0] + sum(map(mul, weights[1:], evidence.tolist()))
    return min(max(math.exp(min(exponent, 10.0)), _LEAST_PX), _MOST_PX)


def chosen_sigma_px(what: str, least_px: float) -> float:
    """Of a candidate that was chosen because its predicted sigma is the least."""
    constant, factor = CHOSEN[what]
    return min(max(math.exp(constant + factor * math.log(least_px)), _LEAST_PX), _MOST_PX)


def known(evidence: FloatArray) -> bool:
    """Whether an end is likelier than not the pole's own."""
    return bool(KNOWN[0] + np.dot(KNOWN[1:], evidence) > 0.0)
