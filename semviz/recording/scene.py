"""What rerun shows of a run: map, poses, matrix. The entities mirror the frames."""

import numpy as np
import rerun as rr

from semviz.palette import ALTERNATIVE, ESTIMATE, PRIOR, STATUS, TRUTH, residual_colors, rgba
from semviz.recording import layout, picture, plots
from semviz.recording.columns import Columns, Strips
from semviz.recording.run import FrameRecord, Run, RunInfo
from semviz.recording.words import readme
from semviz_core.arrays import FloatArray, IntArray
from semviz_core.camera import Camera, Rig
from semviz_core.localization import Localization
from semviz_core.pose import Pose
from semviz_core.semantic_map import SemanticMap

ELEMENTS, ROAD = "/map/elements", "/map/road"
TRUE_CAMERA = "/map/camera_truth"
TRUE_PATH, PATH = "/map/path/truth", "/map/path/estimate"
HERE = "/map/here"
"""Where the frame is, for the eye to follow: truth, else estimate, else prior."""
PRIOR_CIRCLE, GHOSTS, RAYS = "/map/prior", "/map/alternatives", "/map/pairs"
MATRIX = "/match/probability"
README = "/readme"

FRUSTUM_M = 4.0
"""Depth at which a camera's image is drawn."""
HIDDEN_M = 1e-4
"""The same for a camera without a pose: rerun cannot hide it, so it becomes a dot."""
LABELLED = 60
"""Maps with more elements than this show names only where the pointer is."""
_JPEG = rr.EncodedImage.from_fields(media_type="image/jpeg")
_TURN = np.linspace(0, 2 * np.pi, 49)
_CIRCLE = np.stack([np.cos(_TURN), np.sin(_TURN), np.zeros(49)], axis=1)


class Scene:
    """Draws a run: the map once, into the stream; then each frame, into its columns."""

    def __init__(
        self, stream: rr.RecordingStream, info: RunInfo, semantic_map: SemanticMap
    ) -> None:
        self._run = Run(info, semantic_map, ())
        self._true_center: FloatArray | None = None
        text = readme(info, semantic_map)
        stream.log(README, rr.TextDocument(text, media_type="text/markdown"), static=True)
        _draw_map(stream, semantic_map)
        _draw_styles(stream, info.rig.left)
        if info.images == "both":
            _draw_right_camera(stream, info.rig)
        picture.draw_styles(stream)
        plots.draw_styles(stream)

    def draw(self, columns: Columns, record: FrameRecord) -> None:
        result, truth = record.localization, record.frame.T_map_camera
        estimate = None if result.T_camera_map is None else result.T_camera_map.inverse()
        _draw_cameras(columns, result, truth, estimate)
        self._draw_paths(columns, record, estimate)
        _draw_prior(columns, result)
        _draw_alternatives(columns, result)
        _draw_rays(columns, result, estimate)
        picture.draw(columns, record, self._run.semantic_map.classes)
        _draw_matrix(columns, record)
        plots.draw(columns, self._run, record)

    def _draw_paths(self, columns: Columns, record: FrameRecord, estimate: Pose | None) -> None:
        """Each frame adds its piece; the 3D view shows the pieces of all frames."""
        before, truth = self._true_center, record.frame.T_map_camera
        self._true_center = now = None if truth is None else truth.translation
        if before is not None and now is not None:
            columns.strips(TRUE_PATH, _line(before, now))
        if estimate is not None:
            color = np.array([rgba(STATUS[record.localization.status].dark)])
            columns.points(PATH, estimate.translation[None], color)
            if now is not None:
                columns.strips(PATH, _line(now, estimate.translation), color)


def _line(start: FloatArray, end: FloatArray) -> Strips:
    return Strips.of(np.stack([start, end])[None])


def _draw_map(stream: rr.RecordingStream, semantic_map: SemanticMap) -> None:
    stream.log("/map", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    columns = Columns()
    for kind in semantic_map.classes:
        entity = f"{ELEMENTS}/{kind.letter}"
        one = semantic_map.elements[semantic_map.elements.class_id == kind.id]
        colors = np.full(len(one), rgba(kind.color))
        names = [semantic_map.classes.element_name(kind.id, number) for number in one.id]
        if kind.kind == "line":
            columns.strips(entity, Strips.of(np.stack([one.anchor_m, one.end_m], axis=1)), colors)
            columns.labels(entity, "LineStrips3D", names, show=len(semantic_map) <= LABELLED)
            columns.radius(entity, "LineStrips3D", 1.0)
        else:
            columns.points(entity, one.anchor_m, colors)
            columns.labels(entity, "Points3D", names, show=len(semantic_map) <= LABELLED)
            columns.radius(entity, "Points3D", 5.0)
    road = Strips(semantic_map.trajectory_m, np.array([len(semantic_map.trajectory_m)]))
    columns.strips(ROAD, road, np.array([rgba(PRIOR.dark, 0.5)]))
    columns.send(stream)


def _draw_styles(stream: rr.RecordingStream, camera: Camera) -> None:
    """What stays the same for all frames: sizes, cameras, names and colours of the plots."""
    for entity, color in ((TRUE_CAMERA, TRUTH), (layout.IMAGE, ESTIMATE)):
        pinhole = rr.Pinhole.from_fields(
            camera_xyz=rr.ViewCoordinates.RDF,
            image_from_camera=camera.K,
            resolution=[camera.width, camera.height],
            color=rgba(color.dark),
        )
        stream.log(entity, pinhole, static=True)
    stream.log(layout.IMAGE, _JPEG, static=True)
    lines = ((TRUE_PATH, 1.5, TRUTH), (PRIOR_CIRCLE, 1.0, PRIOR), (GHOSTS, 1.0, ALTERNATIVE))
    for entity, width, tone in lines:
        radius, of_all = rr.Radius.ui_points(width / 2), rgba(tone.dark)
        stream.log(entity, rr.LineStrips3D.from_fields(radii=radius, colors=of_all), static=True)
    for entity, width in ((PATH, 1.5), (RAYS, 1.0)):
        thin = rr.LineStrips3D.from_fields(radii=rr.Radius.ui_points(width / 2))
        stream.log(entity, thin, static=True)
    stream.log(PATH, rr.Points3D.from_fields(radii=rr.Radius.ui_points(3.0)), static=True)
    stream.log(HERE, rr.Points3D.from_fields(colors=rgba(TRUTH.dark, 0.0)), static=True)
    matrix = rr.DepthImage.from_fields(meter=1.0, colormap="viridis", depth_range=[0.0, 1.0])
    cells = rr.Points2D.from_fields(radii=rr.Radius.ui_points(3.0))
    stream.log(MATRIX, matrix, cells, static=True)


def _draw_right_camera(stream: rr.RecordingStream, rig: Rig) -> None:
    assert rig.right is not None
    assert rig.T_right_left is not None
    T_left_right = rig.T_right_left.inverse()
    place = rr.Transform3D(translation=T_left_right.translation, mat3x3=T_left_right.rotation)
    stream.log(layout.RIGHT_CAMERA, place, static=True)
    pinhole = rr.Pinhole(
        image_from_camera=rig.right.K, resolution=[rig.right.width, rig.right.height]
    )
    stream.log(layout.IMAGE_RIGHT, pinhole, _JPEG, static=True)


def _draw_cameras(
    columns: Columns, result: Localization, truth: Pose | None, estimate: Pose | None
) -> None:
    known = truth or estimate
    here = result.prior.position_m if known is None else known.translation
    columns.points(HERE, here[None])
    for camera, picture_entity, pose in (
        (TRUE_CAMERA, TRUE_CAMERA, truth),
        (layout.CAMERA, layout.IMAGE, estimate),
    ):
        columns.pose(camera, pose or Pose(np.eye(3), here))
        columns.picture_distance(picture_entity, HIDDEN_M if pose is None else FRUSTUM_M)


def _draw_prior(columns: Columns, result: Localization) -> None:
    prior = result.prior
    circle = Strips.of((prior.position_m + prior.horizontal_sigma_m * _CIRCLE)[None])
    columns.strips(PRIOR_CIRCLE, circle)


def _draw_alternatives(columns: Columns, result: Localization) -> None:
    ghosts = np.zeros((0, 1, 3))
    if result.alternatives:
        outline = _frustum(result.camera, FRUSTUM_M / 2)
        poses = [one.T_camera_map.inverse() for one in result.alternatives]
        ghosts = np.stack([pose.apply(outline) for pose in poses])
    columns.strips(GHOSTS, Strips.of(ghosts))


def _frustum(camera: Camera, depth_m: float) -> FloatArray:
    """(11, 3) one strip through all edges of a camera's view, in camera coordinates."""
    right, bottom = camera.width - 0.5, camera.height - 0.5
    corners = camera.normalize(
        np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]])
    )
    points = np.concatenate([corners, np.ones((4, 1))], axis=1) * depth_m
    points = np.concatenate([points, np.zeros((1, 3))])
    return points[[0, 1, 2, 3, 0, 4, 1, 2, 4, 3, 4]]


def _draw_rays(columns: Columns, result: Localization, estimate: Pose | None) -> None:
    """From the estimated camera to each paired element, in the colour of its residual."""
    refinement = result.refinement
    rays, colors = np.zeros((0, 2, 3)), np.zeros(0, np.int64)
    if refinement is not None and estimate is not None:
        targets = result.submap.anchor_m[refinement.pairs[:, 1]]
        centers = np.broadcast_to(estimate.translation, targets.shape)
        rays = np.stack([centers, targets], axis=1)
        colors = residual_colors(np.hypot(*np.nan_to_num(refinement.residual_px).T))
    columns.strips(RAYS, Strips.of(rays), colors)


def _draw_matrix(columns: Columns, record: FrameRecord) -> None:
    """Rows and columns sorted by class, so that classes are blocks; the dustbins stay last."""
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
    place = np.stack([np.argsort(order)[pairs[:, 1]], np.argsort(rows)[pairs[:, 0]]], axis=1)
    where = place.astype(np.float64) + 0.5
    is_truth = np.arange(len(pairs)) < len(truth)
    columns.points(MATRIX, where, np.where(is_truth, rgba(TRUTH.dark), rgba(ESTIMATE.dark)))


def _true_pairs(element_id: IntArray, submap_id: IntArray) -> IntArray:
    """(k, 2) rows of observed and submap that are the same element."""
    pairs: IntArray = np.argwhere(element_id[:, None] == submap_id[None, :])
    return pairs
