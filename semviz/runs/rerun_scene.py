"""Draw a run in rerun: map, poses and matrix, and the image with detections and residuals."""

import numpy as np
import rerun as rr

from semviz.presentation import plots
from semviz.presentation.plots import residual_colors, rgba
from semviz.runs import rerun_plots, run
from semviz.runs.columns import Columns, Strips
from semviz.runs.rerun_plots import readme
from semviz.runs.run import FrameRecord, Run, RunInfo
from semviz_core.base.camera import Camera, Rig
from semviz_core.base.classes import ClassSet
from semviz_core.base.localization import Localization, Refinement
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import FloatArray, IntArray, unit_vectors

OBSERVED, PROJECTED = f"{run.IMAGE}/observed", f"{run.IMAGE}/projected"
TRUE = f"{run.IMAGE}/projected_truth"
RESIDUALS = f"{run.IMAGE}/residuals_x10"

RESIDUAL_SCALE = 10.0
"""Residuals are drawn ten times as long as they are."""
_SIGN_RADIUS_PX = 7.0
_CAP = np.array([4.0, 0.0])
_GLYPH_CIRCLE_RAD = np.linspace(0.0, 2 * np.pi, 25)
_GLYPH_CIRCLE = np.stack(
    [np.sin(_GLYPH_CIRCLE_RAD), -np.cos(_GLYPH_CIRCLE_RAD)], axis=1
)  # from the top, clockwise
_GLYPHS: dict[str, FloatArray] = {
    "triangle": _GLYPH_CIRCLE[[0, 8, 16, 0]] * 1.25,
    "square": _GLYPH_CIRCLE[[3, 9, 15, 21, 3]] * 1.25,
    "circle": _GLYPH_CIRCLE,
    "diamond": _GLYPH_CIRCLE[[0, 6, 12, 18, 0]] * 1.25,
    "pentagon": _GLYPH_CIRCLE[[0, 5, 10, 14, 19, 0]] * 1.1,
}


def draw_overlay_styles(stream: rr.RecordingStream) -> None:
    """Draw the static styles of the image overlay: line widths, colours and drawing order."""
    styles = (
        (TRUE, 1.2, rgba(plots.TRUTH.dark, 0.75)),
        (PROJECTED, 1.6, rgba(plots.ESTIMATE.dark)),
        (OBSERVED, 2.2, None),
        (RESIDUALS, 2.6, None),
    )
    for order, (entity, width, color) in enumerate(styles, start=1):
        style = rr.LineStrips2D.from_fields(
            radii=rr.Radius.ui_points(width / 2),
            colors=color,
            draw_order=10.0 * order,
            show_labels=entity == OBSERVED,
        )
        stream.log(entity, style, static=True)


def draw_image_overlay(columns: Columns, record: FrameRecord, classes: ClassSet) -> None:
    """Draw detections, projected map and residuals over the image."""
    result, truth = record.localization, record.frame.T_map_camera
    _draw_observed(columns, record, classes)
    _draw_projected(columns, TRUE, result, truth and truth.inverse(), classes)
    _draw_projected(columns, PROJECTED, result, result.T_camera_map, classes)
    _draw_residuals(columns, result)


def _draw_observed(columns: Columns, record: FrameRecord, classes: ClassSet) -> None:
    observed = record.localization.observed
    outlines, rows = _outlines(observed.anchor_px, observed.end_px, observed.class_id, classes)
    class_colors = {class_.id: rgba(class_.color) for class_ in classes}
    colors = [class_colors[class_id] for class_id in observed.class_id[rows].tolist()]
    columns.strips(OBSERVED, outlines, np.array(colors, np.int64))
    names = _names(record, classes)
    columns.labels(OBSERVED, "LineStrips2D", [names[row] for row in rows])


def _names(record: FrameRecord, classes: ClassSet) -> list[str]:
    """Return the element that each detection was matched to, and the true one if it differs."""
    result = record.localization
    class_ids = dict(zip(result.submap.id.tolist(), result.submap.class_id.tolist(), strict=True))
    matched_ids = [-1] * len(result.observed)
    if result.refinement is not None:
        for row, column in result.refinement.pairs:
            matched_ids[row] = int(result.submap.id[column])

    def name(row: int, element_id: int) -> str:
        class_id = class_ids.get(element_id, int(result.observed.class_id[row]))
        return classes.element_name(class_id, element_id)

    names = []
    pairs = zip(matched_ids, record.element_id.tolist(), strict=True)
    for row, (matched, true) in enumerate(pairs):
        if matched < 0:
            names.append("?" if true < 0 else f"{name(row, true)} ?")
        elif true < 0 or true == matched:
            names.append(name(row, matched))
        else:
            names.append(f"{name(row, matched)} is {name(row, true)}")
    return names


def _draw_projected(
    columns: Columns,
    entity: str,
    result: Localization,
    T_camera_map: Pose | None,
    classes: ClassSet,
) -> None:
    """Draw the elements of the submap that are in the image of a pose."""
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
    """Return anchors and ends (k, 2), in pixels, of rows of the submap; NaN behind the camera."""
    anchor = result.camera.project(T_camera_map.apply(result.submap.anchor_m[rows]))
    end = result.camera.project(T_camera_map.apply(result.submap.end_m[rows]))
    return anchor, end


def _outlines(
    anchor_px: FloatArray, end_px: FloatArray, class_id: IntArray, classes: ClassSet
) -> tuple[Strips, IntArray]:
    """Return k strips, sorted by class, and the element's row (k,) of each.

    A strip is a pole's line with a cap at its peak, or a sign's glyph.
    """
    none = np.zeros(0, np.int64)
    points, lengths, rows = [np.zeros((0, 2))], [none], [none]
    for class_ in classes:
        row = np.flatnonzero(class_id == class_.id)
        if not len(row):
            continue
        if class_.kind == "line":
            peak = anchor_px[row]
            shape = np.stack([peak - _CAP, peak + _CAP, peak, end_px[row]], axis=1)
        else:
            shape = anchor_px[row, None] + _SIGN_RADIUS_PX * _GLYPHS[class_.shape]
        points.append(shape.reshape(-1, 2))
        lengths.append(np.full(len(row), shape.shape[1]))
        rows.append(row)
    return Strips(np.concatenate(points), np.concatenate(lengths)), np.concatenate(rows)


def _draw_residuals(columns: Columns, result: Localization) -> None:
    """Draw an arrow from each matched detection, across a pole or towards the sign."""
    start = residual = np.zeros((0, 2))
    if result.refinement is not None and result.T_camera_map is not None:
        start, residual = _image_residuals(result, result.refinement, result.T_camera_map)
    arrows = Strips.of(np.stack([start, start + RESIDUAL_SCALE * residual], axis=1))
    columns.strips(RESIDUALS, arrows, residual_colors(np.linalg.norm(residual, axis=1)))


def _image_residuals(
    result: Localization, refinement: Refinement, T_camera_map: Pose
) -> tuple[FloatArray, FloatArray]:
    """Return start points (k, 2) and residuals (k, 2) of the pairs, in pixels.

    A pole has a residual at each end, across its projected line only.
    """
    rows, map_rows = refinement.pairs.T
    observed = result.observed
    is_line = observed.is_line[rows, None]
    anchor, end = _project(result, T_camera_map, map_rows)
    along = unit_vectors(end - anchor)

    def residual_of(points_px: FloatArray) -> FloatArray:
        gap = points_px - anchor
        across = gap - (gap * along).sum(axis=1, keepdims=True) * along
        return np.where(is_line, across, gap)

    start = np.concatenate([observed.anchor_px[rows], observed.end_px[rows]])
    residual = np.concatenate([residual_of(points) for points in np.split(start, 2)])
    known = np.isfinite(start).all(axis=1) & np.isfinite(residual).all(axis=1)
    return start[known], residual[known]


ELEMENTS, ROAD = "/map/elements", "/map/road"
TRUE_CAMERA = "/map/camera_truth"
TRUE_PATH, PATH = "/map/path/truth", "/map/path/estimate"
HERE = "/map/here"
"""Position that the 3D view follows: truth, else estimate, else prior."""
PRIOR_CIRCLE, ALTERNATIVES, RAYS = "/map/prior", "/map/alternatives", "/map/pairs"
MATRIX = "/match/probability"
README = "/readme"

FRUSTUM_M = 4.0
"""Depth at which a camera's image is drawn."""
HIDDEN_M = 1e-4
"""The same for a camera without a pose: rerun cannot hide it, so it becomes a dot."""
MAX_LABELLED = 60
"""Larger maps show an element's name on hover only."""
_JPEG = rr.EncodedImage.from_fields(media_type="image/jpeg")
_GROUND_CIRCLE_RAD = np.linspace(0, 2 * np.pi, 49)
_GROUND_CIRCLE = np.stack(
    [np.cos(_GROUND_CIRCLE_RAD), np.sin(_GROUND_CIRCLE_RAD), np.zeros(49)], axis=1
)


class RerunScene:
    """Draws a run: the map once into the stream, and each frame into columns."""

    def __init__(
        self, stream: rr.RecordingStream, info: RunInfo, semantic_map: SemanticMap
    ) -> None:
        self.run = Run(info, semantic_map, ())
        self._true_center: FloatArray | None = None
        text = readme(info, semantic_map)
        stream.log(README, rr.TextDocument(text, media_type="text/markdown"), static=True)
        _draw_map(stream, semantic_map)
        _draw_styles(stream, info.rig.left)
        if info.images == "both":
            _draw_right_camera(stream, info.rig)
        draw_overlay_styles(stream)
        rerun_plots.draw_plot_styles(stream)

    def draw(self, columns: Columns, record: FrameRecord) -> None:
        result, truth = record.localization, record.frame.T_map_camera
        estimate = None if result.T_camera_map is None else result.T_camera_map.inverse()
        _draw_cameras(columns, result, truth, estimate)
        self._draw_paths(columns, record, estimate)
        _draw_prior(columns, result)
        _draw_alternatives(columns, result)
        _draw_rays(columns, result, estimate)
        draw_image_overlay(columns, record, self.run.semantic_map.classes)
        _draw_matrix(columns, record)
        rerun_plots.draw_frame_plots(columns, self.run, record)

    def _draw_paths(self, columns: Columns, record: FrameRecord, estimate: Pose | None) -> None:
        """Draw the frame's part of the paths; the 3D view shows those of all frames."""
        previous, truth = self._true_center, record.frame.T_map_camera
        self._true_center = center = None if truth is None else truth.translation
        if previous is not None and center is not None:
            columns.strips(TRUE_PATH, _line(previous, center))
        if estimate is not None:
            color = np.array([rgba(plots.STATUS[record.localization.status].dark)])
            columns.points(PATH, estimate.translation[None], color)
            if center is not None:
                columns.strips(PATH, _line(center, estimate.translation), color)


def _line(start: FloatArray, end: FloatArray) -> Strips:
    return Strips.of(np.stack([start, end])[None])


def _draw_map(stream: rr.RecordingStream, semantic_map: SemanticMap) -> None:
    stream.log("/map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    columns = Columns()
    for kind in semantic_map.classes:
        entity = f"{ELEMENTS}/{kind.letter}"
        elements = semantic_map.elements[semantic_map.elements.class_id == kind.id]
        colors = np.full(len(elements), rgba(kind.color))
        names = [semantic_map.classes.element_name(kind.id, number) for number in elements.id]
        if kind.kind == "line":
            columns.strips(
                entity, Strips.of(np.stack([elements.anchor_m, elements.end_m], axis=1)), colors
            )
            columns.labels(entity, "LineStrips3D", names, show=len(semantic_map) <= MAX_LABELLED)
            columns.radius(entity, "LineStrips3D", 1.0)
        else:
            columns.points(entity, elements.anchor_m, colors)
            columns.labels(entity, "Points3D", names, show=len(semantic_map) <= MAX_LABELLED)
            columns.radius(entity, "Points3D", 5.0)
    road = Strips(semantic_map.trajectory_m, np.array([len(semantic_map.trajectory_m)]))
    columns.strips(ROAD, road, np.array([rgba(plots.PRIOR.dark, 0.5)]))
    columns.send(stream)


def _draw_styles(stream: rr.RecordingStream, camera: Camera) -> None:
    """Draw the static styles of the 3D view and the matrix: sizes, cameras, colours."""
    for entity, color in ((TRUE_CAMERA, plots.TRUTH), (run.IMAGE, plots.ESTIMATE)):
        pinhole = rr.Pinhole.from_fields(
            camera_xyz=rr.ViewCoordinates.RDF,
            image_from_camera=camera.K,
            resolution=[camera.width, camera.height],
            color=rgba(color.dark),
        )
        stream.log(entity, pinhole, static=True)
    stream.log(run.IMAGE, _JPEG, static=True)
    lines = (
        (TRUE_PATH, 1.5, plots.TRUTH),
        (PRIOR_CIRCLE, 1.0, plots.PRIOR),
        (ALTERNATIVES, 1.0, plots.ALTERNATIVE),
    )
    for entity, width, tone in lines:
        radius, colors = rr.Radius.ui_points(width / 2), rgba(tone.dark)
        stream.log(entity, rr.LineStrips3D.from_fields(radii=radius, colors=colors), static=True)
    for entity, width in ((PATH, 1.5), (RAYS, 1.0)):
        thin = rr.LineStrips3D.from_fields(radii=rr.Radius.ui_points(width / 2))
        stream.log(entity, thin, static=True)
    stream.log(PATH, rr.Points3D.from_fields(radii=rr.Radius.ui_points(3.0)), static=True)
    stream.log(HERE, rr.Points3D.from_fields(colors=rgba(plots.TRUTH.dark, 0.0)), static=True)
    matrix = rr.DepthImage.from_fields(meter=1.0, colormap="viridis", depth_range=[0.0, 1.0])
    cells = rr.Points2D.from_fields(radii=rr.Radius.ui_points(3.0))
    stream.log(MATRIX, matrix, cells, static=True)


def _draw_right_camera(stream: rr.RecordingStream, rig: Rig) -> None:
    assert rig.right is not None
    assert rig.T_right_left is not None
    T_left_right = rig.T_right_left.inverse()
    pose = rr.Transform3D(translation=T_left_right.translation, mat3x3=T_left_right.rotation)
    stream.log(run.RIGHT_CAMERA, pose, static=True)
    pinhole = rr.Pinhole(
        image_from_camera=rig.right.K, resolution=[rig.right.width, rig.right.height]
    )
    stream.log(run.IMAGE_RIGHT, pinhole, _JPEG, static=True)


def _draw_cameras(
    columns: Columns, result: Localization, truth: Pose | None, estimate: Pose | None
) -> None:
    known = truth or estimate
    here = result.around_m if known is None else known.translation
    columns.points(HERE, here[None])
    for camera, image, pose in (
        (TRUE_CAMERA, TRUE_CAMERA, truth),
        (run.CAMERA, run.IMAGE, estimate),
    ):
        columns.pose(camera, pose or Pose(np.eye(3), here))
        columns.image_plane_distance(image, HIDDEN_M if pose is None else FRUSTUM_M)


def _draw_prior(columns: Columns, result: Localization) -> None:
    prior, circle = result.prior, np.zeros((0, 1, 3))
    if prior is not None:
        circle = (prior.position_m + prior.horizontal_sigma_m * _GROUND_CIRCLE)[None]
    columns.strips(PRIOR_CIRCLE, Strips.of(circle))


def _draw_alternatives(columns: Columns, result: Localization) -> None:
    frustums = np.zeros((0, 1, 3))
    if result.alternatives:
        outline = _frustum(result.camera, FRUSTUM_M / 2)
        poses = [alternative.T_camera_map.inverse() for alternative in result.alternatives]
        frustums = np.stack([pose.apply(outline) for pose in poses])
    columns.strips(ALTERNATIVES, Strips.of(frustums))


def _frustum(camera: Camera, depth_m: float) -> FloatArray:
    """Return one strip (11, 3) through all edges of a camera's frustum, in camera coordinates."""
    right, bottom = camera.width - 0.5, camera.height - 0.5
    corners = camera.normalize(
        np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]])
    )
    points = np.concatenate([corners, np.ones((4, 1))], axis=1) * depth_m
    points = np.concatenate([points, np.zeros((1, 3))])
    return points[[0, 1, 2, 3, 0, 4, 1, 2, 4, 3, 4]]


def _draw_rays(columns: Columns, result: Localization, estimate: Pose | None) -> None:
    """Draw a ray from the estimated camera to each matched element, coloured by residual."""
    refinement = result.refinement
    rays, colors = np.zeros((0, 2, 3)), np.zeros(0, np.int64)
    if refinement is not None and estimate is not None:
        targets = result.submap.anchor_m[refinement.pairs[:, 1]]
        centers = np.broadcast_to(estimate.translation, targets.shape)
        rays = np.stack([centers, targets], axis=1)
        colors = residual_colors(np.hypot(*np.nan_to_num(refinement.residual_px).T))
    columns.strips(RAYS, Strips.of(rays), colors)


def _draw_matrix(columns: Columns, record: FrameRecord) -> None:
    """Draw the match matrix, rows and columns sorted by class, and the dustbins last."""
    result = record.localization
    if result.match is None:
        columns.matrix(MATRIX, None)
        columns.points(MATRIX, np.zeros((0, 2)), np.zeros(0, np.int64))
        return
    m, n = len(result.observed), len(result.submap)
    rows = np.append(np.argsort(result.observed.class_id, kind="stable"), m)
    order = np.append(np.argsort(result.submap.class_id, kind="stable"), n)
    columns.matrix(MATRIX, result.match.probability[np.ix_(rows, order)])
    truth = _true_pairs(record.element_id, result.submap.id)
    pairs = truth if result.refinement is None else np.concatenate([truth, result.refinement.pairs])
    cells = np.stack([np.argsort(order)[pairs[:, 1]], np.argsort(rows)[pairs[:, 0]]], axis=1)
    is_truth = np.arange(len(pairs)) < len(truth)
    colors = np.where(is_truth, rgba(plots.TRUTH.dark), rgba(plots.ESTIMATE.dark))
    columns.points(MATRIX, cells.astype(np.float64) + 0.5, colors)


def _true_pairs(element_id: IntArray, submap_id: IntArray) -> IntArray:
    """Return rows (k, 2) of observed and submap that are the same element."""
    pairs: IntArray = np.argwhere(element_id[:, None] == submap_id[None, :])
    return pairs
