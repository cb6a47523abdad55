"""What an image of a simulated street shows, as a detector is judged by it."""

import numpy as np
from numpy.typing import NDArray

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.elements import Elements2D, joined
from semviz_core.evaluation.detection import REACH_M, Truth
from semviz_core.sources.source import Side
from semviz_core.sources.street.street import Street


def street_truth(street: Street, index: int, side: Side, reach_m: float = REACH_M) -> Truth:
    """What a careful person would label, and, as what does not count, all else that shows at
    least a pixel: what is far off, all but hidden, or hidden in the middle."""
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
    return Truth.of(
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
    """What can be seen of elements (k,) that nobody would label: in the middle of its pixels."""
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
