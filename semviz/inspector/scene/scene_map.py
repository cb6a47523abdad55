"""Draw the run's map in 3D: elements, colours, ellipsoids and the forecast.

Near elements are glyphs, far ones strokes, so that a city renders fast. Colours show class,
residual or usage. Ellipsoids magnify 1 sigma at both ends of poles and at the centre of signs.
The forecast is a band along the route, hatched where ambiguous.
"""

from dataclasses import dataclass

import numpy as np

from semviz.inspector.state import MapColors
from semviz.inspector.views import MapColorLevel, MapLegend
from semviz.presentation import plots
from semviz.runs.frame_table import frame_table
from semviz.runs.run import Run
from semviz.web import shapes
from semviz.web.scene import CAMERA_HEIGHT_M, ElementStyle, SceneDrawer, class_rows, elements_ends
from semviz.web.shapes import PALETTES, Theme, mix
from semviz.web.viewpoint import Pickable, Picker
from semviz.workspace.localization.localizability import AMBIGUOUS_SHARE
from semviz_core.base.classes import ClassSet
from semviz_core.base.elements import Elements3D
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.localizability.expected_error import Effect
from semviz_core.localizability.predict import LIMITS_M, Localizability
from semviz_core.localizability.route import GAP_M


@dataclass(frozen=True, eq=False)
class Usage:
    """How a run uses the n elements of its map."""

    times: IntArray
    """(n,) number of frames whose estimate uses it."""
    residual_px: FloatArray
    """(n,) median length of its residuals in those frames; NaN without any."""


def usage_of(run: Run) -> Usage:
    """Count the inliers of each element over all frames."""
    ids = run.semantic_map.elements.id
    order = np.argsort(ids)
    used, sizes = _inliers(run)
    rows = order[np.searchsorted(ids, used, sorter=order)]
    times = np.bincount(rows, minlength=len(ids)).astype(np.int64)
    residual_px = np.full(len(ids), np.nan)
    ordered = sizes[np.lexsort((sizes, rows))]
    known = np.flatnonzero(times)
    first, last = (np.cumsum(times) - times)[known], np.cumsum(times)[known] - 1
    low, high = first + (last - first) // 2, last - (last - first) // 2
    residual_px[known] = (ordered[low] + ordered[high]) / 2
    return Usage(times, residual_px)


def _inliers(run: Run) -> tuple[IntArray, FloatArray]:
    """Return the element's id and the length of the residual (px) of every inlier."""
    table = frame_table(run)
    return table.pair_id[table.pair_inlier], table.pair_px[table.pair_inlier]


FAINT = 0.45
"""Colour strength of elements outside the submap, if colours show the class."""
FAINT_PX = 1.0
WIDTHS_PX = (1.4, 1.8, 2.2, 2.7, 3.2)
"""Line widths by level, which repeat what the colour shows."""
UNUSED_PX = 1.0


@dataclass(frozen=True, eq=False)
class Coloring:
    """A style for each of the n elements of a map."""

    styles: tuple[ElementStyle, ...]
    style_of: IntArray
    """(n,) index of each element's style."""


def coloring(
    colors: MapColors, semantic_map: SemanticMap, usage: Usage, scene: SceneDrawer
) -> Coloring:
    """Return the styles of the map. Unless by class, the last style is for unused elements."""
    if colors == "class":
        rows = class_rows(semantic_map.elements.class_id, semantic_map.classes)
        return Coloring(scene.class_styles(semantic_map.classes, FAINT, FAINT_PX), rows)
    unused = ElementStyle(_unused_color(scene.theme), UNUSED_PX)
    ramp = zip(_ramp(colors, scene.theme), WIDTHS_PX, strict=True)
    styles = [ElementStyle(color, width) for color, width in ramp]
    return Coloring((*styles, unused), levels(colors, usage))


def levels(colors: MapColors, usage: Usage) -> IntArray:
    """Return (n,) level of each element; the number of levels for unused elements."""
    if colors == "residual":
        level = plots.residual_level(usage.residual_px)
    else:
        level = np.searchsorted(plots.USED_LIMITS, usage.times, side="left").astype(np.int64)
    return np.where(usage.times == 0, len(WIDTHS_PX), level)


def legend(colors: MapColors, usage: Usage, theme: Theme) -> MapLegend:
    """Return colour, width, range and number of elements of each level."""
    if colors == "class":
        return MapLegend(by=colors, levels=())
    level = levels(colors, usage)
    limits = plots.RESIDUAL_LIMITS_PX if colors == "residual" else plots.USED_LIMITS
    names = _residual_ranges(limits) if colors == "residual" else _count_ranges()
    used = [
        MapColorLevel(color=color, width=width, name=name, elements=int((level == number).sum()))
        for number, (color, width, name) in enumerate(
            zip(_ramp(colors, theme), WIDTHS_PX, names, strict=True)
        )
    ]
    count = int((usage.times == 0).sum())
    unused = MapColorLevel(
        color=_unused_color(theme), width=UNUSED_PX, name="never", elements=count
    )
    return MapLegend(by=colors, levels=(*used, unused))


def _residual_ranges(limits: tuple[float, ...]) -> list[str]:
    lows = (0.0, *limits[:-1])
    return [f"{low:g}-{high:g}" for low, high in zip(lows, limits, strict=True)] + [
        f"over {limits[-1]:g}"
    ]


def _count_ranges() -> list[str]:
    lows = (1, *(limit + 1 for limit in plots.USED_LIMITS[:-1]))
    names = [f"{low}-{high}" for low, high in zip(lows, plots.USED_LIMITS, strict=True)]
    return [*names, f"over {plots.USED_LIMITS[-1]}"]


def _ramp(colors: MapColors, theme: Theme) -> tuple[str, ...]:
    tones = plots.RESIDUAL if colors == "residual" else plots.USED
    return tuple(tone.dark if theme == "dark" else tone.light for tone in tones)


def _unused_color(theme: Theme) -> str:
    palette = PALETTES[theme]
    return mix(palette.faint, palette.scene, 0.5)


MAX_GLYPHS = 600
"""Number of nearest elements drawn as glyphs: more are slow without a GPU."""
REDRAW_M = 50.0
"""The nearest elements are chosen again after this distance."""


class MapLayer:
    """Draws one map and makes its elements pickable."""

    def __init__(
        self, scene: SceneDrawer, picker: Picker, semantic_map: SemanticMap, route_m: FloatArray
    ) -> None:
        self._scene = scene
        self._map = semantic_map
        elements = semantic_map.elements
        low, high = elements_ends(elements)
        self.centers_m = (low + high) / 2
        """(n, 3)"""
        self._facing = shapes.facing(elements.anchor_m, route_m)
        self._by_id = np.argsort(elements.id)
        self._center_m: FloatArray | None = None
        self._coloring: Coloring | None = None
        picker.set_pickable("element", Pickable(elements.id, low, high))

    def draw(self, around_m: FloatArray, coloring: Coloring) -> None:
        """Draw the whole map, with glyphs around a point (3,), unless that is drawn already."""
        moved_m = np.inf if self._center_m is None else np.linalg.norm(around_m - self._center_m)
        if coloring is self._coloring and (self._is_small or moved_m < REDRAW_M):
            return
        if coloring is not self._coloring and not self._is_small:  # under the glyphs, too
            self._scene.draw_far("/far", self._map.elements, coloring.styles, coloring.style_of)
        self._center_m, self._coloring = around_m, coloring
        near = self._near(around_m)
        elements = self._map.elements
        self._scene.draw_elements(
            "/map",
            elements[near],
            self._map.classes,
            self._facing[near],
            coloring.styles,
            coloring.style_of[near],
        )

    def draw_submap(self, submap: Elements3D) -> None:
        """Draw the solver's submap by class, stronger than the rest."""
        classes = self._map.classes
        self._scene.draw_elements(
            "/submap",
            submap,
            classes,
            self._facing[self.rows(submap)],
            self._scene.class_styles(classes),
            class_rows(submap.class_id, classes),
        )

    def rows(self, elements: Elements3D) -> IntArray:
        """Return (k,) the rows of k elements in the map."""
        ids = self._map.elements.id
        indices = np.searchsorted(ids, elements.id, sorter=self._by_id).clip(max=len(ids) - 1)
        rows: IntArray = self._by_id[indices]
        return rows

    @property
    def _is_small(self) -> bool:
        return len(self._map) <= MAX_GLYPHS

    def _near(self, around_m: FloatArray) -> IntArray:
        """Return the rows of the elements nearest to a point (3,) on the ground plane, in order."""
        if self._is_small:
            return np.arange(len(self._map))
        distance_m = np.linalg.norm(self.centers_m[:, :2] - around_m[:2], axis=1)
        nearest: IntArray = np.argpartition(distance_m, MAX_GLYPHS)[:MAX_GLYPHS]
        return np.sort(nearest)


ELLIPSOID_SCALE = 10.0
"""Scale of ellipsoids: 1 sigma of an element is a few centimetres."""
ELLIPSOIDS = "/ellipsoids"


def draw_ellipsoids(scene: SceneDrawer, elements: Elements3D) -> None:
    """Draw 1 sigma, magnified, at both ends of poles and at the centre of signs."""
    lines = np.flatnonzero(elements.is_line)
    covariances = elements.covariance_m2
    scene.draw_ellipsoids(
        ELLIPSOIDS,
        np.concatenate([elements.anchor_m, elements.end_m[lines]]),
        np.concatenate([covariances[:, :3, :3], covariances[lines, 3:, 3:]]),
        ELLIPSOID_SCALE,
        scene.palette.prior,
    )


WIDTHS_M = (0.6, 1.2, 2.2, 3.6, 5.5)
"""Widths of the band by level, which repeat what the colour shows."""
FORECAST = "/forecast"
"""Prefix of its names in the scene."""
ABOVE_ROAD_M = 0.08
HATCH_M = 6.0
"""Length of the strokes across the band where poses are ambiguous."""


def draw_forecast(scene: SceneDrawer, predicted: Localizability, classes: ClassSet) -> None:
    """Draw a forecast in place of the previous one."""
    scene.remove_under(FORECAST)
    track_m = np.array([pose.translation for pose in predicted.T_map_camera])
    track_m = track_m - [0.0, 0.0, CAMERA_HEIGHT_M - ABOVE_ROAD_M]
    if len(track_m) > 1:
        levels = _levels(predicted, track_m)
        for level, color in enumerate(scene.palette.residual):
            rows = np.flatnonzero(levels == level)
            scene.draw_band(f"{FORECAST}-{level}", track_m, rows, WIDTHS_M[level], color)
        tone = plots.STATUS["ambiguous"]
        color = tone.dark if scene.theme == "dark" else tone.light
        scene.draw_lines(f"{FORECAST}-hatch", _hatch(predicted, track_m), color, 2.0)
    for number, effect in enumerate(predicted.suggested, start=1):
        _draw_suggested(scene, number, effect, classes)


def _levels(predicted: Localizability, track_m: FloatArray) -> IntArray:
    """Return (k - 1,) level of each segment: the worse of its two positions; -1 across gaps."""
    worse = np.maximum(predicted.expected_m[:-1], predicted.expected_m[1:])
    levels = np.searchsorted(LIMITS_M, worse, side="right").astype(np.int64)
    gap = np.linalg.norm(np.diff(track_m, axis=0), axis=1) > GAP_M
    return np.where(gap, -1, levels)


def _hatch(predicted: Localizability, track_m: FloatArray) -> FloatArray:
    """Return (h, 2, 3) strokes across the route at positions that are mostly ambiguous."""
    rows = np.flatnonzero(predicted.ambiguous >= AMBIGUOUS_SHARE)
    right = np.array([predicted.T_map_camera[row].rotation[:, 0] for row in rows]).reshape(-1, 3)
    slant = np.array([predicted.T_map_camera[row].rotation[:, 2] for row in rows]).reshape(-1, 3)
    half = 0.5 * HATCH_M * (right + 0.4 * slant) * [1.0, 1.0, 0.0]
    middle = track_m[rows] + [0.0, 0.0, 0.05]
    return np.stack([middle - half, middle + half], axis=1)


def _draw_suggested(scene: SceneDrawer, number: int, effect: Effect, classes: ClassSet) -> None:
    """Draw a suggested element, dashed, with its number in the legend."""
    class_ = classes[int(effect.element.class_id[0])]
    if class_.kind == "line":
        segments, name = shapes.pole_segments(effect.element), "pole"
    else:
        segments, name = shapes.sign_segments(effect.element, class_.shape, np.zeros(1)), "sign"
    color = class_.color if scene.theme == "dark" else class_.color_light
    scene.draw_lines(f"{FORECAST}-new-{number}", segments, color, 2.4, (0.35, 0.25))
    top = effect.element.anchor_m[0] + [0.0, 0.0, 0.9]
    scene.draw_label(f"{FORECAST}-new-{number}-label", f"new {name} {number}", top)
