"""Select what the 3D scene shows: elements triangulated so far, and open tracks of detections."""

from collections.abc import Callable, Iterable

import numpy as np

from semviz.annotator.detection_tracks import DetectionTrack, OpenTracks
from semviz.annotator.element_positions import ElementPositions
from semviz_annotation.labels.labels import Labels
from semviz_core.base.elements import Elements3D


class SceneElements:
    """The contents of the 3D scene; the same objects until they change. One thread at a time."""

    def __init__(
        self,
        labels: Callable[[], Labels],
        positions: ElementPositions,
        tracks: Callable[[], OpenTracks],
    ) -> None:
        self._labels = labels
        self._positions = positions
        self._last_tracks = tracks
        nothing = Elements3D.from_ends([], [], [], [])
        self._elements = -1, -1, nothing
        """As of this operation and version of the positions."""
        self._tracks: tuple[tuple[int, ...], Elements3D] = (), nothing
        """Those in these places."""

    def elements(self) -> Elements3D:
        """Return the elements triangulated so far, their numbers as ids, except those left out."""
        labels = self._labels()
        mapped = self._positions.mapped(labels)
        if self._elements[:2] != (labels.operation, self._positions.version):
            kept = {id_: at for id_, at in mapped.items() if not labels.is_left_out(id_)}
            elements = [labels.elements[element_id] for element_id in kept]
            shown = Elements3D.from_ends(
                [element.number for element in elements],
                [position.anchor_m for position in kept.values()],
                [position.end_m for position in kept.values()],
                [element.class_id for element in elements],
            )
            self._elements = labels.operation, self._positions.version, shown
        return self._elements[2]

    def tracks(self) -> Elements3D:
        """Return the open tracks as elements of the last map; their ids are places in
        ``track_at``."""
        tracks = self._last_tracks()
        places = tracks.places(self._labels())
        if self._tracks[0] is not places:
            rows = np.array(places, dtype=np.int64)
            self._tracks = places, tracks.tracks.elements[rows]
        return self._tracks[1]

    def open_tracks(self, element_ids: Iterable[str]) -> list[tuple[int, DetectionTrack]]:
        """Return the open tracks among some elements, with their places."""
        return self._last_tracks().named(element_ids, self._labels())

    def track_at(self, place: int) -> DetectionTrack:
        """Return a track of the last map by its place; raise IndexError if there is none."""
        return self._last_tracks().tracks.tracks[place]
