"""The run's map: what is near with glyphs, what is far as strokes, so that a city stays fluid."""

import numpy as np

from semviz.inspector.scene.coloring import Coloring
from semviz.web import shapes
from semviz.web.picking import Offer, Picker
from semviz.web.scene import Scene, class_rows, elements_ends
from semviz_core.arrays import FloatArray, IntArray
from semviz_core.elements import Elements3D
from semviz_core.semantic_map import SemanticMap

DRAWN_WHOLE = 600
"""So many elements, those nearest to the frame, have glyphs: more are slow without a GPU."""
MOVED_M = 50.0
"""The nearest are chosen anew when the frame is so far from where they were."""


class MapLayer:
    """Draws one map, and is clicked."""

    def __init__(
        self, scene: Scene, picker: Picker, semantic_map: SemanticMap, route_m: FloatArray
    ) -> None:
        self._scene = scene
        self._map = semantic_map
        elements = semantic_map.elements
        low, high = elements_ends(elements)
        self.middles_m = (low + high) / 2
        """(n, 3)"""
        self._facing = shapes.facing(elements.anchor_m, route_m)
        self._by_id = np.argsort(elements.id)
        self._center_m: FloatArray | None = None
        self._coloring: Coloring | None = None
        picker.offer("element", Offer(elements.id, low, high))

    def draw(self, around_m: FloatArray, coloring: Coloring) -> None:
        """The whole map, in detail around (3,); nothing where that is drawn already."""
        moved_m = np.inf if self._center_m is None else np.linalg.norm(around_m - self._center_m)
        if coloring is self._coloring and (self._is_small or moved_m < MOVED_M):
            return
        if coloring is not self._coloring and not self._is_small:  # under the nearest, too
            self._scene.draw_far("/far", self._map.elements, coloring.looks, coloring.look_of)
        self._center_m, self._coloring = around_m, coloring
        near = self._near(around_m)
        elements = self._map.elements
        self._scene.draw_elements(
            "/map",
            elements[near],
            self._map.classes,
            self._facing[near],
            coloring.looks,
            coloring.look_of[near],
        )

    def draw_submap(self, submap: Elements3D) -> None:
        """What was given to the solver, by class, stronger than the rest."""
        classes = self._map.classes
        self._scene.draw_elements(
            "/submap",
            submap,
            classes,
            self._facing[self.rows(submap)],
            self._scene.class_looks(classes),
            class_rows(submap.class_id, classes),
        )

    def rows(self, elements: Elements3D) -> IntArray:
        """(k,) rows of the map that some of its elements are."""
        ids = self._map.elements.id
        found = np.searchsorted(ids, elements.id, sorter=self._by_id).clip(max=len(ids) - 1)
        rows: IntArray = self._by_id[found]
        return rows

    @property
    def _is_small(self) -> bool:
        return len(self._map) <= DRAWN_WHOLE

    def _near(self, around_m: FloatArray) -> IntArray:
        """Rows of the elements nearest to (3,) on the ground plane, in order."""
        if self._is_small:
            return np.arange(len(self._map))
        away = np.linalg.norm(self.middles_m[:, :2] - around_m[:2], axis=1)
        nearest: IntArray = np.argpartition(away, DRAWN_WHOLE)[:DRAWN_WHOLE]
        return np.sort(nearest)
