"""Solve a frame, or all affected frames, with changes; suggest the best change.

Pages and files exchange sets of changes as JSON. A frame of a tracked run is solved without its
history, and compared with that result. A sweep counts fixed and broken frames and can be saved as
a new run.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from threading import Lock
from time import perf_counter
from typing import Any

import numpy as np

from semviz.runs.comparison import FrameChange, frame_change
from semviz.runs.metrics import Errors, errors_of
from semviz.runs.run import FrameRecord, Run
from semviz.runs.writer import write_run
from semviz.what_if import request_changes
from semviz.what_if.change import (
    CropRadius,
    FrameRequest,
    MovePrior,
    PriorAtTruth,
    PriorSigma,
    RaisePrior,
    WhatIfChange,
    WithoutPriorPart,
)
from semviz.what_if.request_changes import StartAtTruth
from semviz_core.base.localization import Localization, Refinement
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.diagnosis.fault import Fault, FaultKind, FrameDiagnosis
from semviz_core.localization.localizer import known_methods
from semviz_core.localization.matched import Estimate, Failure, localize_matches
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.residuals import problem_residuals

KINDS: dict[str, type[WhatIfChange]] = {
    "drop element": request_changes.DropElement,
    "add element": request_changes.AddElement,
    "element class": request_changes.ChangeElementClass,
    "drop detection": request_changes.DropDetection,
    "detection class": request_changes.DetectionClass,
    "least score": request_changes.LeastScore,
    "noise": request_changes.NoiseFactor,
    "ignore classes": request_changes.IgnoreClasses,
    "force pair": request_changes.ForcePair,
    "forbid pair": request_changes.ForbidPair,
    "true pairs": request_changes.ForceTruePairs,
    "move prior": MovePrior,
    "prior at truth": PriorAtTruth,
    "prior sigma": PriorSigma,
    "crop radius": CropRadius,
    "without prior part": WithoutPriorPart,
    "raise prior": RaisePrior,
    "method": request_changes.UseMethod,
    "start at truth": request_changes.StartAtTruth,
}
_WARM: set[str] = set()
"""Methods that have solved a frame in this process."""
_NAMES = {kind: name for name, kind in KINDS.items()}


def to_json(change: WhatIfChange) -> dict[str, Any]:
    """Return ``{"change": NAME, ...}`` with the fields of the change."""
    return {"change": _NAMES[type(change)], **asdict(change)}


def from_json(value: object) -> WhatIfChange:
    """Return the change that ``to_json`` encoded. Raise SemvizError for anything else."""
    values = dict(value) if isinstance(value, dict) else {}
    name = str(values.pop("change", None))
    if name not in KINDS:
        raise SemvizError(f"there is no change '{name}'; there are {', '.join(KINDS)}")
    kind = KINDS[name]
    if values.keys() != {field.name for field in fields(kind)}:
        needed = ", ".join(field.name for field in fields(kind)) or "no fields"
        raise SemvizError(f"change '{name}' needs {needed}, but has {', '.join(values) or 'none'}")
    return kind(
        **{field.name: _value(field.name, field.type, values[field.name]) for field in fields(kind)}
    )


def changes_text(changes: Iterable[WhatIfChange]) -> str:
    """Return the text of a JSON file of changes."""
    return json.dumps({"changes": [to_json(change) for change in changes]}, indent=1) + "\n"


def describe_changes(changes: Sequence[WhatIfChange], semantic_map: SemanticMap) -> str:
    """Return the changes in words, joined by commas and 'and'; empty without changes."""
    *most, last = [change.describe(semantic_map) for change in changes] or [""]
    return f"{', '.join(most)} and {last}" if most else last


def _value(name: str, kind: object, value: object) -> object:
    """Return the value of a field. Raise SemvizError if it is not of type ``kind``."""
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    if type(value) is kind:
        return value
    raise SemvizError(f"change: {name} is {value!r}; give a value of another type")


def solve_recorded_matches(request: FrameRequest) -> Localization:
    """Solve a request from its recorded matches, by the method that ``matched`` names."""
    assert request.matched is not None
    camera = request.record.localization.camera
    pairs, score = recorded_matches(request)
    start = perf_counter()
    result = localize_matches(
        request.observed, request.submap, camera, pairs, score,
        prior=request.prior, method=request.matched, seed=request.localizer.seed,
        detector=request.localizer.detector,
    )  # fmt: skip
    time_ms = {"matched": (perf_counter() - start) * 1e3}
    failed = Localization(
        request.matched, camera, request.prior, request.observed, request.submap,
        status="cannot", reason="", T_camera_map=None, covariance=None, time_ms=time_ms,
    )  # fmt: skip
    if isinstance(result, Failure):
        return replace(failed, reason=result.reason)
    refinement = _refinement(request, result)
    if violation := request_changes.pair_constraints(request).violated(refinement, request.submap):
        return replace(failed, reason=violation, refinement=refinement)
    return replace(
        failed,
        status="ok",
        reason=f"{int(result.inlier.sum())} of {len(pairs)} matches agree on one pose.",
        T_camera_map=result.T_camera_map,
        covariance=result.covariance,
        refinement=refinement,
    )


def recorded_matches(request: FrameRequest) -> tuple[IntArray, FloatArray]:
    """Return (k, 2) rows (observed, submap) and their probabilities (k,).

    Forced pairs are added with probability 1, forbidden ones removed. Raise SemvizError if no
    matches were recorded.
    """
    recorded = request.record.localization
    if recorded.match is None:
        raise SemvizError("this frame has no recorded matches; choose another method")
    observed = {row: i for i, row in enumerate(request.row.tolist())}
    mapped = {element: j for j, element in enumerate(request.submap.id.tolist())}
    score: dict[tuple[int, int], float] = {}
    for row, column in recorded.match.order.tolist():
        i, j = observed.get(row), mapped.get(int(recorded.submap.id[column]))
        if i is not None and j is not None and _same_class(request, i, j):
            score[i, j] = float(recorded.match.probability[row, column])
    constraints = request_changes.pair_constraints(request)
    for i, j in constraints.forced.tolist():
        score = {pair: p for pair, p in score.items() if pair[0] != i and pair[1] != j}
        score[i, j] = 1.0
    for i, j in constraints.forbidden.tolist():
        score.pop((i, j), None)
    return np.array(list(score), dtype=np.int64).reshape(-1, 2), np.array(list(score.values()))


def _same_class(request: FrameRequest, i: int, j: int) -> bool:
    return bool(request.observed.class_id[i] == request.submap.class_id[j])


def _refinement(request: FrameRequest, estimate: Estimate) -> Refinement:
    """Return the residuals of the method's inliers under its pose."""
    camera, detector = request.record.localization.camera, request.localizer.detector
    problem = PoseProblem.of(camera, request.observed, request.submap, detector)
    pairs = estimate.pairs[estimate.inlier]
    residuals = problem_residuals(problem, estimate.T_camera_map, pairs)
    inlier, cost = np.ones(len(pairs), dtype=bool), np.array([residuals.chi2.sum()])
    return Refinement(pairs, residuals.residual_px, residuals.chi2, inlier, cost)


def solve_with_changes(
    run: Run, record: FrameRecord, changes: Sequence[WhatIfChange] = ()
) -> FrameRecord:
    """Return the frame with its new localization.

    Raise SemvizError if changes contradict each other, or name an element or detection that the
    frame does not have.
    """
    request = FrameRequest.of(run, record)
    request = replace(request, semantic_map=changed_map(run.semantic_map, changes))
    for change in sorted(changes, key=lambda change: change.stage):
        if change.affects(request):
            request = change.applied(request)
    solve = _localize if request.matched is None else solve_recorded_matches
    if request.method not in _WARM:  # the first solution compiles or loads, which is no time of it
        solve(request)
        _WARM.add(request.method)
    return replace(record, localization=solve(request), element_id=request.element_id)


def _localize(request: FrameRequest) -> Localization:
    return request.localizer.localize(
        request.observed,
        request.submap,
        request.record.localization.camera,
        request.prior,
        pairing=request_changes.pair_constraints(request),
        start=request.start,
    )


def localize_request(run: Run, record: FrameRecord) -> FrameRecord:
    """Return the result that changes are compared with: the recorded one, or, for a tracked run,
    that of the frame without its history."""
    return record if run.info.method in known_methods() else solve_with_changes(run, record)


def changed_map(semantic_map: SemanticMap, changes: Sequence[WhatIfChange]) -> SemanticMap:
    """Return the whole map with the changes to it; the same object if there are none."""
    elements = semantic_map.elements
    for change in changes:
        elements = change.applied_to_map(elements)
    if elements is semantic_map.elements:
        return semantic_map
    kept = np.flatnonzero(np.isin(semantic_map.elements.id, elements.id))
    provenance = semantic_map.provenance
    provenance = tuple(provenance[row] for row in kept) if provenance else ()
    return replace(semantic_map, elements=elements, provenance=provenance)


SAME_M = 1e-3
"""Poses whose errors differ by less count as unchanged."""


@dataclass(frozen=True, eq=False)
class SweepResult:
    """A frame solved with changes."""

    record: FrameRecord
    change: FrameChange
    """The difference from the result without changes."""


def has_effect(run: Run, record: FrameRecord, changes: Sequence[WhatIfChange]) -> bool:
    """Whether any of the changes affects a frame."""
    request = FrameRequest.of(run, record)
    return any(change.affects(request) for change in changes)


def affected_frames(run: Run, changes: Sequence[WhatIfChange]) -> tuple[FrameRecord, ...]:
    """Return the frames that the changes affect."""
    return tuple(record for record in run.frames if has_effect(run, record, changes))


def sweep(run: Run, record: FrameRecord, changes: Sequence[WhatIfChange]) -> SweepResult:
    """Solve a frame with changes and compare it with the result without them."""
    after = solve_with_changes(run, record, changes)
    return SweepResult(after, frame_change(localize_request(run, record), after))


def describe_sweep(frames: Sequence[FrameChange]) -> str:
    """Summarize a sweep, for example ``9 of 47 frames change: median 0.31 m → 0.06 m, ok 5 → 8,
    3 fixed, 0 broken.``"""
    changed = [frame for frame in frames if _differs(frame)]
    if not changed:
        return f"No result changes in {_frame_count(len(frames))}."
    counts = [sum(frame.change == kind for frame in changed) for kind in ("fixed", "broken")]
    ok = [sum(frame.status[side] == "ok" for frame in changed) for side in (0, 1)]
    medians = [_median([frame.errors[side] for frame in changed]) for side in (0, 1)]
    parts = [f"ok {ok[0]} → {ok[1]}", f"{counts[0]} fixed", f"{counts[1]} broken"]
    if any(medians):
        parts.insert(0, f"median {medians[0] or 'none'} → {medians[1] or 'none'}")
    return f"{len(changed)} of {_frame_count(len(frames))} change: {', '.join(parts)}."


_given: set[Path] = set()
"""Paths that ``free_path`` returned: two pages may save at the same time."""
_giving = Lock()


def free_path(path: Path, suffix: str) -> Path:
    """Return an unused path beside a run, for example ``drive-tried-1.rrd``, to one caller only."""
    number = 1
    with _giving:
        while (free := path.with_name(f"{path.stem}-{suffix}-{number}.rrd")) in _given or (
            free.exists()
        ):
            number += 1
        _given.add(free)
    return free


def save(
    run: Run, changes: Sequence[WhatIfChange], changed: Mapping[int, FrameRecord], path: Path
) -> None:
    """Write a new run: the frames ``changed``, by number, and all others as recorded.

    Raise SemvizError if ``path`` cannot be written.
    """
    info = replace(
        run.info,
        name=path.stem,
        version=version("semviz"),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        options={**run.info.options, "changes": [to_json(change) for change in changes]},
    )
    records = (changed.get(record.frame.index, record) for record in run.frames)
    write_run(records, path, info, changed_map(run.semantic_map, changes))


def _differs(frame: FrameChange) -> bool:
    before, after = frame.errors
    if before is None or after is None:
        return frame.status[0] != frame.status[1]
    return frame.status[0] != frame.status[1] or abs(after.distance_m - before.distance_m) > SAME_M


def _frame_count(frames: int) -> str:
    return "1 frame" if frames == 1 else f"{frames} frames"


def _median(errors: Iterable[Errors | None]) -> str:
    """Return the median over the frames with an error, as text; empty without any."""
    known = [error.distance_m for error in errors if error is not None]
    return f"{np.median(known):.2f} m" if known else ""


MAX_CANDIDATES = 12
"""Solving a frame takes 2 to 30 ms."""
RADIUS_FACTOR = 2.0
DETECTION_FAULTS: tuple[FaultKind, ...] = (
    "false detection", "false or not mapped", "missing in the map",
)  # fmt: skip
TOO_FEW: tuple[FaultKind, ...] = ("too few elements", "missed detection")
"""No change helps."""
MAP_FAULTS: tuple[FaultKind, ...] = ("moved in the map", "twice in the map")
PRIOR_FAULTS: tuple[FaultKind, ...] = (
    "wrong heading prior", "wrong gravity prior", "wrong height prior", "wrong position prior",
)  # fmt: skip
SEARCH_FAULTS: tuple[FaultKind, ...] = (
    "wrong matches", "search miss", "refinement diverged", "ambiguous geometry", "unexplained",
)  # fmt: skip


def best_suggestion(
    run: Run, record: FrameRecord, diagnosis: FrameDiagnosis
) -> WhatIfChange | None:
    """Return the change with the best result of all that the diagnosis suggests; None without any.

    The best has the smallest error, or, without ground truth, the best status. Suggestions for the
    main fault come before those for secondary faults.
    """
    request = FrameRequest.of(run, record)
    main = diagnosis.fault
    secondary = () if diagnosis.kind in TOO_FEW else diagnosis.secondary_faults
    faults = (main, *(fault for fault in secondary if fault is not main))
    suggested = (change for fault in faults for change in _suggestions(request, fault))
    candidates = list(dict.fromkeys(change for change in suggested if change.affects(request)))
    return min(
        candidates[:MAX_CANDIDATES], key=lambda change: _cost(run, record, change), default=None
    )


def _suggestions(request: FrameRequest, fault: Fault) -> Iterator[WhatIfChange]:
    frame = request.record.frame.index
    if fault.kind in MAP_FAULTS:
        yield from map(request_changes.DropElement, fault.elements)
    elif fault.kind in DETECTION_FAULTS:
        yield from (request_changes.DropDetection(frame, row) for row in fault.rows)
    elif fault.kind == "wrong class":
        yield from _other_class(request, fault.rows, fault.elements)
    elif fault.kind in PRIOR_FAULTS:
        yield from _other_prior(fault)
    elif fault.kind == "wrong detection sigma":
        yield request_changes.NoiseFactor(round(fault.evidence[0].value, 1))
    elif fault.kind == "not in the submap":
        yield PriorAtTruth()
        yield CropRadius(RADIUS_FACTOR * request.radius_m)
    elif fault.kind in SEARCH_FAULTS:
        yield request_changes.ForceTruePairs()
        yield StartAtTruth()


def _other_prior(fault: Fault) -> Iterator[WhatIfChange]:
    """Yield the changes that leave out, or correct, the part of the prior that is wrong."""
    off = fault.evidence[0].value
    if fault.kind == "wrong heading prior":
        yield WithoutPriorPart("heading")
    elif fault.kind == "wrong gravity prior":
        yield WithoutPriorPart("gravity")
    elif fault.kind == "wrong height prior":
        yield from (RaisePrior(round(up_m, 2)) for up_m in (off, -off))
    else:
        yield PriorAtTruth()
        yield PriorSigma(round(off, 1))


def _other_class(
    request: FrameRequest, rows: Sequence[int], elements: Sequence[int]
) -> Iterator[WhatIfChange]:
    """Yield the detection with the element's class, and the element with the detection's."""
    for row, element in zip(rows, elements, strict=False):
        mapped = request.semantic_map.elements
        for class_id in mapped.class_id[mapped.id == element].tolist():
            yield request_changes.DetectionClass(request.record.frame.index, row, class_id)
        yield request_changes.ChangeElementClass(element, int(request.observed.class_id[row]))


def _cost(run: Run, record: FrameRecord, change: WhatIfChange) -> tuple[float, float]:
    """Return error (m, to a centimetre) and status rank after a change; smaller is better."""
    try:
        after = solve_with_changes(run, record, (change,))
    except SemvizError:
        return np.inf, np.inf
    errors = errors_of(after)
    status = ("ok", "ambiguous", "cannot").index(after.localization.status)
    if errors is None:
        return (np.inf if record.frame.T_map_camera is not None else 0.0), status
    return round(errors.distance_m, 2), status
