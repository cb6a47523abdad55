"""The verdict on each frame of a run: what the run knows of a frame, handed to explaining."""

from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from semviz import follow
from semviz.observing import detector_model, observations_of
from semviz.recording.run import FrameRecord, Run
from semviz_core.detector_model import DetectorModel
from semviz_core.explaining.case import Case, is_healthy
from semviz_core.explaining.explain import explain
from semviz_core.explaining.told import FALSE, UNKNOWN, Truth, Verdict

STARTING_OR_LOST = "starting or lost"
"""Of a followed frame without an answer."""


def verdict(run: Run, record: FrameRecord) -> str:
    """A name for what happened; neighbouring frames of one name are one row in lists."""
    truth = truth_of(run, record)
    if record.localization.method == follow.METHOD and record.localization.status == "cannot":
        return STARTING_OR_LOST
    if is_healthy(record.localization, None if truth is None else truth.T_camera_map):
        return "healthy"
    return explained(run, record).kind


_EXPLAINED: WeakKeyDictionary[FrameRecord, Verdict] = WeakKeyDictionary()


def explained(run: Run, record: FrameRecord) -> Verdict:
    """The verdict on one frame, with all that the run knows of it."""
    if record not in _EXPLAINED:
        _EXPLAINED[record] = explain(
            record.localization, run.semantic_map, truth_of(run, record), detector_of(run)
        )
    return _EXPLAINED[record]


def blamed_elements(run: Run, record: FrameRecord) -> tuple[int, ...]:
    """Ids of the map elements that the verdict on a frame is about; none where it is healthy."""
    told = explained(run, record)
    if verdict(run, record) != told.kind:
        return ()
    mapped = set(run.semantic_map.elements.id.tolist())
    return tuple(one for one in told.fault.elements if one in mapped)  # some are missing there


class Failed(NamedTuple):
    """Where detection failed in a frame."""

    missed: tuple[int, ...]
    """Ids of map elements in view that were not detected; what hides some, the map cannot know."""
    false: tuple[int, ...]
    """Observed rows that are nothing real."""


def detection_failed(run: Run, record: FrameRecord) -> Failed:
    """Of what a detector saw, real or simulated; people's labels fail otherwise.

    Nothing is missed where no true pose and no sure answer say what is in view.
    """
    if run.info.observations in ("", "labels"):
        return Failed((), ())
    truth, one = truth_of(run, record), record.localization
    false = tuple(np.flatnonzero(record.element_id == FALSE).tolist())
    if truth is None and one.status != "ok":
        return Failed((), false)
    case = Case.of(one, run.semantic_map, truth, detector_of(run))
    return Failed(tuple(case.nearby.id[case.missed].tolist()), false)


def detector_of(run: Run) -> DetectorModel:
    """What is true of whoever, or whatever, saw what was observed."""
    return detector_model(observations_of(run.info.observations))


def truth_of(run: Run, record: FrameRecord) -> Truth | None:
    """What is known of a frame. Labels without an element in the map may be of anything."""
    pose, ids = record.frame.T_map_camera, record.element_id
    if pose is None:
        return None
    if run.info.observations == "labels":
        ids = np.where(ids < 0, UNKNOWN, ids)
    return Truth(pose.inverse(), ids if (ids >= 0).any() else None)
