"""Run-wide findings: the diagnosis, each map element over its frames, and the forecast.

The forecast is the expected error along the run's route. All are computed on first request.
"""

from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from semviz.inspector import views_run
from semviz.inspector.context import Background, Panel
from semviz.inspector.element_card import map_row, provenance_of
from semviz.inspector.messages import FindFramesRequest, GetElementsRequest, ShowForecastRequest
from semviz.inspector.views import number
from semviz.inspector.views_run import ForecastEvent, ForecastView, SuggestedElement
from semviz.runs.diagnosis import run_diagnosis, run_elements
from semviz.runs.frame_table import frame_table
from semviz.runs.run import Run
from semviz.runs.story import RunStory, tell, typical_positions
from semviz.web.protocol import handles
from semviz.workspace.localization import localizability
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.diagnosis.checks import same_positions
from semviz_core.diagnosis.element_statistics import ElementRecord
from semviz_core.diagnosis.fault import EvidenceItem, Fault, RunFault
from semviz_core.diagnosis.run import RunDiagnosis
from semviz_core.localizability.expected_error import Effect
from semviz_core.localizability.predict import LIMITS_M, Localizability, predict
from semviz_core.localizability.route import Conditions


@dataclass(frozen=True)
class Findings:
    """The diagnosis of a run, and the statistics of its map elements."""

    diagnosis: RunDiagnosis
    elements: tuple[ElementRecord, ...]


class RunAnalysis(Background[RunDiagnosis]):
    """Diagnoses one run, a long one by typical frames."""

    def __init__(self, run: Run, _: Path) -> None:
        super().__init__()
        self._run = run
        self.positions = typical_positions(run)
        """Of the frames that are diagnosed."""
        self._diagnosed: RunStory | None = None

    def work(self) -> RunDiagnosis:
        diagnosis = run_diagnosis(self._run, self.watch, self.positions)
        self._diagnosed = tell(self._run, diagnosis)
        return diagnosis

    @property
    def story(self) -> RunStory:
        """The story of the run; with the causes of the whole run, once it is diagnosed."""
        return self._diagnosed or self._first_story

    @cached_property
    def _first_story(self) -> RunStory:
        return tell(self._run, None)


class ElementStatistics(Background[tuple[ElementRecord, ...]]):
    """Counts over all frames of one run, for each map element."""

    def __init__(self, run: Run, _: Path) -> None:
        super().__init__()
        self._run = run

    def work(self) -> tuple[ElementRecord, ...]:
        return run_elements(self._run, self.watch)


def elements_event(
    run: Run, analysis: RunAnalysis, statistics: ElementStatistics
) -> views_run.ElementsEvent:
    """Return diagnosis and elements, or the progress of the work that is not over."""
    if analysis.value is None:
        return views_run.ElementsEvent(progress=analysis.progress, found=None)
    if statistics.value is None:
        return views_run.ElementsEvent(progress=statistics.progress, found=None)
    findings = findings_view(run, Findings(analysis.value, statistics.value))
    return views_run.ElementsEvent(progress="", found=findings)


class ElementPanel(Panel):
    """Sends the findings of the open run on request."""

    @handles(GetElementsRequest)
    def _get(self, _: GetElementsRequest) -> None:
        run = self.context.run
        for work in (self.context.cached(RunAnalysis), self.context.cached(ElementStatistics)):
            work.start(lambda: self._on_progress(run))

    def _on_progress(self, run: Run) -> None:
        """Called in the background threads; the page may show another run by then."""
        context = self.context
        with context.lock:
            if context.run is run:
                works = context.cached(RunAnalysis), context.cached(ElementStatistics)
                context.send(elements_event(run, *works))

    @handles(FindFramesRequest)
    def _find_frames(self, request: FindFramesRequest) -> None:
        run, element = self.context.run, request.element
        name = run.semantic_map.name_of(element)
        positions = tuple(frames_of(run, element))
        self.context.send(
            views_run.ElementFramesEvent(element=element, name=name, positions=positions)
        )


def frames_of(run: Run, element_id: int) -> list[int]:
    """Return the positions of the frames that detect an element, or whose estimate uses it."""
    table = frame_table(run)
    detecting = table.frame_of_detection()[table.detected_id == element_id]
    using = table.frame_of_pair()[table.pair_id == element_id]
    positions: list[int] = np.union1d(detecting, using).tolist()
    return positions


def findings_view(run: Run, findings: Findings) -> views_run.RunFindings:
    """Return the faults, and a row for each element."""
    diagnosis, camera = findings.diagnosis, findings.diagnosis.calibration
    duplicates = _duplicates(run.semantic_map)
    camera_faults = [] if camera is None else [_camera_fault(run, camera)]
    return views_run.RunFindings(
        compared=diagnosis.frames,
        faults=(
            *(_recurring_fault(run, fault) for fault in diagnosis.causes),
            *camera_faults,
            *(_recurring_fault(run, fault) for fault in diagnosis.elements),
        ),
        rows=tuple(
            _row(run, element, duplicates)
            for element in findings.elements
            if _is_mapped(run, element.id)
        ),
    )


def _is_mapped(run: Run, element_id: int) -> bool:
    return map_row(run.semantic_map, element_id) is not None


def _recurring_fault(run: Run, fault: RunFault) -> views_run.RunFaultView:
    """Return a fault with its element or detection, if it has one, and the middle frame."""
    middle = len(fault.frames) // 2
    known = [id for id in fault.elements if _is_mapped(run, id)]
    return views_run.RunFaultView(
        kind=fault.kind,
        sentence=fault.sentence,
        evidence=_evidence(fault),
        frames=tuple(frame_table(run).index[list(fault.frames)].tolist()),
        element=known[0] if known else None,
        observed=None if known or not fault.rows else fault.rows[middle],
        position=fault.frames[middle],
    )


def _camera_fault(run: Run, fault: Fault) -> views_run.RunFaultView:
    """Return a calibration fault with the frame that has the most pairs."""
    return views_run.RunFaultView(
        kind=fault.kind,
        sentence=fault.sentence,
        evidence=_evidence(fault),
        frames=(),
        element=None,
        observed=None,
        position=int(frame_table(run).pairs.argmax()),
    )


def _evidence(fault: Fault) -> tuple[tuple[str, str], ...]:
    """Return names and values, without the frames, which the page lists separately."""
    return tuple(
        (item.name, evidence_text(item)) for item in fault.evidence if item.name != "frames"
    )


def evidence_text(item: EvidenceItem) -> str:
    """Return the value with its unit, ``0.6 deg per step``; a ratio has a decimal, a count none."""
    decimals = {"m": 2, "%": 1, "deg": 1, "": 1}.get(item.unit.partition(" ")[0], 0)
    if not item.unit and item.value == round(item.value):
        decimals = 0
    return f"{item.value:.{decimals}f} {item.unit}".strip()


def _duplicates(semantic_map: SemanticMap) -> dict[int, tuple[str, float]]:
    """Return name and distance (m) of the nearest element of its class at the position of an
    element, by id, where there is one."""
    elements, duplicates = semantic_map.elements, {}
    for row, others in same_positions(elements).items():
        away_m = np.linalg.norm(elements.anchor_m[others] - elements.anchor_m[row], axis=1)
        nearest = int(elements.id[others[int(away_m.argmin())]])
        duplicates[int(elements.id[row])] = semantic_map.name_of(nearest), float(away_m.min())
    return duplicates


def _row(
    run: Run, element: ElementRecord, duplicates: dict[int, tuple[str, float]]
) -> views_run.ElementRow:
    row = map_row(run.semantic_map, element.id)
    provenance = provenance_of(run.semantic_map, element.id)
    duplicate, duplicate_m = duplicates.get(element.id, ("", None))
    return views_run.ElementRow(
        id=element.id,
        name=run.semantic_map.name_of(element.id),
        class_id=int(run.semantic_map.elements.class_id[row]),
        in_view=len(element.in_view),
        seen=len(element.seen),
        used=len(element.used),
        outlier=len(element.outlier),
        share=number(element.outlier_share),
        median_px=number(element.median_px),
        cost_m=number(element.mean_cost_m),
        blamed=tuple(Counter(element.blamed.values()).most_common()),
        duplicate=duplicate,
        duplicate_m=duplicate_m,
        log_odds=provenance.log_odds if provenance else None,
        existence=provenance.existence if provenance else "",
        position=best_frame(element),
    )


def best_frame(element: ElementRecord) -> int | None:
    """Return the position of the frame that shows an element's fault best.

    That is the frame with the largest outlier, or else the middle frame of those that detect it,
    use it, or have it in view.
    """
    if element.outlier:
        size_px = dict(zip(element.seen, element.residual_px, strict=True))
        return max(element.outlier, key=lambda position: size_px[position])
    positions = element.seen or element.used or element.in_view
    return positions[len(positions) // 2] if positions else None


NEAR_M = 3.0
"""A frame takes the forecast of the nearest position up to this distance."""


class Forecast(Background[Localizability]):
    """Predicts the localizability of one run's route."""

    def __init__(self, run: Run, _: Path) -> None:
        super().__init__()
        self._run = run

    def work(self) -> Localizability:
        run = self._run
        route = localizability.positions((frame.frame for frame in run.frames), run.semantic_map)
        return predict(run.semantic_map, run.info.rig.left, route, _conditions(run), self.watch)

    def view(self) -> ForecastEvent:
        """Return the expected errors by frame, or the progress of the work."""
        forecast = None if self.value is None else _forecast_view(self._run, self.value)
        return ForecastEvent(progress=self.progress, found=forecast)


class ForecastPanel(Panel):
    """Shows the forecast of the open run on request."""

    def on_run(self) -> None:
        self._show()

    def on_theme(self) -> None:
        self._show()

    @handles(ShowForecastRequest)
    def _set_shown(self, request: ShowForecastRequest) -> None:
        context = self.context
        run = context.run
        context.state = context.state.with_forecast(request.shown)
        context.send_state()
        if context.state.forecast:
            self._show()
        else:
            context.scene.show_forecast(None, run, context.state)

    def _show(self) -> None:
        """Send and draw the forecast if it is shown; compute it first if needed."""
        if self.context.state.forecast:
            run = self.context.run
            self.context.cached(Forecast).start(lambda: self._on_progress(run))

    def _on_progress(self, run: Run) -> None:
        """Called in the background thread; the page may show another run by then."""
        context = self.context
        with context.lock:
            if context.run is not run or not context.state.forecast:
                return
            forecast = context.cached(Forecast)
            context.send(forecast.view())
            if forecast.value is not None:
                context.scene.show_forecast(forecast.value, run, context.state)


def _forecast_view(run: Run, predicted: Localizability) -> ForecastView:
    rows = [_nearest(predicted, frame.frame.T_map_camera) for frame in run.frames]
    classes, expected_m = run.semantic_map.classes, predicted.expected_m.tolist()
    suggested = (
        SuggestedElement(
            position=_first_frame(effect, predicted, rows),
            text=f"{localizability.new_element_text(effect, predicted, classes)}: "
            f"{localizability.effect_text(effect)}",
        )
        for effect in predicted.suggested
    )
    return ForecastView(
        limits=LIMITS_M,
        expected_m=tuple(None if row is None else expected_m[row] for row in rows),
        mean_m=float(predicted.expected_m.mean()),
        suggested=tuple(suggested),
    )


def _conditions(run: Run) -> Conditions:
    """Return the run's conditions; its recall is measured unless detections were simulated."""
    options = localizability.options_of(run.info.options)
    stated = localizability.conditions_of(options)
    if options.observations == "simulated":
        return stated
    observations = [
        (frame.frame.T_map_camera, frame.element_id)
        for frame in run.frames
        if frame.frame.T_map_camera is not None
    ]
    return localizability.with_measured_recall(
        stated, run.semantic_map, run.info.rig.left, observations
    )


def _first_frame(effect: Effect, predicted: Localizability, rows: list[int | None]) -> int | None:
    """Return the position of the first frame that a new element improves."""
    along_m = [np.nan if row is None else float(predicted.along_m[row]) for row in rows]
    improved = (
        position
        for position, along in enumerate(along_m)
        if effect.first_m <= along <= effect.last_m
    )
    return next(improved, None)


def _nearest(predicted: Localizability, T_map_camera: Pose | None) -> int | None:
    """Return the row of the route position nearest to a frame; None if it is too far."""
    if T_map_camera is None:
        return None
    centers = np.array([pose.translation for pose in predicted.T_map_camera])
    distance_m = np.linalg.norm(centers - T_map_camera.translation, axis=1)
    row = int(distance_m.argmin())
    return row if distance_m[row] <= NEAR_M else None
