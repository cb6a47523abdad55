"""How far an answer hangs on each of its pairs: what the others say without it.

As in surveying (Baarda 1968): a wrong pair is found out only where the others contradict it. Where
they leave the place open, or allow much else than the pair, it can be wrong unnoticed.
"""

import numpy as np

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.compiled import compiled
from semviz_core.solving.association import pair_gain
from semviz_core.solving.least_squares import fit
from semviz_core.solving.linear import inverse
from semviz_core.solving.residuals import new_rows
from semviz_core.solving.scene import Known, Scene

ITERATIONS = 8


@compiled
def support_of_pairs(
    scene: Scene, known: Known, R: FloatArray, t: FloatArray, match: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Of each observed element: ``support`` (m,), the nats by which its pair is likelier than a
    false detection under the pose of all other pairs, as sure as that is (-inf beyond the gate);
    ``open_m`` (m,), how far the camera's place moves or is uncertain without it. NaN without a
    pair.
    """
    support, open_m = np.full(len(match), np.nan), np.full(len(match), np.nan)
    rows = new_rows()
    for i in range(len(match)):
        if match[i] < 0:
            continue
        without = match.copy()
        without[i] = -1
        free_R, free_t, information, _ = fit(scene, known, R, t, without, ITERATIONS)
        doubt = inverse(information)
        if not np.trace(doubt) > 0.0:  # the others fix no pose at all
            support[i], open_m[i] = -np.inf, np.inf
            continue
        support[i] = pair_gain(scene, free_R, free_t, i, match[i], doubt, rows)
        shift = free_R.T @ free_t - R.T @ t
        spread = doubt[0, 0] + doubt[1, 1] + doubt[2, 2]
        open_m[i] = np.sqrt(max((shift**2).sum(), spread))
    return support, open_m
