"""Compare two runs frame by frame: fixed, broken, and changed frames, with the metrics.

Frames are matched by number, and all figures are of the frames that both runs have. A frame is
good if it is ``ok`` and less than 1 m off; unless both runs have its true pose, ``ok`` is enough.
A fixed frame is good only in the other run, a broken one only in the base. Everything follows from
the tables of the runs; no frame is read.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from semviz.presentation.terminal import Table
from semviz.runs.frame_table import STATUSES, FrameTable, frame_table
from semviz.runs.metrics import DIAGNOSED, Errors, Metrics, errors_of, settings_of
from semviz.runs.run import FrameRecord, Run
from semviz.runs.table_metrics import diagnosis_counts, metrics_of
from semviz_annotation.mapping.quality.diff import MapDiff, diff_maps
from semviz_core.base.localization import Status
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.errors import SemvizError

GOOD_BELOW_M = 1.0
SAME_TRUTH_M = 1e-3
"""Larger differences of the true poses are noted."""
OTHER_SEQUENCE_M = 1.0
"""If the true poses differ by more than this (median), the runs are of two sequences."""
Change = Literal["fixed", "broken", "same"]


class Difference(NamedTuple):
    """A setting in which the runs differ, as texts."""

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
    """The other run compared with the base, over the frames that both have."""

    frames: tuple[FrameChange, ...]
    """Sorted by number."""
    named: tuple[tuple[str, str], ...]
    """Of each of these: its diagnoses in base and other."""
    apart_m: FloatArray
    """(n,) of these: distance of the two estimates; NaN unless both have one."""
    base: Metrics
    other: Metrics
    diagnosed: tuple[Metrics, Metrics]
    """Number of frames of each diagnosis, in both."""
    only_base: tuple[int, ...]
    """Numbers of the frames that the other run does not have."""
    only_other: tuple[int, ...]
    differences: tuple[Difference, ...]
    maps: MapDiff | None
    """None if both used the same map."""
    notes: tuple[str, ...]
    """Limits of the comparison, for its readers."""

    def of(self, change: Change) -> tuple[FrameChange, ...]:
        """Return the frames that are ``fixed``, ``broken`` or ``same``, by number."""
        return tuple(frame for frame in self.frames if frame.change == change)

    @property
    def counts(self) -> Metrics:
        """Metrics of the other run that only a comparison has."""
        apart_m = self.apart_m[np.isfinite(self.apart_m)]
        return {
            "fixed": float(len(self.of("fixed"))),
            "broken": float(len(self.of("broken"))),
            "same": float(len(self.of("same"))),
            "missing": float(len(self.only_base)),
            "median_apart_m": float(np.median(apart_m)) if len(apart_m) else None,
            "max_apart_m": float(apart_m.max()) if len(apart_m) else None,
        }

    @property
    def measured(self) -> tuple[Metrics, Metrics]:
        """Metrics for conditions: those of the base, and those of the other run with the counts."""
        base, other = self.diagnosed
        return {**self.base, **base}, {**self.other, **self.counts, **other}

    @property
    def found_diagnoses(self) -> list[tuple[str, int, int]]:
        """Return the diagnoses that frames have, with the number of frames in both."""
        base, other = self.diagnosed
        counts = [(name, int(base[name] or 0), int(other[name] or 0)) for name in base]
        return [
            (name.removeprefix(DIAGNOSED), before, after)
            for name, before, after in counts
            if before or after
        ]

    def as_dict(self) -> dict[str, Any]:
        """Return JSON values, without the names of the runs."""
        return {
            "frames": len(self.frames),
            "fixed": [frame.index for frame in self.of("fixed")],
            "broken": [frame.index for frame in self.of("broken")],
            "same": len(self.of("same")),
            "only_base": list(self.only_base),
            "only_other": list(self.only_other),
            "metrics": {
                name: {"base": self.base[name], "other": value}
                for name, value in self.other.items()
            },
            "diagnoses": {
                name: {"base": base, "other": other} for name, base, other in self.found_diagnoses
            },
            "apart_m": {name: self.counts[f"{name}_apart_m"] for name in ("median", "max")},
            "each": [
                _frame_as_dict(*row)
                for row in zip(self.frames, self.named, self.apart_m.tolist(), strict=True)
            ],
            "differences": [difference._asdict() for difference in self.differences],
            "map": None if self.maps is None else self.maps.as_dict(),
            "notes": list(self.notes),
        }


def compare_runs(base: Run, other: Run) -> Comparison:
    """Compare two runs. Raise SemvizError if they are of different sequences or share no frame."""
    names = [run.semantic_map.frame.name for run in (base, other)]
    if names[0] != names[1]:
        raise SemvizError(
            f"the runs are of '{names[0]}' and of '{names[1]}'; compare runs of one sequence"
        )
    tables = frame_table(base), frame_table(other)
    numbers = tables[0].index, tables[1].index
    common = np.intersect1d(*numbers)
    if not len(common):
        raise SemvizError(f"the runs have no frame in common: {_spans(base)}; {_spans(other)}")
    rows = [np.searchsorted(all_of, common) for all_of in numbers]
    notes = list(_truth_notes(*(table.truth_m[of] for table, of in zip(tables, rows, strict=True))))
    sides = [_results(table, of) for table, of in zip(tables, rows, strict=True)]
    only = [np.setdiff1d(all_of, common).tolist() for all_of in numbers]
    same_map = base.semantic_map.digest == other.semantic_map.digest
    return Comparison(
        frames=tuple(_change(*frame) for frame in zip(common.tolist(), *sides, strict=True)),
        named=tuple(zip(*map(_diagnoses_of, tables, rows), strict=True)),
        apart_m=_apart_m(*(table.estimate_m[of] for table, of in zip(tables, rows, strict=True))),
        base=metrics_of(base, rows[0]),
        other=metrics_of(other, rows[1]),
        diagnosed=(diagnosis_counts(base, rows[0]), diagnosis_counts(other, rows[1])),
        only_base=tuple(only[0]),
        only_other=tuple(only[1]),
        differences=tuple(_setting_differences(base, other)),
        maps=None if same_map else diff_maps(base.semantic_map, other.semantic_map),
        notes=(
            *(f"{name}: {run.note}" for name, run in _named(base, other) if run.note),
            *_left_out(len(only[0]), "base"),
            *_left_out(len(only[1]), "other run"),
            *notes,
        ),
    )


def _named(base: Run, other: Run) -> tuple[tuple[str, Run], ...]:
    return ("base", base), ("other run", other)


def _spans(run: Run) -> str:
    numbers = frame_table(run).index
    return f"{len(numbers)} from {numbers[0]} to {numbers[-1]}" if len(numbers) else "no frames"


def _left_out(count: int, where: str) -> Iterator[str]:
    if count:
        some = "frame is" if count == 1 else "frames are"
        yield f"{count} {some} only in the {where}, and left out"


def _truth_notes(base_m: FloatArray, other_m: FloatArray) -> Iterator[str]:
    """Yield notes on the true positions (n, 3). Raise SemvizError if they are of two sequences."""
    apart_m = np.linalg.norm(base_m - other_m, axis=1)
    known_m = apart_m[np.isfinite(apart_m)]
    if len(known_m) and np.median(known_m) > OTHER_SEQUENCE_M:
        raise SemvizError(
            f"true poses of the same frames are {np.median(known_m):.1f} m apart (median): "
            "the runs are of two drives; compare runs of one"
        )
    if len(known_m) and known_m.max() > SAME_TRUTH_M:
        yield f"the true poses of the runs differ, by up to {known_m.max():.3f} m"
    if unknown := len(apart_m) - len(known_m):
        yield f"{unknown} of {len(apart_m)} frames have no true pose: compared by status alone"


def _diagnoses_of(table: FrameTable, rows: IntArray) -> list[str]:
    return table.texts_of(table.diagnosis[rows])


def _apart_m(base_m: FloatArray, other_m: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(base_m - other_m, axis=1))


class _Result(NamedTuple):
    """What one run says of a frame."""

    status: Status
    errors: Errors | None
    has_truth: bool


def _results(table: FrameTable, rows: IntArray) -> list[_Result]:
    errors = np.stack([table.distance_m[rows], table.angle_deg[rows]], axis=1)
    return [
        _Result(STATUSES[status], None if np.isnan(of[0]) else Errors(*of), has_truth)
        for status, of, has_truth in zip(
            table.status[rows].tolist(),
            errors.tolist(),
            table.has_truth[rows].tolist(),
            strict=True,
        )
    ]


def frame_change(base: FrameRecord, other: FrameRecord) -> FrameChange:
    """Compare one frame of both runs."""
    sides = (
        _Result(
            record.localization.status, errors_of(record), record.frame.T_map_camera is not None
        )
        for record in (base, other)
    )
    return _change(base.frame.index, *sides)


def _change(index: int, base: _Result, other: _Result) -> FrameChange:
    known = base.has_truth and other.has_truth
    good = [
        side.status == "ok"
        and (not known or (side.errors is not None and side.errors.distance_m < GOOD_BELOW_M))
        for side in (base, other)
    ]
    change: Change = "same" if good[0] == good[1] else "fixed" if good[1] else "broken"
    return FrameChange(index, (base.status, other.status), (base.errors, other.errors), change)


def _setting_differences(base: Run, other: Run) -> Iterator[Difference]:
    settings = [settings_of(run) for run in (base, other)]
    for name in dict.fromkeys([*settings[0], *settings[1]]):
        values = [setting.get(name, "-") for setting in settings]
        if values[0] != values[1]:
            yield Difference(name, *values)


def _frame_as_dict(frame: FrameChange, named: tuple[str, str], apart_m: float) -> dict[str, Any]:
    sides = {
        side: {
            "status": status,
            "rte_m": None if errors is None else errors.distance_m,
            "rre_deg": None if errors is None else errors.angle_deg,
            "diagnosis": diagnosis,
        }
        for side, status, errors, diagnosis in zip(
            ("base", "other"), frame.status, frame.errors, named, strict=True
        )
    }
    apart = None if np.isnan(apart_m) else apart_m
    return {"frame": frame.index, "change": frame.change, "apart_m": apart, **sides}


def _diagnoses(comparison: Comparison) -> str:
    """Return the diagnoses whose number of frames differs, in a line."""
    changed = (
        f"{name.replace('_', ' ')} {base} -> {other}"
        for name, base, other in comparison.found_diagnoses
        if base != other
    )
    text = ", ".join(changed)
    return f"diagnoses: {text}" if text else ""


LISTED = 10
"""Maximum number of fixed, and of broken, frames in the text."""


def comparison_text(comparison: Comparison) -> str:
    """Return settings that differ, counts, metrics side by side, and changed frames as text."""
    parts = [
        "\n".join(comparison.notes),
        "\n".join(_difference_lines(comparison)),
        _counts(comparison),
        metrics_table(comparison).as_text(),
        _diagnoses(comparison),
        *(_frames(comparison, change) for change in ("broken", "fixed")),
    ]
    if comparison.maps is not None:
        parts.append(f"maps, base to other:\n{comparison.maps.as_text()}")
    return "\n\n".join(part for part in parts if part)


def metrics_table(comparison: Comparison) -> Table:
    """Return every metric of both runs, and its change."""
    rows = []
    for name, other in comparison.other.items():
        base = comparison.base[name]
        change = None if base is None or other is None else other - base
        rows.append((name, _number(base), _number(other), "-" if not change else f"{change:+.4g}"))
    return Table("", ("metric", "base", "other", "change"), tuple(rows), words=1)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _difference_lines(comparison: Comparison) -> Iterator[str]:
    for difference in comparison.differences:
        yield f"{difference.what}: {difference.base} -> {difference.other}"
    if not comparison.differences:
        yield "same settings and map"


def _counts(comparison: Comparison) -> str:
    counts = {name: int(value or 0) for name, value in comparison.counts.items()}
    text = (
        f"{len(comparison.frames)} frames in both: {counts['fixed']} fixed, "
        f"{counts['broken']} broken, {counts['same']} same"
    )
    median_m, most_m = (comparison.counts[f"{name}_apart_m"] for name in ("median", "max"))
    if median_m is None or most_m is None:
        return text
    return f"{text}; poses {median_m:.3f} m apart (median), at most {most_m:.2f} m"


def _frames(comparison: Comparison, change: Change) -> str:
    frames = comparison.of(change)
    lines = [f"{change}:", *(f"  {_frame(frame)}" for frame in frames[:LISTED])]
    if len(frames) > LISTED:
        lines.append(f"  {len(frames) - LISTED} more; --json lists all")
    return "\n".join(lines) if frames else ""


def _frame(frame: FrameChange) -> str:
    base, other = (
        f"{status}{_error(errors)}"
        for status, errors in zip(frame.status, frame.errors, strict=True)
    )
    return f"frame {frame.index}: {base} -> {other}"


def _error(errors: Errors | None) -> str:
    return "" if errors is None else f" {errors.distance_m:.2f} m"
