"""Two runs side by side as JSON values: what the page draws."""

import shlex
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from semviz.comparing.comparison import Comparison, compare_runs
from semviz.comparing.conditions import check_whole, parse_condition
from semviz.comparing.map_changes import MapChange, map_changes, renumbered
from semviz.comparing.metrics import trend
from semviz.comparing.setups import setups
from semviz.inspector.images.image_view import right_view
from semviz.inspector.scene.base_run import BaseFrame
from semviz.inspector.scene.surroundings import route
from semviz.inspector.views import Json, frame_view, run_head
from semviz.pose_errors import SURE_AND_WRONG_M, Errors
from semviz.recording.run import Run
from semviz.web import shapes
from semviz_core.arrays import FloatArray
from semviz_core.elements import Elements3D
from semviz_core.errors import SemvizError
from semviz_core.localization import Status

CHANGES_LISTED = 200
"""Of a map that was built anew everything has moved a little; ``semviz map diff`` lists all."""
LABELS = {
    "median_rte_m": "Median error",
    "q3_rte_m": "75th percentile",
    "mean_rte_m": "Mean error",
    "median_rre_deg": "Median angle",
    "share_below_1m": "Below 1 m",
    "share_below_1deg": "Below 1°",
    "coverage": "Ok",
    "share_ambiguous": "Ambiguous",
    "share_cannot": "Cannot",
    "share_sure_and_wrong": "Ok, yet over 1 m",
    "median_time_ms": "Time, median",
    "p95_time_ms": "Time, 95th percentile",
}


@dataclass(frozen=True, eq=False)
class Side:
    """One of the two runs, and where it was read from."""

    name: str
    run: Run
    path: Path


class SideBySide:
    """Run B, which is judged, against run A, the base. Raises SemvizError where they cannot be."""

    def __init__(self, base: Side, other: Side) -> None:
        self.base, self.other = base, other
        self.comparison = compare_runs(base.run, other.run)
        self.changes = map_changes(self.comparison, base.run, other.run)
        self._positions = {one.frame.index: at for at, one in enumerate(base.run.frames)}

    def base_frame(self, index: int) -> Json:
        """The frame numbered ``index`` as the base has it, also in its right image."""
        position, run = self._positions.get(index), self.base.run
        if position is None:
            return {"index": index, "frame": None, "right": None}
        right = None if run.info.rig.right is None else right_view(run, position)
        return {"index": index, "frame": frame_view(run, position), "right": right}

    def base_in_3d(self, index: int) -> BaseFrame | None:
        """The frame numbered ``index`` as the base has it; None where it does not have it."""
        position, run = self._positions.get(index), self.base.run
        if position is None:
            return None
        elements, facing_rad = self._changed
        return BaseFrame(
            self.base.name,
            run.frames[position],
            elements,
            facing_rad,
            run.semantic_map.classes,
        )

    @cached_property
    def _changed(self) -> tuple[Elements3D, FloatArray]:
        """What the base's map has and the other one has not there, and how signs are turned."""
        elements = self.base.run.semantic_map.elements
        ids = [id for one in self.changes for id in one.base_ids]
        changed = elements[np.flatnonzero(np.isin(elements.id, ids))]
        return changed, shapes.facing(changed.anchor_m, route(self.base.run))

    def view(self) -> Json:
        """All but what is asked for frame by frame."""
        comparison, base, other = self.comparison, self.base, self.other
        maps, listed = comparison.maps, self.changes[:CHANGES_LISTED]
        maps_of = base.run.semantic_map, other.run.semantic_map
        return {
            "other": other.name,
            "base": run_head(base.name, base.run),
            "frames": self._frames(),
            "onlyBase": list(comparison.only_base),
            "onlyOther": list(comparison.only_other),
            "hasTruth": any(None not in one.errors for one in comparison.frames),
            "metrics": _metrics(comparison),
            "names": [*comparison.measured[1]],
            "setups": [one._asdict() for one in setups(base.run, other.run)],
            "notes": list(comparison.notes),
            "sameMap": maps is None,
            "unchanged": 0 if maps is None else maps.unchanged,
            "changes": [_change(one) for one in listed],
            "changesLeft": len(self.changes) - len(listed),
            "baseIds": {} if maps is None else renumbered(maps, *maps_of),
            "command": shlex.join(["semviz", "compare", str(base.path), str(other.path)]),
        }

    def gate(self, text: str) -> Json:
        """A condition of ``--fail-if``: whether it holds, with its values, or why it is none."""
        text = " ".join(text.split())
        try:
            condition = parse_condition(text)
            for side in (self.base, self.other):
                check_whole(side.run, side.name)
            measured = self.comparison.measured
            fails, said = condition.holds(*measured), condition.values_text(*measured)
        except SemvizError as error:
            said = str(error).removeprefix(f"--fail-if '{text}': ")
            return {"text": text, "fails": None, "said": said}
        return {"text": text, "fails": fails, "said": said}

    def _frames(self) -> list[Json]:
        """Those in both, with their positions in the run that is judged."""
        position = {one.frame.index: at for at, one in enumerate(self.other.run.frames)}
        return [
            {
                "index": one.index,
                "position": position[one.index],
                "change": one.change,
                "a": _side(one.status[0], one.errors[0]),
                "b": _side(one.status[1], one.errors[1]),
            }
            for one in self.comparison.frames
        ]


def _side(status: Status, errors: Errors | None) -> Json:
    error_m = None if errors is None else errors.distance_m
    return {
        "status": status,
        "errorM": error_m,
        "errorDeg": None if errors is None else errors.angle_deg,
        "sureAndWrong": status == "ok" and error_m is not None and error_m > SURE_AND_WRONG_M,
    }


def _metrics(comparison: Comparison) -> list[Json]:
    """In words; a change that rounding hides is none."""
    rows = []
    for name, label in LABELS.items():
        values = comparison.base[name], comparison.other[name]
        here, there = (_with_unit(name, value) for value in values)
        changed = "same" if here == there else trend(name, *values)
        rows.append({"name": name, "label": label, "a": here, "b": there, "trend": changed})
    return rows


def _with_unit(name: str, value: float | None) -> str:
    if value is None:
        return "—"
    if name.endswith("_m"):
        return f"{value:.3f} m" if value < 1.0 else f"{value:.2f} m"
    if name.endswith("_deg"):
        return f"{value:.2f}°"
    return f"{value:.1f} ms" if name.endswith("_ms") else f"{100.0 * value:.1f} %"


def _change(one: MapChange) -> Json:
    return {
        "kind": one.kind,
        "names": one.other or one.base,
        "was": one.base if one.other else (),
        "movedM": one.moved_m,
        "element": one.other_ids[0] if one.other_ids else None,
        "baseElement": one.base_ids[0] if one.base_ids else None,
        "broken": one.broken,
        "fixed": one.fixed,
    }
