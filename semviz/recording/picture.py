"""What rerun shows on the image: detections, the projected map, residuals."""

import numpy as np
import rerun as rr

from semviz.palette import ESTIMATE, TRUTH, residual_colors, rgba
from semviz.recording import layout
from semviz.recording.columns import Columns, Strips
from semviz.recording.run import FrameRecord
from semviz_core.arrays import FloatArray, IntArray
from semviz_core.classes import ClassSet
from semviz_core.localization import Localization, Refinement
from semviz_core.pose import Pose

OBSERVED, PROJECTED = f"{layout.IMAGE}/observed", f"{layout.IMAGE}/projected"
TRUE = f"{layout.IMAGE}/projected_truth"
RESIDUALS = f"{layout.IMAGE}/residuals_x10"

RESIDUAL_SCALE = 10.0
"""Residuals are drawn ten times as long as they are, in every frame."""
_SIGN_RADIUS_PX = 7.0
_CAP = np.array([4.0, 0.0])
_TURN = np.linspace(0.0, 2 * np.pi, 25)
_CIRCLE = np.stack([np.sin(_TURN), -np.cos(_TURN)], axis=1)  # from the top, clockwise
_GLYPHS: dict[str, FloatArray] = {
    "triangle": _CIRCLE[[0, 8, 16, 0]] * 1.25,
    "square": _CIRCLE[[3, 9, 15, 21, 3]] * 1.25,
    "circle": _CIRCLE,
    "diamond": _CIRCLE[[0, 6, 12, 18, 0]] * 1.25,
    "pentagon": _CIRCLE[[0, 5, 10, 14, 19, 0]] * 1.1,
}


def draw_styles(stream: rr.RecordingStream) -> None:
    """What stays the same for all frames: line widths, which lies over which."""
    styles = (
        (TRUE, 1.2, rgba(TRUTH.dark, 0.75)),
        (PROJECTED, 1.6, rgba(ESTIMATE.dark)),
        (OBSERVED, 2.2, None),
        (RESIDUALS, 2.6, None),
    )
    for order, (entity, width, of_all) in enumerate(styles, start=1):
        style = rr.LineStrips2D.from_fields(
            radii=rr.Radius.ui_points(width / 2),
            colors=of_all,
            draw_order=10.0 * order,
            show_labels=entity == OBSERVED,
        )
        stream.log(entity, style, static=True)


def draw(columns: Columns, record: FrameRecord, classes: ClassSet) -> None:
    """What lies on the image."""
    result, truth = record.localization, record.frame.T_map_camera
    _draw_observed(columns, record, classes)
    _draw_projected(columns, TRUE, result, truth and truth.inverse(), classes)
    _draw_projected(columns, PROJECTED, result, result.T_camera_map, classes)
    _draw_residuals(columns, result)


def _draw_observed(columns: Columns, record: FrameRecord, classes: ClassSet) -> None:
    seen = record.localization.observed
    outlines, row = _outlines(seen.anchor_px, seen.end_px, seen.class_id, classes)
    palette = {one.id: rgba(one.color) for one in classes}
    colors = np.array([palette[one] for one in seen.class_id[row].tolist()], np.int64)
    columns.strips(OBSERVED, outlines, colors)
    names = _names(record, classes)
    columns.labels(OBSERVED, "LineStrips2D", [names[one] for one in row])


def _names(record: FrameRecord, classes: ClassSet) -> list[str]:
    """What each observed element was taken for, and what it is where that differs."""
    result = record.localization
    ids = dict(zip(result.submap.id.tolist(), result.submap.class_id.tolist(), strict=True))
    taken = [-1] * len(result.observed)
    if result.refinement is not None:
        for row, column in result.refinement.pairs:
            taken[row] = int(result.submap.id[column])

    def name(row: int, element_id: int) -> str:
        kind = ids.get(element_id, int(result.observed.class_id[row]))
        return classes.element_name(kind, element_id)

    names = []
    for row, (chosen, true) in enumerate(zip(taken, record.element_id.tolist(), strict=True)):
        if chosen < 0:
            names.append("?" if true < 0 else f"{name(row, true)} ?")
        elif true < 0 or true == chosen:
            names.append(name(row, chosen))
        else:
            names.append(f"{name(row, chosen)} is {name(row, true)}")
    return names


def _draw_projected(
    columns: Columns,
    entity: str,
    result: Localization,
    T_camera_map: Pose | None,
    classes: ClassSet,
) -> None:
    """The elements of the submap that the image can show, seen from one pose."""
    anchor = end = np.zeros((0, 2))
    class_id = np.zeros(0, np.int64)
    if T_camera_map is not None:
        anchor, end = _project(result, T_camera_map, slice(None))
        shown = result.camera.contains(anchor) | result.camera.contains(end)
        shown &= np.isfinite(anchor).all(axis=1)
        shown &= np.isfinite(end).all(axis=1) | ~result.submap.is_line
        anchor, end, class_id = anchor[shown], end[shown], result.submap.class_id[shown]
    columns.strips(entity, _outlines(anchor, end, class_id, classes)[0])


def _project(
    result: Localization, T_camera_map: Pose, rows: IntArray | slice
) -> tuple[FloatArray, FloatArray]:
    """Anchors and ends (k, 2) in pixels of rows of the submap; NaN for what is behind."""
    anchor = result.camera.project(T_camera_map.apply(result.submap.anchor_m[rows]))
    end = result.camera.project(T_camera_map.apply(result.submap.end_m[rows]))
    return anchor, end


def _outlines(
    anchor_px: FloatArray, end_px: FloatArray, class_id: IntArray, classes: ClassSet
) -> tuple[Strips, IntArray]:
    """One strip for each element, a pole's line with a cap at its peak or a sign's glyph.

    Also the row (k,) of each strip's element: the strips are in the order of the classes.
    """
    none = np.zeros(0, np.int64)
    points, lengths, rows = [np.zeros((0, 2))], [none], [none]
    for one in classes:
        row = np.flatnonzero(class_id == one.id)
        if not len(row):
            continue
        if one.kind == "line":
            peak = anchor_px[row]
            shape = np.stack([peak - _CAP, peak + _CAP, peak, end_px[row]], axis=1)
        else:
            shape = anchor_px[row, None] + _SIGN_RADIUS_PX * _GLYPHS[one.shape]
        points.append(shape.reshape(-1, 2))
        lengths.append(np.full(len(row), shape.shape[1]))
        rows.append(row)
    return Strips(np.concatenate(points), np.concatenate(lengths)), np.concatenate(rows)


def _draw_residuals(columns: Columns, result: Localization) -> None:
    """From each paired detection away from its projection: across a pole, towards a sign."""
    start = residual = np.zeros((0, 2))
    if result.refinement is not None and result.T_camera_map is not None:
        start, residual = _image_residuals(result, result.refinement, result.T_camera_map)
    arrows = Strips.of(np.stack([start, start + RESIDUAL_SCALE * residual], axis=1))
    columns.strips(RESIDUALS, arrows, residual_colors(np.linalg.norm(residual, axis=1)))


def _image_residuals(
    result: Localization, refinement: Refinement, T_camera_map: Pose
) -> tuple[FloatArray, FloatArray]:
    """Where (k, 2) and which way (k, 2) detections miss the projection, in pixels.

    A pole counts at both its ends, across its projected line only.
    """
    rows, picked = refinement.pairs.T
    seen = result.observed
    is_line = seen.is_line[rows, None]
    anchor, end = _project(result, T_camera_map, picked)
    along = end - anchor
    along = along / np.linalg.norm(along, axis=1, keepdims=True)

    def miss(points_px: FloatArray) -> FloatArray:
        gap = points_px - anchor
        across = gap - (gap * along).sum(axis=1, keepdims=True) * along
        return np.where(is_line, across, gap)

    start = np.concatenate([seen.anchor_px[rows], seen.end_px[rows]])
    residual = np.concatenate([miss(seen.anchor_px[rows]), miss(seen.end_px[rows])])
    known = np.isfinite(start).all(axis=1) & np.isfinite(residual).all(axis=1)
    return start[known], residual[known]
