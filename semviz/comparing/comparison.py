"""Two runs of one drive, frame by frame: what is fixed, what is broken, and what else differs."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from semviz.comparing.metrics import Metrics, metrics_of
from semviz.measure import settings_of
from semviz.pose_errors import Errors, errors_of
from semviz.recording.run import FrameRecord, Run
from semviz_annotation.mapping.quality.diff import MapDiff, diff_maps
from semviz_core.errors import SemvizError
from semviz_core.localization import Status

GOOD_BELOW_M = 1.0
SAME_TRUTH_M = 1e-3
"""True poses that are further apart are worth a note."""
OTHER_DRIVE_M = 1.0
"""True poses of one frame that are, by the median, further apart are of two drives."""
Change = Literal["fixed", "broken", "same"]


class Difference(NamedTuple):
    """A setting in which the runs differ, in words."""

    what: str
    base: str
    other: str


@dataclass(frozen=True)
class FrameChange:
    """One frame in both runs."""

    index: int
    status: tuple[Status, Status]
    """In base and other."""
    errors: tuple[Errors | None, Errors | None]
    """None without a pose or a true one."""
    change: Change


@dataclass(frozen=True)
class Comparison:
    """The other run against the base. All numbers are over the frames that both have."""

    frames: tuple[FrameChange, ...]
    """By number."""
    base: Metrics
    other: Metrics
    only_base: tuple[int, ...]
    """Numbers of the frames that the other run does not have."""
    only_other: tuple[int, ...]
    differences: tuple[Difference, ...]
    maps: MapDiff | None
    """None where both used the same map."""
    notes: tuple[str, ...]
    """What readers of the numbers should know."""

    def of(self, change: Change) -> tuple[FrameChange, ...]:
        """The frames that are ``fixed``, ``broken`` or ``same``, by number."""
        return tuple(one for one in self.frames if one.change == change)

    @property
    def counts(self) -> Metrics:
        """What gates can ask besides the metrics of the runs; the base has no such numbers."""
        return {
            "fixed": float(len(self.of("fixed"))),
            "broken": float(len(self.of("broken"))),
            "same": float(len(self.of("same"))),
            "missing": float(len(self.only_base)),
        }

    @property
    def measured(self) -> tuple[Metrics, Metrics]:
        """What conditions are about: the base's metrics; the other run's, with the counts."""
        return self.base, {**self.other, **self.counts}

    def as_dict(self) -> dict[str, Any]:
        """For JSON, but for the names of the runs."""
        return {
            "frames": len(self.frames),
            "fixed": [one.index for one in self.of("fixed")],
            "broken": [one.index for one in self.of("broken")],
            "same": len(self.of("same")),
            "only_base": list(self.only_base),
            "only_other": list(self.only_other),
            "metrics": {
                name: {"base": self.base[name], "other": value}
                for name, value in self.other.items()
            },
            "each": [_frame_as_dict(one) for one in self.frames],
            "differences": [one._asdict() for one in self.differences],
            "map": None if self.maps is None else self.maps.as_dict(),
            "notes": list(self.notes),
        }


def compare_runs(base: Run, other: Run) -> Comparison:
    """Frames are matched by number. A frame is good where it is ``ok`` and below 1 m; where not
    both runs know its true pose, where it is ``ok``. Fixed: good in the other run alone; broken:
    in the base alone.

    Raises SemvizError where the runs are of other sequences or drives, or share no frame.
    """
    here, there = (run.semantic_map.frame.name for run in (base, other))
    if here != there:
        raise SemvizError(
            f"the runs are of '{here}' and of '{there}'; compare runs of one sequence"
        )
    numbers = [{one.frame.index for one in run.frames} for run in (base, other)]
    common = numbers[0] & numbers[1]
    if not common:
        raise SemvizError(f"the runs have no frame in common: {_spans(base)}; {_spans(other)}")
    one, two = (_only(run, common) for run in (base, other))
    pairs = list(zip(one.frames, two.frames, strict=True))
    notes = list(_truth_notes(pairs))  # first: it refuses what is not one drive
    same_map = base.semantic_map.digest == other.semantic_map.digest
    return Comparison(
        frames=tuple(frame_change(*pair) for pair in pairs),
        base=metrics_of(one),
        other=metrics_of(two),
        only_base=tuple(sorted(numbers[0] - common)),
        only_other=tuple(sorted(numbers[1] - common)),
        differences=tuple(_differences(base, other)),
        maps=None if same_map else diff_maps(base.semantic_map, other.semantic_map),
        notes=(
            *(f"{name}: {run.note}" for name, run in _named(base, other) if run.note),
            *_left_out(numbers[0] - common, "base"),
            *_left_out(numbers[1] - common, "other run"),
            *notes,
        ),
    )


def _named(base: Run, other: Run) -> tuple[tuple[str, Run], ...]:
    return ("base", base), ("other run", other)


def _only(run: Run, numbers: set[int]) -> Run:
    return replace(run, frames=tuple(one for one in run.frames if one.frame.index in numbers))


def _spans(run: Run) -> str:
    if not run.frames:
        return "none at all"
    first, last = run.frames[0].frame.index, run.frames[-1].frame.index
    return f"{len(run.frames)} from {first} to {last}"


def _left_out(numbers: set[int], where: str) -> Iterator[str]:
    if numbers:
        some = "frame is" if len(numbers) == 1 else "frames are"
        yield f"{len(numbers)} {some} only in the {where}, and left out"


def _truth_notes(pairs: list[tuple[FrameRecord, FrameRecord]]) -> Iterator[str]:
    """Whether both runs have the same true poses; SemvizError where they are of two drives."""
    known = [(a.frame.T_map_camera, b.frame.T_map_camera) for a, b in pairs]
    apart = [float(np.linalg.norm(a.translation - b.translation)) for a, b in known if a and b]
    if apart and np.median(apart) > OTHER_DRIVE_M:
        raise SemvizError(
            f"true poses of the same frames are {np.median(apart):.1f} m apart (median): "
            "the runs are of two drives"
        )
    if apart and max(apart) > SAME_TRUTH_M:
        yield f"the true poses of the runs differ, by up to {max(apart):.3f} m"
    if len(apart) < len(pairs):
        unknown = len(pairs) - len(apart)
        yield f"{unknown} of {len(pairs)} frames have no true pose: judged by their status alone"


def frame_change(base: FrameRecord, other: FrameRecord) -> FrameChange:
    """What became of one frame."""
    errors = errors_of(base), errors_of(other)
    known = base.frame.T_map_camera is not None and other.frame.T_map_camera is not None
    good = [
        record.localization.status == "ok"
        and (not known or (error is not None and error.distance_m < GOOD_BELOW_M))
        for record, error in zip((base, other), errors, strict=True)
    ]
    change: Change = "same" if good[0] == good[1] else "fixed" if good[1] else "broken"
    status = base.localization.status, other.localization.status
    return FrameChange(base.frame.index, status, errors, change)


def _differences(base: Run, other: Run) -> Iterator[Difference]:
    """In what the runs were made with."""
    settings = [settings_of(run) for run in (base, other)]
    for what in dict.fromkeys([*settings[0], *settings[1]]):
        values = [one.get(what, "-") for one in settings]
        if values[0] != values[1]:
            yield Difference(what, *values)


def _frame_as_dict(one: FrameChange) -> dict[str, Any]:
    sides = {
        side: {
            "status": status,
            "rte_m": None if errors is None else errors.distance_m,
            "rre_deg": None if errors is None else errors.angle_deg,
        }
        for side, status, errors in zip(("base", "other"), one.status, one.errors, strict=True)
    }
    return {"frame": one.index, "change": one.change, **sides}
