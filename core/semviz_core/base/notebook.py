"""Show localizations, maps and runs in a notebook: a line of text and an inline picture."""

from collections.abc import Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from semviz_core.base.localization import Localization
    from semviz_core.base.semantic_map import SemanticMap
    from semviz_core.common.arrays import FloatArray

WIDTH, HEIGHT = 480, 300
_MARGIN = 12.0
_COLORS = {"ok": "#1f5fbf", "ambiguous": "#b8860b", "cannot": "#a02020"}
_FAINT, _MAPPED, _SEEN, _TRUTH = "#99999980", "#0072b2", "#d55e00", "#222222"


def drive_html(
    title: str,
    semantic_map: "SemanticMap",
    truth_m: Sequence["FloatArray"],
    estimates: Sequence[tuple["FloatArray", str]],
) -> str:
    """Return a map with the true way (3,), and estimated camera centres with their status."""
    content = _map_marks(semantic_map)
    content += _polyline([position[:2] for position in truth_m], _TRUTH)
    content += "".join(_dot(position, _COLORS[status], 3.0) for position, status in estimates)
    points = [truth_m, [position for position, _ in estimates]]
    return _figure(title, _from_above(content, semantic_map, points))


def map_html(semantic_map: "SemanticMap") -> str:
    """Return a map's elements by class, seen from above."""
    class_ids = semantic_map.elements.class_id.tolist()
    counts = ", ".join(f"{class_ids.count(each.id)} {each.name}" for each in semantic_map.classes)
    title = f"Map {semantic_map.frame.name}: {counts}"
    return _figure(title, _from_above(_map_marks(semantic_map), semantic_map, []))


def localization_html(result: "Localization") -> str:
    """Return status and reason, and the image plane: detections, and the map as projected."""
    camera, seen = result.camera, result.observed
    marks = [_segment(a, b, _SEEN, 3.0) for a, b in zip(seen.anchor_px, seen.end_px, strict=True)]
    if result.T_camera_map is not None and result.refinement is not None:
        mapped = result.submap[np.unique(result.refinement.pairs[:, 1])]
        ends = [
            camera.project(result.T_camera_map.apply(points))
            for points in (mapped.anchor_m, mapped.end_m)
        ]
        marks += [_segment(a, b, _MAPPED, 1.5) for a, b in zip(*ends, strict=True)]
    scale = WIDTH / camera.width
    size = f'width="{WIDTH}" height="{camera.height * scale:.0f}"'
    view = f'viewBox="0 0 {camera.width} {camera.height}"'
    frame = f'<rect width="{camera.width}" height="{camera.height}" fill="#8881" stroke="#888"/>'
    picture = f"<svg {size} {view}>{frame}{''.join(marks)}</svg>"
    title = f"{result.status}: {result.reason} Orange: detected; blue: the map at this pose."
    return _figure(title, picture)


def _figure(title: str, picture: str) -> str:
    return f"<div><div>{escape(title)}</div>{picture}</div>"


def _map_marks(semantic_map: "SemanticMap") -> str:
    elements = semantic_map.elements
    road = _polyline(semantic_map.trajectory_m[:, :2], _FAINT)
    colors = {each.id: each.color_light for each in semantic_map.classes}
    marks = (
        _dot(anchor, colors[class_id], 2.0)
        for anchor, class_id in zip(elements.anchor_m, elements.class_id.tolist(), strict=True)
    )
    return road + "".join(marks)


def _from_above(content: str, semantic_map: "SemanticMap", points: list[Any]) -> str:
    """Return a drawing in map metres, y up, that shows the map and points (k, 3)."""
    groups = [semantic_map.elements.anchor_m, semantic_map.trajectory_m, *points]
    every = np.concatenate([np.reshape(group, (-1, 3))[:, :2] for group in groups])
    low = every.min(axis=0) if len(every) else np.zeros(2)
    high = every.max(axis=0) if len(every) else np.ones(2)
    scale = float(min((np.array([WIDTH, HEIGHT]) - 2.0 * _MARGIN) / np.maximum(high - low, 1.0)))
    x, y = _MARGIN - scale * low[0], _MARGIN + scale * high[1]
    style = f"--r:{1.0 / scale:.4g}"
    place = f'transform="matrix({scale:.6g} 0 0 {-scale:.6g} {x:.2f} {y:.2f})" style="{style}"'
    return f'<svg width="{WIDTH}" height="{HEIGHT}"><g {place}>{content}</g></svg>'


def _dot(position: "FloatArray", color: str, radius_px: float) -> str:
    at = f'cx="{position[0]:.2f}" cy="{position[1]:.2f}"'
    return f'<circle {at} style="r:calc({radius_px:g}px*var(--r))" fill="{color}"/>'


def _polyline(points: Iterable[Any], color: str) -> str:
    text = " ".join(f"{x:.2f},{y:.2f}" for x, y in points)
    line = f'stroke="{color}" vector-effect="non-scaling-stroke"'
    return f'<polyline points="{text}" fill="none" {line}/>'


def _segment(anchor: "FloatArray", end: "FloatArray", color: str, width: float) -> str:
    """Return a pole, or a ring for a sign, in pixels."""
    if not np.isfinite(anchor).all():
        return ""
    (u, v) = anchor
    if not np.isfinite(end).all():
        ring = f'stroke="{color}" stroke-width="{width}" fill="none"'
        return f'<circle cx="{u:.1f}" cy="{v:.1f}" r="8" {ring}/>'
    line = f'stroke="{color}" stroke-width="{width}"'
    return f'<line x1="{u:.1f}" y1="{v:.1f}" x2="{end[0]:.1f}" y2="{end[1]:.1f}" {line}/>'
