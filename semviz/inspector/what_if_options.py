"""The changes that fit the selection, as options of the page; and results before and after."""

from collections.abc import Iterator
from typing import Literal

import numpy as np

from semviz.inspector.state import State
from semviz.inspector.views import Ends, place
from semviz.runs.images import project_elements
from semviz.runs.metrics import errors_of
from semviz.runs.run import FrameRecord, Run
from semviz.web.protocol import Event, Part
from semviz.what_if import change, request_changes
from semviz.what_if.change import FrameRequest, WhatIfChange, map_element_name
from semviz.what_if.solve import has_effect, localize_request, to_json
from semviz_core.base.classes import ClassSet
from semviz_core.base.localization import Status
from semviz_core.localization import matched
from semviz_core.localization.localizer import available_methods

ChangeValues = dict[str, int | float | str]
"""A change as in files of changes: its kind under ``change``, and its fields by name."""


class OptionValue(Part):
    """A value to choose for a field of a change."""

    value: int | str
    text: str


class ChoiceField(Part):
    """The field ``name`` of a change, as a list to choose from."""

    name: str
    options: tuple[OptionValue, ...]


class NumberField(Part):
    """The field ``name`` of a change, as a number to enter."""

    name: str
    label: str
    value: float
    unit: str


class WhatIfOption(Part):
    """A change: a button, a choice, or numbers to enter."""

    text: str
    change: ChangeValues
    choice: ChoiceField | None = None
    fields: tuple[NumberField, ...] = ()


class WhatIfGroup(Part):
    """Changes of one subject, for example the selected element."""

    title: str
    options: tuple[WhatIfOption, ...]


class WhatIfOptionsEvent(Event):
    """The changes that fit the selection and the frame."""

    type: Literal["what_if_options"] = "what_if_options"
    groups: tuple[WhatIfGroup, ...]


class SolutionView(Part):
    """A result of the solver; errors are null without a pose or ground truth."""

    status: Status
    error_m: float | None
    error_deg: float | None
    inliers: int
    detections: int


class MappedElement(Part):
    """An element of the submap in the image under the new pose."""

    class_id: int
    place: Ends


class WhatIfResult(Part):
    """A frame before and after the changes."""

    position: int
    has_effect: bool
    """Whether the changes affect this frame."""
    before: SolutionView
    after: SolutionView
    reason: str
    ms: float
    mapped: tuple[MappedElement, ...]


class SuggestionEvent(Event):
    """The change most likely to explain the failure of a frame, and its result."""

    type: Literal["suggestion"] = "suggestion"
    position: int
    text: str
    before: SolutionView
    after: SolutionView


class SuggestionStatusEvent(Event):
    """Why no suggestion was solved; empty where one was."""

    type: Literal["suggestion_status"] = "suggestion_status"
    text: str


class ChangedFrame(Part):
    """A frame that a sweep fixed or broke."""

    index: int
    change: Literal["fixed", "broken"]


class SweepView(Part):
    """Progress of a sweep, or its result."""

    is_over: bool
    can_save: bool
    text: str
    changed: tuple[ChangedFrame, ...]


class WhatIfEvent(Event):
    """The pending change, the kept changes, and their result."""

    type: Literal["what_if"] = "what_if"
    change: str
    """The pending change in words; empty without one."""
    kept: tuple[str, ...]
    file: str
    """The kept changes as a JSON file."""
    solving: bool
    failure: str
    """Why the frame could not be solved."""
    result: WhatIfResult | None
    sweep: SweepView | None
    saved: str
    """Where the sweep was saved, in words."""


def result_view(
    run: Run, position: int, after: FrameRecord, changes: tuple[WhatIfChange, ...]
) -> WhatIfResult:
    """Return a frame before and after, and the map projected with the new pose."""
    record = run.frames[position]
    return WhatIfResult(
        position=position,
        has_effect=has_effect(run, record, changes),
        before=answer_view(localize_request(run, record)),
        after=answer_view(after),
        reason=after.localization.reason,
        ms=sum(after.localization.time_ms.values()),
        mapped=_mapped(after),
    )


def answer_view(record: FrameRecord) -> SolutionView:
    """Return status, errors and inliers of a result."""
    localization, errors = record.localization, errors_of(record)
    refinement = localization.refinement
    return SolutionView(
        status=localization.status,
        error_m=None if errors is None else errors.distance_m,
        error_deg=None if errors is None else errors.angle_deg,
        inliers=0 if refinement is None else int(refinement.inlier.sum()),
        detections=len(localization.observed),
    )


def _mapped(record: FrameRecord) -> tuple[MappedElement, ...]:
    """Return the elements of the submap that the estimated pose projects into the image."""
    localization = record.localization
    if localization.T_camera_map is None:
        return ()
    submap = localization.submap
    projected = project_elements(submap, localization.T_camera_map, localization.camera)
    elements = [(int(id), place(projected, row)) for row, id in enumerate(submap.class_id)]
    return tuple(
        MappedElement(class_id=class_id, place=ends)
        for class_id, ends in elements
        if ends is not None
    )


_PRIOR = "Prior and submap"
_NO_PRIOR = f"{_PRIOR} (fix assumed)"


def what_if_options(run: Run, state: State) -> tuple[WhatIfGroup, ...]:
    """Return the changes to the selection, then those that need no selection."""
    record = run.frames[state.position]
    request = FrameRequest.of(run, record)
    groups = [
        *_selected_element(run, request, state.selection.element),
        *_selected_detection(run, request, state.selection.observed, state.selection.element),
        (_PRIOR if record.localization.prior else _NO_PRIOR, list(_prior_and_submap(request))),
        ("Detections", list(_detections(request))),
        ("Solver", list(_solver(request))),
    ]
    return tuple(
        WhatIfGroup(title=title, options=tuple(options)) for title, options in groups if options
    )


def _selected_element(
    run: Run, request: FrameRequest, element: int | None
) -> Iterator[tuple[str, list[WhatIfOption]]]:
    elements = request.semantic_map.elements
    rows = np.flatnonzero(elements.id == element)
    if element is None or not len(rows):
        return
    drop, add = request_changes.DropElement(element), request_changes.AddElement(element)
    rename = request_changes.ChangeElementClass(element, int(elements.class_id[rows[0]]))
    options = [_button("Remove from the map", drop)] if drop.affects(request) else []
    if add.affects(request):
        options.append(_button("Add to the submap", add))
    if drop.affects(request):
        options.extend(_class_choice(run.semantic_map.classes, rename))
    yield map_element_name(run.semantic_map, element), options


def _selected_detection(
    run: Run, request: FrameRequest, row: int | None, element: int | None
) -> Iterator[tuple[str, list[WhatIfOption]]]:
    """Yield changes to the detection, and its pairs with the selected and the true element."""
    if row is None:
        return
    frame, semantic_map = request.record.frame.index, run.semantic_map
    options = [_button("Remove", request_changes.DropDetection(frame, row))]
    if element is not None and element in request.submap.id:
        name = map_element_name(semantic_map, element)
        options.append(_button(f"Is {name}", request_changes.ForcePair(frame, row, element)))
        options.append(_button(f"Is not {name}", request_changes.ForbidPair(frame, row, element)))
    true = int(request.element_id[row])
    if true != element and true in request.submap.id:
        text = f"Is {map_element_name(semantic_map, true)} (ground truth)"
        options.append(_button(text, request_changes.ForcePair(frame, row, true)))
    rename = request_changes.DetectionClass(frame, row, int(request.observed.class_id[row]))
    yield f"Detection #{row}", [*options, *_class_choice(semantic_map.classes, rename)]


def _prior_and_submap(request: FrameRequest) -> Iterator[WhatIfOption]:
    prior, radius_m = request.prior, request.radius_m
    if request.truth is not None:
        yield _button("Prior at the true pose", change.PriorAtTruth())
    if request.reference_pose is not None:
        yield _fields(
            "Move the prior",
            change.MovePrior(0.0, 0.0),
            ("ahead_m", "ahead"),
            ("left_m", "left"),
        )
    yield _fields(
        "Prior sigma",
        change.PriorSigma(round(prior.horizontal_sigma_m, 1)),
        ("sigma_m", ""),
    )
    for part in change.LEFT_OUT:
        without = change.WithoutPriorPart(part)
        if without.affects(request):
            yield _button(f"Without the {part} prior", without)
    yield _fields("Raise the prior", change.RaisePrior(0.0), ("up_m", "up"))
    yield _fields("Submap radius", change.CropRadius(round(radius_m, 1)), ("radius_m", ""))


def _detections(request: FrameRequest) -> Iterator[WhatIfOption]:
    if request_changes.ForceTruePairs().affects(request):
        yield _button("Use the true pairs", request_changes.ForceTruePairs())
    yield _button("Ignore classes", request_changes.IgnoreClasses())
    yield _fields("Noise factor", request_changes.NoiseFactor(2.0), ("factor", ""))
    if np.ptp(request.observed.score) > 0.0:
        middle = round(float(np.median(request.observed.score)), 2)
        yield _fields("Minimum score", request_changes.LeastScore(middle), ("score", ""))


def _solver(request: FrameRequest) -> Iterator[WhatIfOption]:
    if request.truth is not None:
        yield _button("Start at the true pose", request_changes.StartAtTruth())
    recorded = () if request.record.localization.match is None else matched.METHODS
    options = tuple(
        OptionValue(value=name, text=name) for name in (*available_methods(), *recorded)
    )
    yield _choice("Method", request_changes.UseMethod(request.method), "method", options)


def _button(text: str, change: WhatIfChange) -> WhatIfOption:
    return WhatIfOption(text=text, change=to_json(change))


def _choice(
    text: str, change: WhatIfChange, name: str, options: tuple[OptionValue, ...]
) -> WhatIfOption:
    choice = ChoiceField(name=name, options=options)
    return WhatIfOption(text=text, change=to_json(change), choice=choice)


def _class_choice(
    classes: ClassSet, change: request_changes.ChangeElementClass | request_changes.DetectionClass
) -> Iterator[WhatIfOption]:
    """Yield a choice among the classes of the same kind, if there are several."""
    kind = classes[change.class_id].kind
    options = tuple(
        OptionValue(value=class_.id, text=class_.name) for class_ in classes if class_.kind == kind
    )
    if len(options) > 1:
        yield _choice("Class", change, "class_id", options)


def _fields(text: str, change: WhatIfChange, *labels: tuple[str, str]) -> WhatIfOption:
    """Return an option with number fields; ``labels`` are (field of the change, label)."""
    values = to_json(change)
    fields = tuple(
        NumberField(name=name, label=label, value=values[name], unit="m" * name.endswith("_m"))
        for name, label in labels
    )
    return WhatIfOption(text=text, change=values, fields=fields)
