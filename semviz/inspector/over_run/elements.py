"""What the run says of its map and camera, and each map element over the run."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from semviz.inspector.background import Background
from semviz.inspector.selection.origins import map_row
from semviz.inspector.session import matched_elements
from semviz.inspector.topic import Topic, Verbs, whole
from semviz.inspector.views import number
from semviz.recording.run import Run
from semviz.run_verdict import run_elements, run_verdict
from semviz.web.sessions import Message
from semviz_core.errors import SemvizError
from semviz_core.explaining.per_element import ElementRecord
from semviz_core.explaining.run_verdict import RunFault, RunVerdict
from semviz_core.explaining.told import Evidence, Fault

Json = dict[str, Any]


@dataclass(frozen=True)
class Findings:
    """All that is told of a run as a whole."""

    verdict: RunVerdict
    elements: tuple[ElementRecord, ...]


class OverTheRun(Background[Findings]):
    """One run's findings."""

    def __init__(self, run: Run, _: Path) -> None:
        super().__init__()
        self._run = run

    def work(self) -> Findings:
        verdict = run_verdict(self._run, self.watch)
        return Findings(verdict, run_elements(self._run, self.watch))

    def view(self) -> Json:
        """What the page shows, or how far the work has come."""
        if self.value is None:
            return {"ready": False, "doing": self.doing}
        return {"ready": True, **findings_view(self._run, self.value)}


class ElementTopic(Topic):
    """Tells what is found over the run where the page asks for it."""

    def verbs(self) -> Verbs:
        return {"elements": self._elements, "frames of": self._frames_of}

    def _elements(self, _: Message) -> None:
        run = self.desk.run
        self.desk.kept(OverTheRun).ask(lambda: self._got_on(run))

    def _got_on(self, run: Run) -> None:
        """Called in the thread of the work; the page may show another run by then."""
        with self.desk.lock:
            if self.desk.run is run:
                self.desk.say("elements", self.desk.kept(OverTheRun).view())

    def _frames_of(self, message: Message) -> None:
        """Positions of the frames that see an element, or whose answer rests on it."""
        run, element = self.desk.run, whole(message, "element")
        if element is None:
            raise SemvizError("frames are asked for by an element's number")
        found = {
            "element": element,
            "name": run.semantic_map.name_of(element),
            "positions": frames_of(run, element),
        }
        self.desk.say("framesOf", found)


def frames_of(run: Run, element_id: int) -> list[int]:
    """Positions of frames with a detection that is an element, or is taken for it by the answer."""
    return [
        position
        for position, one in enumerate(run.frames)
        if np.any(one.element_id == element_id)
        or element_id in matched_elements(run, position).values()
    ]


def findings_view(run: Run, found: Findings) -> Json:
    """The verdict's lines, and a row for each element."""
    verdict, camera = found.verdict, found.verdict.calibration
    lines = [] if camera is None else [_camera_line(run, camera)]
    return {
        "compared": verdict.frames,
        "verdict": lines + [_line(run, one) for one in verdict.elements],
        "rows": [_row(run, one) for one in found.elements if _is_mapped(run, one.id)],
    }


def _is_mapped(run: Run, element_id: int) -> bool:
    return map_row(run.semantic_map, element_id) is not None


def _line(run: Run, fault: RunFault) -> Json:
    """With the sight to show: that of the frame in the middle."""
    middle = len(fault.frames) // 2
    known = [id for id in fault.elements if _is_mapped(run, id)]
    return {
        **_told(fault),
        "frames": [run.frames[position].frame.index for position in fault.frames],
        "element": known[0] if known else None,
        "observed": None if known else fault.rows[middle],
        "position": fault.frames[middle],
    }


def _camera_line(run: Run, fault: Fault) -> Json:
    """Seen best where most pairs are."""
    pairs = [
        0 if one.refinement is None else len(one.refinement.pairs) for one in run.localizations
    ]
    most = pairs.index(max(pairs))
    return {**_told(fault), "frames": [], "element": None, "observed": None, "position": most}


def _told(fault: Fault) -> Json:
    return {
        "kind": fault.kind,
        "sentence": fault.sentence,
        "evidence": [
            [one.name, evidence_text(one)] for one in fault.evidence if one.name != "frames"
        ],
    }


def evidence_text(one: Evidence) -> str:
    """Its value with the unit."""
    decimals = {"m": 2, "%": 1, "deg": 1}.get(one.unit, 0)
    return f"{one.value:.{decimals}f} {one.unit}".strip()


def _row(run: Run, one: ElementRecord) -> Json:
    row = map_row(run.semantic_map, one.id)
    return {
        "id": one.id,
        "name": run.semantic_map.name_of(one.id),
        "class": int(run.semantic_map.elements.class_id[row]),
        "inView": len(one.in_view),
        "seen": one.seen,
        "used": one.used,
        "outlier": one.outlier,
        "share": number(one.outlier_share),
        "medianPx": number(one.median_px),
        "costM": number(one.mean_cost_m),
        "position": best_sight(one),
    }


def best_sight(one: ElementRecord) -> int | None:
    """The frame that shows best what is wrong with an element: where it is furthest off; or else
    the middle one of those that see it, rest on it, or should see it."""
    if one.outlier:
        size_px = dict(zip(one.seen, one.residual_px, strict=True))
        return max(one.outlier, key=lambda position: size_px[position])
    there = one.seen or one.used or one.in_view
    return there[len(there) // 2] if there else None
