"""Direct PnPL: where classes alone say what is what (the paper's simple scene, eq. 8)."""

import numpy as np

from semviz_core.arrays import IntArray
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.solving.refine import Failure


def pairs_by_class(observed: Elements2D, submap: Elements3D) -> IntArray | Failure:
    """(k, 2) the pairs of classes that occur once in the image and once in the submap.

    Fails where an observed class is mapped more than once or seen more than once: then the
    classes alone do not fix the matches.
    """
    pairs = []
    for class_id in np.unique(observed.class_id):
        seen = np.flatnonzero(observed.class_id == class_id)
        mapped = np.flatnonzero(submap.class_id == class_id)
        if len(seen) > 1 or len(mapped) > 1:
            return Failure(
                f"Classes do not fix the matches: {len(seen)} seen and {len(mapped)} mapped "
                f"of class {class_id}; at most one each is needed. Use method search."
            )
        if len(mapped):
            pairs.append((int(seen[0]), int(mapped[0])))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)
