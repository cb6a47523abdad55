"""Messages about a run and its frames. NaN and missing values are null; numbers are rounded."""

from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from semviz.inspector.frame_columns import FrameColumns, frame_columns
from semviz.inspector.state import ImageMode, MapColors, State, View
from semviz.runs.diagnosis import (
    DiagnosisCard,
    detection_errors,
    diagnosis_card,
    diagnosis_name,
    noticed_faults,
)
from semviz.runs.frame_table import frame_table
from semviz.runs.images import Projected, offsets, project_elements
from semviz.runs.metrics import errors_of, is_overconfident
from semviz.runs.run import FrameRecord, Run
from semviz.web.protocol import Event, ImageSize, Part
from semviz_core.base.camera import Camera
from semviz_core.base.classes import ClassSet
from semviz_core.base.frame import Side
from semviz_core.base.localization import Localization, Status
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray, IntArray

Pixel = tuple[float, float]
Ends = tuple[Pixel, Pixel | None]
"""An element in an image: the anchor and, for a pole, the end."""


class ElementClassView(Part):
    """A class of elements, with its colours in both themes."""

    id: int
    name: str
    letter: str
    shape: Literal["line", "triangle", "square", "circle", "diamond", "pentagon"]
    color: str
    color_light: str


class RunHead(Part):
    """Method, map, classes and image sizes of a run; of a rig, its camera."""

    name: str
    method: str
    map: str
    map_frame: str
    created: str
    elements: int
    image: ImageSize
    image_right: ImageSize | None
    camera: str
    classes: tuple[ElementClassView, ...]


class FrameRow(Part):
    """A frame with its result. Errors are null without a pose or ground truth."""

    index: int
    status: Status
    reason: str
    diagnosis: str
    overconfident: bool
    """Status ok, but more than 1 m off."""
    noticed: str
    """Faults that did no harm, by element or detection."""
    error_m: float | None
    error_deg: float | None
    ms: float


class RunView(RunHead):
    """Everything about a run that does not depend on the frame shown."""

    note: str
    frames: FrameColumns
    median_m: float | None
    ok_share: float


class ObservedView(Part):
    """A detection; ``truth`` is the row of its true element in ``mapped``."""

    class_id: int
    anchor: Pixel
    end: Pixel | None
    anchor_known: bool
    end_known: bool
    truth: int | None


class MappedView(Part):
    """An element of the submap, projected with the estimated and the true pose."""

    id: int
    name: str
    class_id: int
    estimate: Ends | None
    truth: Ends | None
    behind: bool


class PairView(Part):
    """Rows of a detection and an element, and the residual vector from ``start`` (px)."""

    observed: int
    mapped: int
    inlier: bool
    residual_px: float | None
    start: tuple[float | None, float | None]
    vector: tuple[float | None, float | None]


class MatrixView(Part):
    """Match probabilities (m + 1, n + 1), and the order of rows and columns by class."""

    probability: tuple[tuple[float, ...], ...]
    rows: tuple[int, ...]
    columns: tuple[int, ...]


class FrameView(FrameRow):
    """A frame with all that the page draws of it."""

    position: int
    has_truth: bool
    observed: tuple[ObservedView, ...]
    mapped: tuple[MappedView, ...]
    pairs: tuple[PairView, ...]
    true_pairs: tuple[PairView, ...]
    matrix: MatrixView | None
    missed_detections: tuple[int, ...]
    """Rows of ``mapped``."""
    false_positives: tuple[int, ...]
    """Rows of ``observed``."""
    card: DiagnosisCard


class StateView(Part):
    """The selection and the display settings."""

    observed: int | None
    element: int | None
    view: View
    alternatives: bool
    forecast: bool
    colors: MapColors
    ellipsoids: bool
    backdrop: bool
    base: str
    comparing: bool
    mode: ImageMode
    side: Side
    neighbours: bool


class RunEvent(Event):
    """Another run was opened."""

    type: Literal["run"] = "run"
    run: RunView


class FrameEvent(Event):
    """Another frame is shown."""

    type: Literal["frame"] = "frame"
    frame: FrameView
    state: StateView


class StateEvent(Event):
    """The selection or the display settings changed."""

    type: Literal["state"] = "state"
    state: StateView


def run_view(name: str, run: Run) -> RunView:
    """Return everything about a run that does not depend on the frame shown."""
    table = frame_table(run)
    known_m = table.distance_m[np.isfinite(table.distance_m)]
    return RunView(
        **dict(run_head(name, run)),
        note=run.note,
        frames=frame_columns(table),
        median_m=float(np.median(known_m)) if len(known_m) else None,
        ok_share=float(table.is_ok.mean()) if len(table) else 0.0,
    )


def run_head(name: str, run: Run) -> RunHead:
    """Return method, map, classes and image sizes of a run."""
    return RunHead(
        name=name,
        method=run.info.method,
        map=run.info.map_name,
        map_frame=run.semantic_map.frame.name,
        created=run.info.created,
        elements=len(run.semantic_map),
        image=_size(run.info.rig.left),
        image_right=None if (right := run.info.rig.right) is None else _size(right),
        camera=run.info.camera,
        classes=_classes(run.semantic_map.classes),
    )


def frame_view(run: Run, position: int) -> FrameView:
    """Return a frame: detections, projected map, pairs, probabilities, diagnosis."""
    record = run.frames[position]
    localization, truth = record.localization, record.frame.T_map_camera
    estimated = _projected(localization, localization.T_camera_map)
    true = _projected(localization, None if truth is None else truth.inverse())
    mapped, errors = _mapped_columns(record), detection_errors(run, record)
    missed = np.flatnonzero(np.isin(localization.submap.id, errors.missed_detections))
    return FrameView(
        **_row(run, record),
        position=position,
        has_truth=truth is not None,
        observed=_observed(localization, mapped),
        mapped=_mapped(localization, run.semantic_map.classes, estimated, true),
        pairs=_pairs(localization, estimated),
        true_pairs=_true_pairs(localization, mapped, true),
        matrix=_matrix(localization),
        missed_detections=tuple(missed.tolist()),
        false_positives=tuple(errors.false_positives),
        card=diagnosis_card(run, record, errors),
    )


def state_view(state: State) -> StateView:
    """Return the selection and the display settings."""
    return StateView(
        observed=state.selection.observed,
        element=state.selection.element,
        view=state.view,
        alternatives=state.alternatives,
        forecast=state.forecast,
        colors=state.colors,
        ellipsoids=state.ellipsoids,
        backdrop=state.backdrop,
        base=state.base,
        comparing=state.comparing,
        mode=state.mode,
        side=state.side,
        neighbours=state.neighbours,
    )


def _size(camera: Camera) -> ImageSize:
    return ImageSize(width=camera.width, height=camera.height)


def _row(run: Run, record: FrameRecord) -> dict[str, Any]:
    """Return the fields of FrameRow."""
    localization, errors = record.localization, errors_of(record)
    return {
        "index": record.frame.index,
        "status": localization.status,
        "reason": localization.reason,
        "diagnosis": diagnosis_name(run, record),
        "overconfident": is_overconfident(localization, errors),
        "noticed": noticed_faults(run, record),
        "error_m": None if errors is None else errors.distance_m,
        "error_deg": None if errors is None else errors.angle_deg,
        "ms": sum(localization.time_ms.values()),
    }


def _classes(classes: ClassSet) -> tuple[ElementClassView, ...]:
    return tuple(
        ElementClassView(
            id=kind.id,
            name=kind.name,
            letter=kind.letter,
            shape=kind.shape,
            color=kind.color,
            color_light=kind.color_light,
        )
        for kind in classes
    )


def _projected(localization: Localization, pose: Pose | None) -> Projected | None:
    if pose is None:
        return None
    return project_elements(localization.submap, pose, localization.camera)


def _mapped_columns(record: FrameRecord) -> IntArray:
    """Return (m,) the submap row of each detection's true element; -1 if unknown or outside."""
    rows = {int(id): row for row, id in enumerate(record.localization.submap.id)}
    return np.array([rows.get(int(id), -1) for id in record.element_id], dtype=np.int64)


def _observed(localization: Localization, mapped: IntArray) -> tuple[ObservedView, ...]:
    observed = localization.observed
    return tuple(
        ObservedView(
            class_id=int(observed.class_id[row]),
            anchor=pixel(observed.anchor_px[row]),
            end=pixel(observed.end_px[row]) if observed.is_line[row] else None,
            anchor_known=bool(observed.anchor_known[row]),
            end_known=bool(observed.end_known[row]),
            truth=None if mapped[row] < 0 else int(mapped[row]),
        )
        for row in range(len(observed))
    )


def _mapped(
    localization: Localization,
    classes: ClassSet,
    estimated: Projected | None,
    true: Projected | None,
) -> tuple[MappedView, ...]:
    submap = localization.submap
    return tuple(
        MappedView(
            id=int(submap.id[row]),
            name=classes.element_name(int(submap.class_id[row]), int(submap.id[row])),
            class_id=int(submap.class_id[row]),
            estimate=place(estimated, row),
            truth=place(true, row),
            behind=_is_behind(estimated or true, row),
        )
        for row in range(len(submap))
    )


def _is_behind(projected: Projected | None, row: int) -> bool:
    return projected is not None and bool(projected.behind[row])


def place(projected: Projected | None, row: int) -> Ends | None:
    """Return an element's ends in the image; None if it is not visible."""
    if projected is None or not projected.shown[row]:
        return None
    end = projected.end_px[row]
    return pixel(projected.anchor_px[row]), pixel(end) if np.isfinite(end).all() else None


def _pairs(localization: Localization, estimated: Projected | None) -> tuple[PairView, ...]:
    """Return the inliers and outliers of the estimate, with the solver's residuals."""
    refinement = localization.refinement
    if refinement is None or estimated is None:
        return ()
    start, vector = offsets(localization.observed, estimated, refinement.pairs)
    size = np.sqrt(np.nansum(refinement.residual_px**2, axis=1))
    return _pair_views(refinement.pairs, refinement.inlier.tolist(), size, start, vector)


def _true_pairs(
    localization: Localization, mapped: IntArray, true: Projected | None
) -> tuple[PairView, ...]:
    """Return the true pairs, with their residuals at the true pose."""
    if true is None:
        return ()
    rows = np.flatnonzero(mapped >= 0)
    pairs = np.stack([rows, mapped[rows]], axis=1)
    start, vector = offsets(localization.observed, true, pairs)
    size = np.linalg.norm(vector, axis=1)
    return _pair_views(pairs, [True] * len(pairs), size, start, vector)


def _pair_views(
    pairs: IntArray, inlier: list[bool], size: FloatArray, start: FloatArray, vector: FloatArray
) -> tuple[PairView, ...]:
    return tuple(
        PairView(
            observed=int(i),
            mapped=int(j),
            inlier=inlier[row],
            residual_px=number(size[row]),
            start=(number(start[row, 0]), number(start[row, 1])),
            vector=(number(vector[row, 0]), number(vector[row, 1])),
        )
        for row, (i, j) in enumerate(pairs)
    )


def _matrix(localization: Localization) -> MatrixView | None:
    """Return the probabilities, and the order of rows and columns by class."""
    if localization.match is None:
        return None
    observed, submap = localization.observed, localization.submap
    return MatrixView(
        probability=np.round(localization.match.probability, 4).tolist(),
        rows=np.argsort(observed.class_id, kind="stable").tolist(),
        columns=np.argsort(submap.class_id, kind="stable").tolist(),
    )


def pixel(values: ArrayLike) -> Pixel:
    """Return a point (2,) in an image, which must be finite."""
    u, v = np.asarray(values, dtype=np.float64).tolist()
    return round(u, 2), round(v, 2)


def number(value: float | np.floating[Any]) -> float | None:
    """Return a number rounded to a hundredth; None for NaN and infinity."""
    return round(float(value), 2) if np.isfinite(value) else None


class MapColorLevel(Part):
    """A colour of the map: its line, its name, and how many elements have it."""

    color: str
    width: float
    name: str
    elements: int


class MapLegend(Part):
    """The meaning of the map's colours; without levels they show the classes."""

    by: MapColors
    levels: tuple[MapColorLevel, ...]


class MapColorsEvent(Event):
    """The legend of the map in 3D; ``magnified`` is the scale of ellipsoids, if they are shown."""

    type: Literal["map_colors"] = "map_colors"
    legend: MapLegend
    magnified: float | None


class ViewpointEvent(Event):
    """The user's viewpoint in 3D, metres in the map frame."""

    type: Literal["viewpoint"] = "viewpoint"
    eye: tuple[float, float, float]
    target: tuple[float, float, float]


class SceneImageEvent(Event):
    """The 3D pane as a PNG file, base64."""

    type: Literal["scene_image"] = "scene_image"
    png: str
