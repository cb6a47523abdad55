"""A frame as a picture: the image, what was seen, and the map under estimate and truth."""

import base64

import numpy as np

from semviz.palette import ESTIMATE, TRUTH
from semviz.projection import Projected, project_elements
from semviz.recording.run import FrameRecord
from semviz.reporting.html import Html, element
from semviz_core.arrays import FloatArray
from semviz_core.camera import Camera
from semviz_core.classes import ClassSet, ElementClass
from semviz_core.pose import Pose

WIDEST_PX = 960
"""Images are made smaller than this: a report is mailed."""
JPEG_QUALITY = 75
CASING = "#0A0B0D"
"""Under every line, so that it stands out from any image."""
SIGN_RADIUS_PX = 8.0
LETTER_PX = (8.5, 15.0)
"""Width of a letter and height of a line, in a picture 1241 px wide."""
CORNERS = {
    "triangle": (3, -90.0),
    "square": (4, -45.0),
    "diamond": (4, -90.0),
    "pentagon": (5, -90.0),
}
"""Of a glyph: how many, and the direction of the first (deg, right and down)."""


def picture(record: FrameRecord, image: bytes | None, classes: ClassSet, about: str) -> Html:
    """An ``svg`` element as large as the frame's image, which is JPEG or PNG.

    ``about`` says what it shows to who cannot see.
    """
    one, truth = record.localization, record.frame.T_map_camera
    width, height = one.camera.width, one.camera.height
    poses = (
        (None if truth is None else truth.inverse(), TRUTH.dark, 1.5),
        (one.T_camera_map, ESTIMATE.dark, 2.0),
    )
    maps = [_map(record, pose, classes, color, thick) for pose, color, thick in poses if pose]
    return element(
        "svg",
        _ground(one.camera, image),
        *maps,
        *_seen(record, classes),
        viewBox=f"-0.5 -0.5 {width} {height}",
        class_="picture",
        role="img",
        aria_label=about,
    )


def _ground(camera: Camera, image: bytes | None) -> Html:
    """The image, or grey where there is none."""
    place = {"x": -0.5, "y": -0.5, "width": camera.width, "height": camera.height}
    if image is None:
        return element("rect", fill="#3A3D42", **place)
    encoded = base64.b64encode(_smaller(image)).decode()
    return element("image", href=f"data:image/jpeg;base64,{encoded}", **place)


def _smaller(encoded: bytes) -> bytes:
    import cv2

    image = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        return encoded  # what it is, the browser may know
    scale = min(WIDEST_PX / image.shape[1], 1.0)
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()


def _map(
    record: FrameRecord, T_camera_map: Pose, classes: ClassSet, color: str, width: float
) -> Html:
    """The submap as seen from a pose, as one line."""
    one = record.localization
    seen: Projected = project_elements(one.submap, T_camera_map, one.camera)
    traces = [
        trace(classes[int(one.submap.class_id[row])], seen.anchor_px[row], seen.end_px[row])
        for row in np.flatnonzero(seen.shown)
    ]
    return cased("".join(traces), color, width)


def _seen(record: FrameRecord, classes: ClassSet) -> list[Html]:
    """Detections in the colours of their classes, then the names of what they were taken for."""
    seen = record.localization.observed
    lines = []
    for kind in classes:
        rows = np.flatnonzero(seen.class_id == kind.id)
        traces = [trace(kind, seen.anchor_px[row], seen.end_px[row]) for row in rows]
        lines.append(cased("".join(traces), kind.color, 3.0))
    return [*lines, *_labels(record, classes)]


def _labels(record: FrameRecord, classes: ClassSet) -> list[Html]:
    """Names beside the detections; one that would lie on another is left out."""
    one = record.localization
    taken = np.zeros((0, 2))
    labels = []
    for row, column in [] if one.refinement is None else one.refinement.pairs.tolist():
        name = classes.element_name(int(one.submap.class_id[column]), int(one.submap.id[column]))
        size = np.array([LETTER_PX[0] * len(name), LETTER_PX[1]])
        place = one.observed.anchor_px[row] + np.array([SIGN_RADIUS_PX + 4.0, 0.0])
        place = np.clip(place, [0.0, size[1]], [one.camera.width - size[0], one.camera.height])
        if (np.abs(taken - place) < size).all(axis=1).any():
            continue
        taken = np.vstack([taken, place])
        labels.append(element("text", name, x=f"{place[0]:.1f}", y=f"{place[1]:.1f}"))
    return labels


def trace(kind: ElementClass, anchor: FloatArray, end: FloatArray) -> str:
    """Path data: a pole's line with a cap at its peak, or a sign's glyph."""
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
    """A line with a dark rim."""
    rim = element("path", d=trace, stroke=CASING, stroke_width=width + 2.2)
    return element("g", rim, element("path", d=trace, stroke=color, stroke_width=width))
