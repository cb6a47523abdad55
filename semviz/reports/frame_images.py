"""Draw a frame as SVG: the image, its detections, and the map under estimate and truth."""

import base64

import numpy as np

from semviz.presentation.plots import ESTIMATE, TRUTH
from semviz.reports.html import Html, element
from semviz.runs.images import Projected, project_elements
from semviz.runs.run import FrameRecord
from semviz_core.base.camera import Camera
from semviz_core.base.classes import ClassSet, ElementClass
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import decode_image

MAX_WIDTH_PX = 960
"""Maximum width of an image, because reports are sent by mail."""
JPEG_QUALITY = 75
CASING = "#0A0B0D"
"""Colour of the casing of every line, which contrasts with any image."""
SIGN_RADIUS_PX = 8.0
LETTER_PX = (8.5, 15.0)
"""Width of a letter and height of a line, in an image 1241 px wide."""
CORNERS = {
    "triangle": (3, -90.0),
    "square": (4, -45.0),
    "diamond": (4, -90.0),
    "pentagon": (5, -90.0),
}
"""Number of a glyph's corners, and direction of the first (deg; x right, y down)."""


def frame_svg(record: FrameRecord, image: bytes | None, classes: ClassSet, title: str) -> Html:
    """Return an ``svg`` element of the frame; ``image`` is JPEG or PNG, ``title`` is read aloud."""
    result, truth = record.localization, record.frame.T_map_camera
    width, height = result.camera.width, result.camera.height
    poses = (
        (None if truth is None else truth.inverse(), TRUTH.dark, 1.5),
        (result.T_camera_map, ESTIMATE.dark, 2.0),
    )
    maps = [_map(record, pose, classes, color, thick) for pose, color, thick in poses if pose]
    return element(
        "svg",
        _background(result.camera, image),
        *maps,
        *_detections(record, classes),
        viewBox=f"-0.5 -0.5 {width} {height}",
        class_="picture",
        role="img",
        aria_label=title,
    )


def _background(camera: Camera, image: bytes | None) -> Html:
    """Return the image, or a grey rectangle without one."""
    place = {"x": -0.5, "y": -0.5, "width": camera.width, "height": camera.height}
    if image is None:
        return element("rect", fill="#3A3D42", **place)
    encoded = base64.b64encode(_shrunk(image)).decode()
    return element("image", href=f"data:image/jpeg;base64,{encoded}", **place)


def _shrunk(encoded: bytes) -> bytes:
    import cv2

    try:
        image = decode_image(encoded, "image")
    except SemvizError:
        return encoded  # the browser may be able to decode it
    scale = min(MAX_WIDTH_PX / image.shape[1], 1.0)
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()


def _map(
    record: FrameRecord, T_camera_map: Pose, classes: ClassSet, color: str, width: float
) -> Html:
    """Return the submap projected from a pose, as one path."""
    result = record.localization
    projected: Projected = project_elements(result.submap, T_camera_map, result.camera)
    traces = [
        trace(
            classes[int(result.submap.class_id[row])],
            projected.anchor_px[row],
            projected.end_px[row],
        )
        for row in np.flatnonzero(projected.shown)
    ]
    return cased("".join(traces), color, width)


def _detections(record: FrameRecord, classes: ClassSet) -> list[Html]:
    """Return the detections in the colours of their classes, then the names of their matches."""
    observed = record.localization.observed
    lines = []
    for kind in classes:
        rows = np.flatnonzero(observed.class_id == kind.id)
        traces = [trace(kind, observed.anchor_px[row], observed.end_px[row]) for row in rows]
        lines.append(cased("".join(traces), kind.color, 3.0))
    return [*lines, *_labels(record, classes)]


def _labels(record: FrameRecord, classes: ClassSet) -> list[Html]:
    """Return names beside the detections, without those that would overlap."""
    result = record.localization
    taken = np.zeros((0, 2))
    labels = []
    for row, column in [] if result.refinement is None else result.refinement.pairs.tolist():
        name = classes.element_name(
            int(result.submap.class_id[column]), int(result.submap.id[column])
        )
        size = np.array([LETTER_PX[0] * len(name), LETTER_PX[1]])
        place = result.observed.anchor_px[row] + np.array([SIGN_RADIUS_PX + 4.0, 0.0])
        place = np.clip(
            place, [0.0, size[1]], [result.camera.width - size[0], result.camera.height]
        )
        if (np.abs(taken - place) < size).all(axis=1).any():
            continue
        taken = np.vstack([taken, place])
        labels.append(element("text", name, x=f"{place[0]:.1f}", y=f"{place[1]:.1f}"))
    return labels


def trace(kind: ElementClass, anchor: FloatArray, end: FloatArray) -> str:
    """Return path data: a pole's line with a cap at its peak, or a sign's glyph."""
    x, y = anchor
    if kind.kind == "line":
        return f"M{x - 4:.1f} {y:.1f}h8M{x:.1f} {y:.1f}L{end[0]:.1f} {end[1]:.1f}"
    if kind.shape == "circle":
        r = SIGN_RADIUS_PX
        return f"M{x - r:.1f} {y:.1f}a{r} {r} 0 1 0 {2 * r} 0a{r} {r} 0 1 0 {-2 * r} 0"
    count, first = CORNERS[kind.shape]
    angles = np.deg2rad(first + 360.0 / count * np.arange(count))
    corners = anchor + 1.15 * SIGN_RADIUS_PX * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return "M" + "L".join(f"{u:.1f} {v:.1f}" for u, v in corners) + "Z"


def cased(trace: str, color: str, width: float) -> Html:
    """Return a line with a dark casing."""
    rim = element("path", d=trace, stroke=CASING, stroke_width=width + 2.2)
    return element("g", rim, element("path", d=trace, stroke=color, stroke_width=width))
