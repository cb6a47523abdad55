"""What rerun shows over the frames: curves, the lanes of status and verdict, and texts."""

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from semviz.palette import ALTERNATIVE, ESTIMATE, PRIOR, STATUS, TRUTH, Tone, rgba
from semviz.recording.columns import Columns
from semviz.recording.run import FrameRecord, Run
from semviz.recording.words import LEVELS, explain
from semviz.verdicts import STARTING_OR_LOST, explained, verdict
from semviz_core.evaluation.metrics import pose_error

OFF_M, OFF_DEG = "/error/translation_m", "/error/rotation_deg"
COUNTS, TIME_MS = "/elements", "/time_ms"
STATUSES, VERDICTS, WHY = "/status", "/verdict", "/why"

VERDICT = {
    "healthy": STATUS["ok"],
    STARTING_OR_LOST: PRIOR,
    "not in the submap": PRIOR,
    "ambiguous geometry": STATUS["ambiguous"],
    **dict.fromkeys(
        ("moved in the map", "missing in the map", "twice in the map", "wrong calibration"),
        ALTERNATIVE,
    ),
    **dict.fromkeys(
        (
            "too few elements",
            "missed detection",
            "false detection",
            "wrong class",
            "false or not mapped",
        ),
        ESTIMATE,
    ),
    **dict.fromkeys(
        ("wrong matches", "search miss", "refinement diverged", "unexplained"), STATUS["cannot"]
    ),
}
"""Grey: the prior. Yellow: the place. Violet: the map. Orange: what was seen. Red: the method."""


def draw_styles(stream: rr.RecordingStream) -> None:
    """What stays the same for all frames: names and colours."""
    for entity, name in ((OFF_M, "translation error, m"), (OFF_DEG, "rotation error, deg")):
        dots = rr.SeriesPoints(colors=_colors(ESTIMATE), names=name, marker_sizes=3.0)
        stream.log(entity, dots, static=True)
    names, colors = ["seen", "paired", "inliers"], _colors(TRUTH, PRIOR, STATUS["ok"])
    stream.log(COUNTS, rr.SeriesLines(colors=colors, names=names, widths=1.5), static=True)
    stream.log(WHY, rr.TextDocument.from_fields(media_type="text/markdown"), static=True)
    for entity, tones in ((STATUSES, STATUS), (VERDICTS, VERDICT)):
        states = rr.StateConfiguration(values=list(tones), colors=_colors(*tones.values()))
        stream.log(entity, states, static=True)


def draw(columns: Columns, run: Run, record: FrameRecord) -> None:
    """One frame of ``run``, of which info and map are enough."""
    result, truth = record.localization, record.frame.T_map_camera
    errors = None
    if truth is not None and result.T_camera_map is not None:
        errors = pose_error(result.T_camera_map, truth.inverse())
    pairs, inliers = np.nan, np.nan
    if result.refinement is not None:
        pairs, inliers = len(result.refinement.pairs), int(result.refinement.inlier.sum())
    off_m, off_deg = errors or (np.nan, np.nan)
    columns.scalars(OFF_M, off_m)
    columns.scalars(OFF_DEG, off_deg)
    columns.scalars(COUNTS, len(result.observed), pairs, inliers)
    columns.scalars(TIME_MS, sum(result.time_ms.values()))
    _draw_words(columns, run, record, errors)


def _draw_words(
    columns: Columns, run: Run, record: FrameRecord, errors: tuple[float, float] | None
) -> None:
    result, name = record.localization, verdict(run, record)
    told = None if name in ("healthy", STARTING_OR_LOST) else explained(run, record)
    columns.text(STATUSES, "StateChange:state", result.status)
    columns.text(VERDICTS, "StateChange:state", name)
    columns.text(WHY, "TextDocument:text", explain(record, errors, told))
    line = result.reason if told is None else f"{told.kind}: {told.sentence}"
    columns.text(WHY, "TextLog:text", line)
    columns.text(WHY, "TextLog:level", LEVELS[result.status], "TextLogLevel")


def _colors(*tones: Tone) -> NDArray[np.uint32]:
    return np.array([rgba(one.dark) for one in tones], np.uint32)
