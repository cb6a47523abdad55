"""Run-wide findings: the diagnosis of the run, and each map element over its frames."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semviz.inspector import views_run
from semviz.inspector.context import Background, Panel
from semviz.inspector.element_card import map_row, provenance_of
from semviz.inspector.messages import FindFramesRequest, GetElementsRequest
from semviz.inspector.state import matched_elements
from semviz.inspector.views import number
from semviz.runs.diagnosis import run_diagnosis, run_elements
from semviz.runs.run import Run
from semviz.web.protocol import handles
from semviz_core.diagnosis.element_statistics import ElementRecord
from semviz_core.diagnosis.fault import EvidenceItem, Fault
from semviz_core.diagnosis.run import RunDiagnosis, RunFault


@dataclass(frozen=True)
class Findings:
    """The diagnosis of a run, and the statistics of its map elements."""

    diagnosis: RunDiagnosis
    elements: tuple[ElementRecord, ...]


class RunAnalysis(Background[Findings]):
    """Computes the findings of one run."""

    def __init__(self, run: Run, _: Path) -> None:
        super().__init__()
        self._run = run

    def work(self) -> Findings:
        diagnosis = run_diagnosis(self._run, self.watch)
        return Findings(diagnosis, run_elements(self._run, self.watch))

    def view(self) -> views_run.ElementsEvent:
        """Return the findings, or the progress of the work."""
        findings = None if self.value is None else findings_view(self._run, self.value)
        return views_run.ElementsEvent(progress=self.progress, found=findings)


class ElementPanel(Panel):
    """Sends the findings of the open run on request."""

    @handles(GetElementsRequest)
    def _get(self, _: GetElementsRequest) -> None:
        run = self.context.run
        self.context.cached(RunAnalysis).start(lambda: self._on_progress(run))

    def _on_progress(self, run: Run) -> None:
        """Called in the background thread; the page may show another run by then."""
        with self.context.lock:
            if self.context.run is run:
                self.context.send(self.context.cached(RunAnalysis).view())

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
    return [
        position
        for position, record in enumerate(run.frames)
        if np.any(record.element_id == element_id)
        or element_id in matched_elements(run, position).values()
    ]


def findings_view(run: Run, findings: Findings) -> views_run.RunFindings:
    """Return the faults, and a row for each element."""
    diagnosis, camera = findings.diagnosis, findings.diagnosis.calibration
    camera_faults = [] if camera is None else [_camera_fault(run, camera)]
    return views_run.RunFindings(
        compared=diagnosis.frames,
        faults=(*camera_faults, *(_map_fault(run, fault) for fault in diagnosis.elements)),
        rows=tuple(
            _row(run, element) for element in findings.elements if _is_mapped(run, element.id)
        ),
    )


def _is_mapped(run: Run, element_id: int) -> bool:
    return map_row(run.semantic_map, element_id) is not None


def _map_fault(run: Run, fault: RunFault) -> views_run.RunFaultView:
    """Return a fault with its element, or else its detection in the middle frame."""
    middle = len(fault.frames) // 2
    known = [id for id in fault.elements if _is_mapped(run, id)]
    return views_run.RunFaultView(
        kind=fault.kind,
        sentence=fault.sentence,
        evidence=_evidence(fault),
        frames=tuple(run.frames[position].frame.index for position in fault.frames),
        element=known[0] if known else None,
        observed=None if known else fault.rows[middle],
        position=fault.frames[middle],
    )


def _camera_fault(run: Run, fault: Fault) -> views_run.RunFaultView:
    """Return a calibration fault with the frame that has the most pairs."""
    pairs = [
        0 if localization.refinement is None else len(localization.refinement.pairs)
        for localization in run.localizations
    ]
    return views_run.RunFaultView(
        kind=fault.kind,
        sentence=fault.sentence,
        evidence=_evidence(fault),
        frames=(),
        element=None,
        observed=None,
        position=pairs.index(max(pairs)),
    )


def _evidence(fault: Fault) -> tuple[tuple[str, str], ...]:
    """Return names and values, without the frames, which the page lists separately."""
    return tuple(
        (item.name, evidence_text(item)) for item in fault.evidence if item.name != "frames"
    )


def evidence_text(item: EvidenceItem) -> str:
    """Return the value with its unit."""
    decimals = {"m": 2, "%": 1, "deg": 1}.get(item.unit, 0)
    return f"{item.value:.{decimals}f} {item.unit}".strip()


def _row(run: Run, element: ElementRecord) -> views_run.ElementRow:
    row = map_row(run.semantic_map, element.id)
    provenance = provenance_of(run.semantic_map, element.id)
    return views_run.ElementRow(
        id=element.id,
        name=run.semantic_map.name_of(element.id),
        class_id=int(run.semantic_map.elements.class_id[row]),
        in_view=len(element.in_view),
        seen=tuple(element.seen),
        used=tuple(element.used),
        outlier=tuple(element.outlier),
        share=number(element.outlier_share),
        median_px=number(element.median_px),
        cost_m=number(element.mean_cost_m),
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
