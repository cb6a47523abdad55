"""The selection: its candidate matches and residuals; and the match matrix as CSV.

Candidates include the dustbin and the true correspondence. ``/matrix.csv?run=NAME&position=K``
exports probabilities as recorded, to the last digit.
"""

import threading
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

import numpy as np
from aiohttp import web

from semviz.inspector.context import Panel, RunLibrary
from semviz.inspector.element_card import Origins, element_card, map_row, mapped, origins_view
from semviz.inspector.label_repair import RunLabels
from semviz.inspector.messages import GetOriginsRequest
from semviz.inspector.state import Selection, State
from semviz.inspector.views_frame import MatrixCell, ResidualView, SelectionCard, SelectionEvent
from semviz.runs.diagnosis import detector_of, truth_of
from semviz.runs.run import FrameRecord, Run
from semviz.web.protocol import handles
from semviz_core.base.classes import ClassSet
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import csv_text
from semviz_core.diagnosis.fault import FALSE_POSITIVE, UNKNOWN_ID
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.residuals import INLIER_CHI2, problem_residuals

NOT_MAPPED = "not in the map"
NOT_SEEN = "not seen"
"""Headings of the dustbins in the CSV."""
NOT_DETECTED = "not detected"
MAX_CANDIDATES = 4
MIN_PROBABILITY = 0.0005
"""Less would be shown as 0.000."""


def candidates_of_row(run: Run, record: FrameRecord, row: int) -> tuple[MatrixCell, ...]:
    """Return the likeliest map elements of a detection, with the dustbin and the true element."""
    localization = record.localization
    if localization.match is None:
        return ()
    names = [*element_names(localization, run.semantic_map.classes), NOT_MAPPED]
    ids = [*localization.submap.id.tolist(), None]
    true = np.flatnonzero(localization.submap.id == record.element_id[row]).tolist()
    cells = [Cell(name, row, id) for name, id in zip(names, ids, strict=True)]
    return _candidates(localization.match.probability[row], cells, true)


def candidates_of_column(record: FrameRecord, element_id: int) -> tuple[MatrixCell, ...]:
    """Return the likeliest detections of a map element, with the dustbin and the true detection.

    Empty if the element is outside the submap.
    """
    localization = record.localization
    columns = np.flatnonzero(localization.submap.id == element_id)
    if localization.match is None or not len(columns):
        return ()
    rows = len(localization.observed)
    names = [*(f"#{i}" for i in range(rows)), NOT_DETECTED]
    cells = [Cell(name, i if i < rows else None, element_id) for i, name in enumerate(names)]
    true = np.flatnonzero(record.element_id == element_id).tolist()
    return _candidates(localization.match.probability[:, columns[0]], cells, true)


class Cell(NamedTuple):
    """Row and column of a probability; None for the dustbin."""

    name: str
    observed: int | None
    element: int | None


def _candidates(
    probability: FloatArray, cells: Sequence[Cell], true: list[int]
) -> tuple[MatrixCell, ...]:
    """Return the likeliest cells of a row or column (n + 1), followed by the true ones."""
    order = np.argsort(-probability, kind="stable").tolist()
    rank = {cell: index + 1 for index, cell in enumerate(order)}
    likely = [cell for cell in order[:MAX_CANDIDATES] if probability[cell] >= MIN_PROBABILITY]
    listed = likely + [cell for cell in true if cell not in likely]
    return tuple(
        MatrixCell(
            **cells[cell]._asdict(),
            probability=float(probability[cell]),
            rank=rank[cell],
            is_true=cell in true,
        )
        for cell in listed
    )


def matrix_csv(run: Run, record: FrameRecord) -> str:
    """Return the probabilities as recorded, to the last digit; empty if the frame has none.

    Columns are the elements of the submap, rows the detections; the dustbins come last.
    """
    localization = record.localization
    if localization.match is None:
        return ""
    header = ["seen", *element_names(localization, run.semantic_map.classes), NOT_MAPPED]
    names = [*(f"#{row}" for row in range(len(localization.observed))), NOT_SEEN]
    rows = zip(names, localization.match.probability.tolist(), strict=True)
    return csv_text([header, *([name, *row] for name, row in rows)])


def element_names(localization: Localization, classes: ClassSet) -> list[str]:
    """Return the n names of the submap's elements, for example ``P-04``."""
    submap = localization.submap
    pairs = zip(submap.class_id.tolist(), submap.id.tolist(), strict=True)
    return [classes.element_name(class_id, id) for class_id, id in pairs]


def matrix_route(library: RunLibrary) -> web.AbstractRouteDef:
    """Serve the match matrix of a frame at ``/matrix.csv?run=NAME&position=K``."""

    async def respond(request: web.Request) -> web.Response:
        name, position = request.query.get("run", ""), request.query.get("position", "")
        try:
            run = library.run(name)
            record = run.frames[range(len(run.frames)).index(int(position))]
        except (SemvizError, ValueError):
            raise web.HTTPNotFound(text="no such frame\n") from None
        table = matrix_csv(run, record)
        if not table:
            raise web.HTTPNotFound(text="this frame has no probabilities\n")
        file = f"{Path(name).name}-{record.frame.index}-matrix.csv"
        headers = {"Content-Disposition": f"attachment; filename*=UTF-8''{quote(file)}"}
        return web.Response(text=table, content_type="text/csv", headers=headers)

    return web.get("/matrix.csv", respond)


class SelectionPanel(Panel):
    """Sends the selection whenever it changes, and its labels on request."""

    _sent: Selection | None = None

    def on_frame(self) -> None:
        self._send()

    def on_state(self) -> None:
        if self.context.state.selection != self._sent:
            self._send()

    def _send(self) -> None:
        self._sent = self.context.state.selection
        card = selection_card(self.context.run, self.context.state)
        self.context.send(SelectionEvent(card=card))

    @handles(GetOriginsRequest)
    def _get_origins(self, _: GetOriginsRequest) -> None:
        element = self.context.state.selection.element
        if element is not None:
            args = (self.context.run, self.context.cached(RunLabels).origins, element)
            work = threading.Thread(
                target=self._send_origins, args=args, name="origins", daemon=True
            )
            work.start()

    def _send_origins(self, run: Run, origins: Origins, element: int) -> None:
        """Called in a thread of its own: reading a large label file takes a second."""
        event = origins_view(run, origins, element)
        context = self.context
        with context.lock:
            if context.run is run and context.state.selection.element == element:
                context.send(event)


def selection_card(run: Run, state: State) -> SelectionCard | None:
    """Return all that a run has of the selection; None if nothing is selected."""
    observed, element = state.selection.observed, state.selection.element
    record = run.frames[state.position]
    if state.selection == Selection():
        return None
    card = None if element is None else element_card(run, record, element)
    if card is not None:  # an element's name comes before a detection's
        name, class_id = card.name, card.class_id
    else:
        name, class_id = f"#{observed}", int(record.localization.observed.class_id[observed])
    return SelectionCard(
        observed=observed,
        element=element,
        name=name,
        class_id=class_id,
        summary=(_role(run, record, state.selection), _truth(run, record, state.selection)),
        residuals=_residuals(run, record, state.selection),
        of_row=() if observed is None else candidates_of_row(run, record, observed),
        of_column=() if element is None else candidates_of_column(record, element),
        mapped=card,
    )


def _role(run: Run, record: FrameRecord, selection: Selection) -> str:
    """Return the role of the selection in the estimate, as a sentence."""
    observed, element = selection.observed, selection.element
    localization = record.localization
    if element is not None and element not in localization.submap.id:
        offset_m = mapped(run, element).anchor_m[0] - localization.around_m
        distance_m = np.linalg.norm(offset_m[:2])
        return f"Outside this frame's submap, {distance_m:.0f} m from its camera or prior."
    if localization.refinement is None:
        return "This frame has no pairs."
    i, j = localization.refinement.pairs.T
    of_observed = np.ones(len(i), bool) if observed is None else i == observed
    of_element = np.ones(len(j), bool) if element is None else localization.submap.id[j] == element
    pairs = np.flatnonzero(of_observed & of_element)
    if not len(pairs):
        is_single = observed is None or element is None
        return "Not matched." if is_single else "Not a pair of the estimate."
    is_inlier = localization.refinement.inlier[pairs[0]]
    return "Matched, an inlier." if is_inlier else "Matched, an outlier."


def _truth(run: Run, record: FrameRecord, selection: Selection) -> str:
    """Return the true element of the detection, or the true detection of the element, as a
    sentence; empty if unknown."""
    observed, element = selection.observed, selection.element
    truth = truth_of(run, record)
    if truth is None or truth.element_id is None:
        return ""
    if observed is None:
        rows = np.flatnonzero(truth.element_id == element).tolist()
        return f"Ground truth: detection #{rows[0]}." if rows else "Ground truth: not detected."
    true = int(truth.element_id[observed])
    if true == element:
        return "Correct by ground truth."
    if true == UNKNOWN_ID:
        return f"Ground truth of #{observed}: unknown."
    if true == FALSE_POSITIVE or map_row(run.semantic_map, true) is None:
        text = "a false positive" if true == FALSE_POSITIVE else "not in the map"
        return f"Ground truth: #{observed} is {text}."
    outside = "" if true in record.localization.submap.id else ", outside the submap"
    return f"Ground truth: #{observed} is {run.semantic_map.name_of(true)}{outside}."


def _residuals(run: Run, record: FrameRecord, selection: Selection) -> tuple[ResidualView, ...]:
    """Return the residuals at the estimate and at the true pose, of the selected pair, or of the
    selected detection or element with its true counterpart."""
    pair = _pair(run, record, selection)
    if pair is None:
        return ()
    estimate, truth = record.localization.T_camera_map, record.frame.T_map_camera
    name = f"#{pair[0]} × {run.semantic_map.name_of(pair[1])}"
    at_estimate = ResidualView(pair=name, at="estimate", reason="no pose")
    at_truth = ResidualView(pair=name, at="truth", reason="unknown")
    return (
        at_estimate if estimate is None else _residual(run, record, pair, estimate, at_estimate),
        at_truth if truth is None else _residual(run, record, pair, truth.inverse(), at_truth),
    )


def _pair(run: Run, record: FrameRecord, selection: Selection) -> tuple[int, int] | None:
    """Return row of the detection and id of the element."""
    observed, element = selection.observed, selection.element
    if element is None and observed is not None:
        element = int(record.element_id[observed])
    elif observed is None:
        observed = next(iter(np.flatnonzero(record.element_id == element).tolist()), None)
    if observed is None or element is None or map_row(run.semantic_map, element) is None:
        return None
    return observed, element


def _residual(
    run: Run, record: FrameRecord, pair: tuple[int, int], T_camera_map: Pose, empty: ResidualView
) -> ResidualView:
    """Return ``empty`` with pixels across and along (u and v of signs), chi2 and its limit, or
    with the reason why there is no residual."""
    localization, element = record.localization, mapped(run, pair[1])
    observed = localization.observed[[pair[0]]]
    problem = PoseProblem.of(localization.camera, observed, element, detector_of(run))
    if not problem.compatible[0, 0]:
        return empty.model_copy(update={"reason": "classes differ"})
    fit = problem_residuals(problem, T_camera_map, np.zeros((1, 2), dtype=np.int64))
    if not np.isfinite(fit.chi2[0]):
        return empty.model_copy(update={"reason": "not in front of the camera"})
    across, along = fit.residual_px[0].tolist()
    return ResidualView(
        pair=empty.pair,
        at=empty.at,
        px=float(np.sqrt(np.nansum(fit.residual_px[0] ** 2))),
        across_px=across,
        along_px=along if np.isfinite(along) else None,
        chi2=float(fit.chi2[0]),
        limit=float(INLIER_CHI2[fit.rows[0]]),
        fits=bool(fit.inlier[0]),
    )
