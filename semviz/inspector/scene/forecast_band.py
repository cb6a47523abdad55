"""The forecast in 3D: a band along the route, hatched where ambiguous, and elements to put up."""

import numpy as np

from semviz.localizability_report import AMBIGUOUS_SHARE
from semviz.palette import STATUS
from semviz.web import shapes
from semviz.web.scene import CAMERA_HEIGHT_M, Scene
from semviz_core.arrays import FloatArray, IntArray
from semviz_core.classes import ClassSet
from semviz_core.localizability.effects import Effect
from semviz_core.localizability.predict import LIMITS_M, Localizability
from semviz_core.localizability.route import GAP_M

WIDTHS_M = (0.6, 1.2, 2.2, 3.6, 5.5)
"""Of the band, by level: the width says what the colour says."""
FORECAST = "/forecast"
"""All names of it in the scene begin so."""
ABOVE_ROAD_M = 0.08
HATCH_M = 6.0
"""Length of the strokes across the band where it is ambiguous."""


def draw_forecast(scene: Scene, predicted: Localizability, classes: ClassSet) -> None:
    """Replaces what was drawn of a forecast before."""
    scene.remove_under(FORECAST)
    track_m = np.array([pose.translation for pose in predicted.T_map_camera])
    track_m = track_m - [0.0, 0.0, CAMERA_HEIGHT_M - ABOVE_ROAD_M]
    if len(track_m) > 1:
        levels = _levels(predicted, track_m)
        for level, color in enumerate(scene.palette.residual):
            rows = np.flatnonzero(levels == level)
            scene.draw_band(f"{FORECAST}-{level}", track_m, rows, WIDTHS_M[level], color)
        tone = STATUS["ambiguous"]
        color = tone.dark if scene.theme == "dark" else tone.light
        scene.draw_lines(f"{FORECAST}-hatch", _hatch(predicted, track_m), color, 2.0)
    for number, effect in enumerate(predicted.suggested, start=1):
        _draw_new(scene, number, effect, classes)


def _levels(predicted: Localizability, track_m: FloatArray) -> IntArray:
    """(k - 1,) level of each piece between two positions, the worse of both; -1 across gaps."""
    worse = np.maximum(predicted.expected_m[:-1], predicted.expected_m[1:])
    levels = np.searchsorted(LIMITS_M, worse, side="right").astype(np.int64)
    gap = np.linalg.norm(np.diff(track_m, axis=0), axis=1) > GAP_M
    return np.where(gap, -1, levels)


def _hatch(predicted: Localizability, track_m: FloatArray) -> FloatArray:
    """(h, 2, 3) strokes across the route at positions that are mostly ambiguous."""
    rows = np.flatnonzero(predicted.ambiguous >= AMBIGUOUS_SHARE)
    right = np.array([predicted.T_map_camera[row].rotation[:, 0] for row in rows]).reshape(-1, 3)
    slant = np.array([predicted.T_map_camera[row].rotation[:, 2] for row in rows]).reshape(-1, 3)
    half = 0.5 * HATCH_M * (right + 0.4 * slant) * [1.0, 1.0, 0.0]
    middle = track_m[rows] + [0.0, 0.0, 0.05]
    return np.stack([middle - half, middle + half], axis=1)


def _draw_new(scene: Scene, number: int, effect: Effect, classes: ClassSet) -> None:
    """A dashed element, as it is not there yet, under its number in the legend."""
    one = classes[int(effect.element.class_id[0])]
    if one.kind == "line":
        segments, what = shapes.pole_segments(effect.element), "pole"
    else:
        segments, what = shapes.sign_segments(effect.element, one.shape, np.zeros(1)), "sign"
    color = one.color if scene.theme == "dark" else one.color_light
    scene.draw_lines(f"{FORECAST}-new-{number}", segments, color, 2.4, (0.35, 0.25))
    top = effect.element.anchor_m[0] + [0.0, 0.0, 0.9]
    scene.draw_label(f"{FORECAST}-new-{number}-label", f"new {what} {number}", top)
