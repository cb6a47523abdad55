"""Changes tried on all frames of a run that they concern, counted, and kept as a run."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import numpy as np

from semviz.comparing.comparison import FrameChange, frame_change
from semviz.pose_errors import Errors
from semviz.recording.run import FrameRecord, Run
from semviz.recording.writer import write_run
from semviz.trying.again import again, as_asked, changed_map
from semviz.trying.asked import Asked
from semviz.trying.change import Change
from semviz.trying.changes import to_json

SAME_M = 1e-3
"""Answers whose errors differ by less are the same."""


@dataclass(frozen=True, eq=False)
class Tried:
    """One frame with changes."""

    record: FrameRecord
    change: FrameChange
    """Against the frame as it was asked."""


def matter(run: Run, record: FrameRecord, changes: Sequence[Change]) -> bool:
    """Whether changes make anything otherwise in a frame."""
    asked = Asked.of(run, record)
    return any(one.concerns(asked) for one in changes)


def concerned(run: Run, changes: Sequence[Change]) -> tuple[FrameRecord, ...]:
    """The frames in which changes matter."""
    return tuple(record for record in run.frames if matter(run, record, changes))


def tried(run: Run, record: FrameRecord, changes: Sequence[Change]) -> Tried:
    """One frame with changes, beside what it was."""
    after = again(run, record, changes)
    return Tried(after, frame_change(as_asked(run, record), after))


def in_words(frames: Sequence[FrameChange]) -> str:
    """What changes did, such as ``9 of 47 frames change: median 0.31 m → 0.06 m, ok 5 → 8, 3 fixed,
    0 broken.``"""
    changed = [one for one in frames if _differs(one)]
    if not changed:
        return f"No answer changes in {_number(len(frames))}."
    counts = [sum(one.change == kind for one in changed) for kind in ("fixed", "broken")]
    ok = [sum(one.status[side] == "ok" for one in changed) for side in (0, 1)]
    medians = [_median([one.errors[side] for one in changed]) for side in (0, 1)]
    said = [f"ok {ok[0]} → {ok[1]}", f"{counts[0]} fixed", f"{counts[1]} broken"]
    if any(medians):
        said.insert(0, f"median {medians[0] or 'none'} → {medians[1] or 'none'}")
    return f"{len(changed)} of {_number(len(frames))} change: {', '.join(said)}."


def free_path(path: Path, what: str) -> Path:
    """A name beside a run, such as ``drive-tried-1.rrd``, that no file has yet."""
    number = 1
    while (free := path.with_name(f"{path.stem}-{what}-{number}.rrd")).exists():
        number += 1
    return free


def save(run: Run, changes: Sequence[Change], found: Mapping[int, FrameRecord], path: Path) -> None:
    """A new run: the frames ``found``, by their numbers, and all others as they were.

    Raises SemvizError where ``path`` cannot be written.
    """
    info = replace(
        run.info,
        name=path.stem,
        version=version("semviz"),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        options={**run.info.options, "changes": [to_json(one) for one in changes]},
    )
    records = (found.get(record.frame.index, record) for record in run.frames)
    write_run(records, path, info, changed_map(run.semantic_map, changes))


def _differs(one: FrameChange) -> bool:
    before, after = one.errors
    if before is None or after is None:
        return one.status[0] != one.status[1]
    return one.status[0] != one.status[1] or abs(after.distance_m - before.distance_m) > SAME_M


def _number(frames: int) -> str:
    return "1 frame" if frames == 1 else f"{frames} frames"


def _median(errors: Iterable[Errors | None]) -> str:
    """Of the frames with a pose; empty where there is none."""
    known = [one.distance_m for one in errors if one is not None]
    return f"{np.median(known):.2f} m" if known else ""
