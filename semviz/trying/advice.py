"""What is worth trying first in a frame: the change that tells most about its verdict."""

from collections.abc import Iterator, Sequence

import numpy as np

from semviz.pose_errors import errors_of
from semviz.recording.run import FrameRecord, Run
from semviz.trying.again import again
from semviz.trying.asked import Asked
from semviz.trying.change import Change
from semviz.trying.map_changes import DropElement, ElementClass
from semviz.trying.pair_changes import ForceTruePairs
from semviz.trying.prior_changes import CropRadius, PriorAtTruth
from semviz.trying.seen_changes import DetectionClass, DropDetection
from semviz.trying.solver_changes import StartAtTruth
from semviz_core.errors import SemvizError
from semviz_core.explaining.told import Fault, Kind, Verdict

MOST = 12
"""More are not tried: an answer takes 2 to 30 ms."""
WIDER = 2.0
SEEN_WRONG: tuple[Kind, ...] = (
    "false detection", "false or not mapped", "missing in the map",
)  # fmt: skip
TOO_FEW: tuple[Kind, ...] = ("too few elements", "missed detection")
"""Nothing that is left out or moved helps."""
MAPPED_WRONG: tuple[Kind, ...] = ("moved in the map", "twice in the map")
NOT_FOUND: tuple[Kind, ...] = (
    "wrong matches", "search miss", "refinement diverged", "ambiguous geometry", "unexplained",
)  # fmt: skip


def most_telling(run: Run, record: FrameRecord, verdict: Verdict) -> Change | None:
    """Of what the verdict suggests, that which mends the frame best; None where it suggests none.

    With a truth, that is the smallest error; else the surest status. The fault's own suggestions
    come before those of what was noticed besides.
    """
    asked = Asked.of(run, record)
    noticed = () if verdict.kind in TOO_FEW else verdict.noticed
    faults = (verdict.fault, *(one for one in noticed if one is not verdict.fault))
    found = [one for fault in faults for one in _suggested(asked, fault) if one.concerns(asked)]
    different = list(dict.fromkeys(found))[:MOST]
    return min(different, key=lambda one: _badness(run, record, one), default=None)


def _suggested(asked: Asked, fault: Fault) -> Iterator[Change]:
    frame = asked.record.frame.index
    if fault.kind in MAPPED_WRONG:
        yield from map(DropElement, fault.elements)
    elif fault.kind in SEEN_WRONG:
        yield from (DropDetection(frame, row) for row in fault.rows)
    elif fault.kind == "wrong class":
        yield from _other_class(asked, fault.rows, fault.elements)
    elif fault.kind == "not in the submap":
        yield PriorAtTruth()
        yield CropRadius(WIDER * asked.radius_m)
    elif fault.kind in NOT_FOUND:
        yield ForceTruePairs()
        yield StartAtTruth()


def _other_class(asked: Asked, rows: Sequence[int], elements: Sequence[int]) -> Iterator[Change]:
    """The detection called as the element is, or the element as the detection."""
    for row, element in zip(rows, elements, strict=False):
        mapped = asked.semantic_map.elements
        for class_id in mapped.class_id[mapped.id == element].tolist():
            yield DetectionClass(asked.record.frame.index, row, class_id)
        yield ElementClass(element, int(asked.observed.class_id[row]))


def _badness(run: Run, record: FrameRecord, change: Change) -> tuple[float, float]:
    """Smaller is better; equal where centimetres are."""
    try:
        after = again(run, record, (change,))
    except SemvizError:
        return np.inf, np.inf
    errors = errors_of(after)
    status = ("ok", "ambiguous", "cannot").index(after.localization.status)
    if errors is None:
        return (np.inf if record.frame.T_map_camera is not None else 0.0), status
    return round(errors.distance_m, 2), status
