"""What a perfect model would find in images of a simulated street: to learn from, to test by."""

from typing import NamedTuple

import numpy as np

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.detection.region import Region
from semviz_core.elements import Elements2D
from semviz_core.sources.source import Side
from semviz_core.sources.street.street import Street


class RenderedTruth(NamedTuple):
    """What an image of a street shows."""

    elements: Elements2D
    """(m,) as a careful person would label them; exact."""
    element_id: IntArray
    """(m,) in the street's ``truth_map``."""
    regions: tuple[Region, ...]
    """(m,) score 1, with masks of the pixels that can be seen."""


def rendered_truth(street: Street, index: int, side: Side) -> RenderedTruth:
    """Of one image of a street."""
    elements, element_id = street.labels(index, side)
    order, ranks = street.painted(index, side)
    regions: list[Region] = []
    for row in range(len(elements)):
        shown = order == ranks[int(element_id[row])]
        rows, columns = np.nonzero(shown)
        top, left = int(rows.min()), int(columns.min())
        regions.append(
            Region(
                class_id=int(elements.class_id[row]),
                score=1.0,
                box_px=np.array([left, top, columns.max(), rows.max()], dtype=np.float64),
                mask=shown[top : rows.max() + 1, left : columns.max() + 1],
                corner_px=(left, top),
                ends_px=_ends(elements, row),
                ends_known=(bool(elements.anchor_known[row]), bool(elements.end_known[row])),
            )
        )
    return RenderedTruth(elements, element_id, tuple(regions))


def _ends(elements: Elements2D, row: int) -> FloatArray | None:
    if not elements.is_line[row]:
        return None
    return np.stack([elements.anchor_px[row], elements.end_px[row]])
