"""Runs as passes through one map: their frames, dates, and which of them count."""

from collections.abc import Iterable
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np

from semviz.runs.run import Run, assumed_detector
from semviz_annotation.mapping.passes.evidence import Pass
from semviz_core.base.localization import Localization
from semviz_core.base.semantic_map import MapFrame
from semviz_core.common.errors import SemvizError

_FIRST_DATE_S = 3e8
"""Time stamps from here on (1979) are seconds since 1970; smaller ones are since a start."""


def pass_of(name: str, run: Run, frame: MapFrame) -> Pass:
    """Return a run as a pass, with what it needs of each frame, which is read once.

    Raise SemvizError if the run is not in the frame of the map.
    """
    if run.semantic_map.frame.name != frame.name:
        raise SemvizError(
            f"{name}: is in the frame {run.semantic_map.frame.name}, the map in {frame.name}; "
            "leave it out, or localize it in this map"
        )
    read = [(record.frame, _result(record.localization)) for record in run.frames]
    frames, results = tuple(frame for frame, _ in read), tuple(result for _, result in read)
    start_s = frames[0].time_s if frames else None
    is_date = start_s is not None and start_s > _FIRST_DATE_S
    return Pass(name, frames, results, assumed_detector(run.info), start_s if is_date else None)


def _result(localization: Localization) -> Localization:
    """Return what was detected and where from, without how it was found."""
    return replace(
        localization,
        prior=None,
        submap=localization.submap[:0],
        match=None,
        search=None,
        refinement=None,
        alternatives=(),
    )


def in_time(passes: Iterable[Pass]) -> list[Pass]:
    """Return passes oldest first, if all have a date; otherwise as they are."""
    kept = list(passes)
    if any(one.start_s is None for one in kept):
        return kept
    return sorted(kept, key=lambda one: one.start_s or 0.0)


def check_drive(one: Pass, known: dict[bytes, str]) -> None:
    """Add a pass to those ``known`` by their detections.

    Raise SemvizError if another pass has the same ones: one drive, localized twice.
    """
    other = known.setdefault(_detections(one), one.name)
    if other != one.name:
        raise SemvizError(
            f"{one.name}: has the detections of {other}, so it is no other drive; leave it out"
        )


def date_of(one: Pass) -> str:
    """Return the date of a pass, ``2026-05-12``; empty if it is not known."""
    return "" if one.start_s is None else f"{datetime.fromtimestamp(one.start_s, UTC):%Y-%m-%d}"


def _detections(one: Pass) -> bytes:
    """Return the detections of a pass, to compare it with others."""
    observed = [result.observed for result in one.localizations]
    numbers = np.array([frame.index for frame in one.frames], np.int64)
    return b"".join(
        [numbers.tobytes(), *(np.ascontiguousarray(o.anchor_px).tobytes() for o in observed)]
    )
