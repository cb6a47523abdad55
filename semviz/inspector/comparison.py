"""Compare the open run (B) with a base run (A), and show both side by side."""

import shlex
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from semviz.inspector import views_run
from semviz.inspector.context import Background, Panel, RunLibrary
from semviz.inspector.image import right_view
from semviz.inspector.messages import CheckGatesRequest, CompareRunsRequest
from semviz.inspector.scene.scene_cameras import BaseFrame, route
from semviz.inspector.views import frame_view, run_head
from semviz.runs.comparison import Comparison, compare_runs
from semviz.runs.differences import MapChange, map_changes, renumbered, setups
from semviz.runs.frame_table import frame_table
from semviz.runs.metrics import OVERCONFIDENT_M, Errors, check_complete, parse_condition, trend
from semviz.runs.run import Run
from semviz.web import shapes
from semviz.web.protocol import ErrorEvent, handles
from semviz_core.base.elements import Elements3D
from semviz_core.base.localization import Status
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError

MAX_CHANGES = 200
"""In a rebuilt map every element has moved a little; ``semviz map diff`` lists all changes."""
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
    "share_sure_and_wrong": "Ok, but over 1 m",
    "median_time_ms": "Time, median",
    "p95_time_ms": "Time, p95",
}


@dataclass(frozen=True, eq=False)
class Side:
    """One of the two runs, with its name and file."""

    name: str
    run: Run
    path: Path


def _positions(run: Run) -> dict[int, int]:
    """Return the position of each frame by its number."""
    return {number: row for row, number in enumerate(frame_table(run).index.tolist())}


class SideBySide:
    """Run B compared with run A, the base. Raise SemvizError if they cannot be compared."""

    def __init__(self, base: Side, other: Side) -> None:
        self.base, self.other = base, other
        self.comparison = compare_runs(base.run, other.run)
        self.changes = map_changes(self.comparison, base.run, other.run)
        self._positions = _positions(base.run)

    def base_frame(self, index: int) -> views_run.BaseFrameEvent:
        """Return frame number ``index`` of the base, with the submap in its right image."""
        position, run = self._positions.get(index), self.base.run
        if position is None:
            return views_run.BaseFrameEvent(index=index, base=None)
        right = None if run.info.rig.right is None else right_view(run, position)
        base = views_run.BaseFrameView(frame=frame_view(run, position), right=right)
        return views_run.BaseFrameEvent(index=index, base=base)

    def base_in_3d(self, index: int) -> BaseFrame | None:
        """Return frame number ``index`` of the base for the 3D pane; None if the base lacks it."""
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
        """Elements that only the base's map has, and the facing of its signs (rad)."""
        elements = self.base.run.semantic_map.elements
        ids = [id for change in self.changes for id in change.base_ids]
        changed = elements[np.flatnonzero(np.isin(elements.id, ids))]
        return changed, shapes.facing(changed.anchor_m, route(self.base.run))

    def view(self) -> views_run.ComparisonView:
        """Return all that does not depend on the frame shown."""
        comparison, base, other = self.comparison, self.base, self.other
        maps, listed = comparison.maps, self.changes[:MAX_CHANGES]
        both_maps = base.run.semantic_map, other.run.semantic_map
        return views_run.ComparisonView(
            other=other.name,
            base=run_head(base.name, base.run),
            frames=self._frames(),
            only_base=comparison.only_base,
            only_other=comparison.only_other,
            metrics=_metrics(comparison),
            names=tuple(comparison.measured[1]),
            setups=tuple(
                views_run.SetupRow(**setup._asdict()) for setup in setups(base.run, other.run)
            ),
            notes=comparison.notes,
            same_map=maps is None,
            unchanged=0 if maps is None else maps.unchanged,
            changes=tuple(_change(change) for change in listed),
            more_changes=len(self.changes) - len(listed),
            base_ids={} if maps is None else renumbered(maps, *both_maps),
            command=shlex.join(["semviz", "compare", str(base.path), str(other.path)]),
        )

    def gate(self, text: str) -> views_run.GateView:
        """Check a condition of ``--fail-if``: whether it fails, and its values, or an error."""
        text = " ".join(text.split())
        try:
            condition = parse_condition(text)
            for side in (self.base, self.other):
                check_complete(side.run, side.name)
            measured = self.comparison.measured
            fails, values = condition.holds(*measured), condition.values_text(*measured)
        except SemvizError as error:
            reason = str(error).removeprefix(f"--fail-if '{text}': ")
            return views_run.GateView(text=text, fails=None, values=reason)
        return views_run.GateView(text=text, fails=fails, values=values)

    def _frames(self) -> tuple[views_run.ComparedFrame, ...]:
        """Return the frames of both runs, with their positions in run B."""
        positions = _positions(self.other.run)
        return tuple(
            views_run.ComparedFrame(
                index=frame.index,
                position=positions[frame.index],
                change=frame.change,
                a=_answer(frame.status[0], frame.errors[0]),
                b=_answer(frame.status[1], frame.errors[1]),
            )
            for frame in self.comparison.frames
        )


def _answer(status: Status, errors: Errors | None) -> views_run.ComparedAnswer:
    error_m = None if errors is None else errors.distance_m
    return views_run.ComparedAnswer(
        status=status,
        error_m=error_m,
        error_deg=None if errors is None else errors.angle_deg,
        overconfident=status == "ok" and error_m is not None and error_m > OVERCONFIDENT_M,
    )


def _metrics(comparison: Comparison) -> tuple[views_run.MetricRow, ...]:
    """Return the metrics as text. A change that rounding hides counts as none."""
    rows = []
    for name, label in LABELS.items():
        values = comparison.base[name], comparison.other[name]
        base, other = (_with_unit(name, value) for value in values)
        changed = "same" if base == other else trend(name, *values)
        rows.append(views_run.MetricRow(name=name, label=label, a=base, b=other, trend=changed))
    return tuple(rows)


def _with_unit(name: str, value: float | None) -> str:
    if value is None:
        return "—"
    if name.endswith("_m"):
        return f"{value:.3f} m" if value < 1.0 else f"{value:.2f} m"
    if name.endswith("_deg"):
        return f"{value:.2f}°"
    return f"{value:.1f} ms" if name.endswith("_ms") else f"{100.0 * value:.1f} %"


def _change(change: MapChange) -> views_run.MapChangeView:
    return views_run.MapChangeView(
        kind=change.kind,
        names=change.other or change.base,
        was=change.base if change.other else (),
        moved_m=change.moved_m,
        element=change.other_ids[0] if change.other_ids else None,
        base_element=change.base_ids[0] if change.base_ids else None,
        broken=change.broken,
        fixed=change.fixed,
    )


class Comparing(Background[SideBySide]):
    """Reads the base, which takes seconds, and compares the runs."""

    def __init__(self, library: RunLibrary, base: str, other: str, run: Run) -> None:
        """``run`` is the run named ``other``."""
        super().__init__()
        self._library, self._base = library, base
        self._other = Side(other, run, library.path(other))

    def is_of(self, base: str, run: Run) -> bool:
        """Whether it compares ``run`` with the run named ``base``."""
        return self._base == base and self._other.run is run

    def work(self) -> SideBySide:
        run = self._library.run(self._base)
        return SideBySide(Side(self._base, run, self._library.path(self._base)), self._other)


class ComparisonPanel(Panel):
    """Compares with the base, and sends its frames while both runs are shown."""

    _comparing: Comparing | None = None
    """The last comparison, which may be of other runs than those shown."""

    def on_run(self) -> None:
        self._show()

    def on_frame(self) -> None:
        self._send_frame()

    def on_drawn(self) -> None:
        self._draw()

    def on_state(self) -> None:
        if self.context.has_scene:  # the view through the camera hides the base
            self._draw()

    @handles(CompareRunsRequest)
    def _compare(self, request: CompareRunsRequest) -> None:
        context, base = self.context, request.base
        if base == context.state.run:
            raise SemvizError(f"{base} is the open run; choose another one to compare with")
        is_new = base != context.state.base
        context.state = context.state.with_base(base, request.side_by_side)
        context.send_state()
        if is_new:
            self._show()
        else:
            self._send_frame()
        context.draw_frame()

    @handles(CheckGatesRequest)
    def _check_gates(self, request: CheckGatesRequest) -> None:
        shown = self._current()
        if shown is not None:
            gates = tuple(shown.gate(text) for text in request.conditions)
            self.context.send(views_run.GatesEvent(gates=gates))

    def _current(self) -> SideBySide | None:
        """Return the comparison of the runs shown; None until it is computed."""
        comparing = self._comparing
        return comparing.value if comparing and self._is_current(comparing) else None

    def _is_current(self, comparing: Comparing) -> bool:
        return comparing.is_of(self.context.state.base, self.context.run)

    def _show(self) -> None:
        """Send the comparison, if there is a base; compute it first if needed."""
        context, comparing = self.context, self._comparing
        if not context.state.base:
            return
        if comparing is None or not self._is_current(comparing):
            comparing = Comparing(
                context.library, context.state.base, context.state.run, context.run
            )
            self._comparing = comparing
        comparing.start(partial(self._on_progress, comparing))

    def _on_progress(self, comparing: Comparing) -> None:
        """Called in the background thread; other runs may be shown by then."""
        context = self.context
        with context.lock:
            if not comparing.is_over or not self._is_current(comparing):
                return
            if comparing.value is None:
                context.state = context.state.with_base("", False)
                context.send_state()
                context.send(ErrorEvent(code="invalid", text=comparing.progress))
                return
            context.send(views_run.ComparisonEvent(comparison=comparing.value.view()))
            self._send_frame()
            self._draw()

    def _send_frame(self) -> None:
        """Send the frame of the base."""
        shown = self._current()
        if shown is not None and self.context.state.comparing:
            self.context.send(shown.base_frame(self._index))

    def _draw(self) -> None:
        """Draw the frame of the base in 3D, or remove it."""
        shown, state = self._current(), self.context.state
        base = shown.base_in_3d(self._index) if shown is not None and state.comparing else None
        self.context.scene.show_base(base, state)

    @property
    def _index(self) -> int:
        """Number of the frame shown."""
        return self.context.run.frames[self.context.state.position].frame.index
