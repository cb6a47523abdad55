"""Direct PnPL: where classes alone say what is what (the paper's simple scene, eq. 8)."""

import numpy as np

from semviz_core.arrays import IntArray
from semviz_core.elements import Elements2D
from semviz_core.solving.refine import Failure
from semviz_core.solving.scene import Scene


def pairs_by_class(observed: Elements2D, scene: Scene) -> IntArray | Failure:
    """(k, 2) the pairs of elements that can be nothing else than each other.

    Fails where an element seen can be several mapped ones, or one mapped can be several seen: then
    the classes alone do not fix the matches. What is not mapped at all is left out.
    """
    pairs = []
    for i, possible in enumerate(scene.compatible):
        mapped = np.flatnonzero(possible)
        seen = np.flatnonzero(scene.compatible[:, mapped].any(axis=1))
        if len(seen) > 1 or len(mapped) > 1:
            return Failure(
                f"Classes do not fix the matches: {len(seen)} seen and {len(mapped)} mapped "
                f"of class {observed.class_id[i]}; at most one each is needed. Use method search."
            )
        if len(mapped):
            pairs.append((i, int(mapped[0])))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)
