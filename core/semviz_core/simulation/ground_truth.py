"""Ground truth of a rendered image: elements for evaluation, regions for training.

Evaluation uses the labels of a careful annotator. Elements with at least one visible pixel that
are far off, almost hidden, or hidden at their centre are ignored. Training regions are those of a
perfect model.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semviz_core.base.elements import Elements2D, joined
from semviz_core.base.frame import Side
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.detection.regions import Region
from semviz_core.metrics.detection import REACH_M, ImageGroundTruth
from semviz_core.simulation.street import Street


def street_truth(
    street: Street, index: int, side: Side, reach_m: float = REACH_M
) -> ImageGroundTruth:
    """Return the labels of a careful annotator, with all other visible elements as ignored.

    Ignored elements show at least a pixel, but are far off, almost hidden, or hidden at the centre.
    """
    labelled, ids = street.labels(index, side)
    order, ranks = street.painted(index, side)
    seen = np.unique(order)
    others = np.array(
        [id for id, rank in ranks.items() if rank in seen and id not in ids], dtype=np.int64
    )
    boxes = {id: _box(order == ranks[id]) for id in (*ids.tolist(), *others.tolist())}
    elements = joined(labelled, _remainders(street, others, boxes))
    all_ids = np.concatenate([ids, others])
    sizes = [boxes[id][1] for id in all_ids.tolist()]
    return ImageGroundTruth.of(
        elements,
        distance_m=street.distance_m(all_ids, index, side),
        size_px=np.array([size.min() for size in sizes], dtype=np.float64),
        ignored=np.arange(len(elements)) >= len(labelled),
        reach_m=reach_m,
    )


_Box = tuple[FloatArray, FloatArray]
"""Middle (2,) and size (2,) in pixels."""


def _box(mask: BoolArray) -> _Box:
    rows, columns = np.nonzero(mask)
    low = np.array([columns.min(), rows.min()], dtype=np.float64)
    high = np.array([columns.max(), rows.max()], dtype=np.float64)
    return (low + high) / 2.0, high - low + 1.0


def _remainders(street: Street, ids: IntArray, boxes: dict[int, _Box]) -> Elements2D:
    """Return elements (k,) that would not be labelled, at the centre of their visible pixels."""
    mapped = street.truth_map.elements
    rows = mapped[np.searchsorted(mapped.id, ids)]
    middle = np.array([boxes[id][0] for id in ids.tolist()]).reshape(-1, 2)
    half = np.array([boxes[id][1] for id in ids.tolist()]).reshape(-1, 2)[:, 1:] / 2.0
    reach = np.concatenate([np.zeros_like(half), half], axis=1)
    is_line = rows.is_line[:, None]
    known: NDArray[np.bool_] = np.zeros(len(ids), dtype=bool)
    return Elements2D(
        anchor_px=np.where(is_line, middle - reach, middle),
        end_px=np.where(is_line, middle + reach, np.nan),
        class_id=rows.class_id,
        score=np.ones(len(ids)),
        sigma_px=np.ones((len(ids), 2)),
        anchor_known=known | ~rows.is_line,
        end_known=known,
    )


class RenderedTruth(NamedTuple):
    """The elements and regions of a rendered image."""

    elements: Elements2D
    """(m,) exact labels of a careful annotator."""
    element_id: IntArray
    """(m,) in the street's ``truth_map``."""
    regions: tuple[Region, ...]
    """(m,) of score 1, with masks of the visible pixels."""


def rendered_truth(street: Street, index: int, side: Side) -> RenderedTruth:
    """Return the ground truth of one image of a street."""
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
