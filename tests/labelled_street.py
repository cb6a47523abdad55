"""A simulated street with labels of what its images show, off by noise."""

from collections import defaultdict
from collections.abc import Iterable

import numpy as np

from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.edits import AddElements, NewElement
from semviz_annotation.labels.labels import Labels, Observation, new_id
from semviz_core.base.frame import Side
from semviz_core.simulation.street import Street

SIDES: tuple[Side, Side] = ("left", "right")
LEAST_VIEWS = 4


def label_street(
    workspace: Workspace,
    street: Street,
    frames: Iterable[int],
    author: str = "mara",
    sigma_px: float = 0.4,
) -> Labels:
    """Label what the images of some frames show, as tracks that ``author`` accepted."""
    rng = np.random.default_rng(1)
    found: dict[int, list[Observation]] = defaultdict(list)
    classes: dict[int, int] = {}
    for frame in frames:
        for side in SIDES:
            seen, ids = street.labels(frame, side)
            for row, number in enumerate(ids.tolist()):
                is_line = bool(seen.is_line[row])
                anchor = seen.anchor_px[row] + rng.normal(0.0, sigma_px, 2)
                end = seen.end_px[row] + rng.normal(0.0, sigma_px, 2) if is_line else None
                ends = np.array([anchor] if end is None else [anchor, end])
                if not street.rig.left.contains(ends).all():
                    continue
                classes[number] = int(seen.class_id[row])
                known = bool(seen.anchor_known[row]), is_line and bool(seen.end_known[row])
                points = [(float(u), float(v)) for u, v in ends]
                found[number].append(
                    Observation(
                        new_id(), "", frame, side, points[0], points[1] if is_line else None, *known
                    )
                )
    elements = tuple(
        NewElement(new_id(), classes[number], tuple(rows))
        for number, rows in sorted(found.items())
        if len(rows) >= LEAST_VIEWS
    )
    with workspace.open_labels() as store:
        store.apply(AddElements(elements), author)
        return store.labels
