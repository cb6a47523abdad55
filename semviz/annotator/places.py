"""Where label elements are in space, as far as their observations tell."""

import time
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from semviz.annotator.cameras import Cameras
from semviz.annotator.fit import best_ends
from semviz.annotator.ghosts import REACH_M
from semviz_annotation.labels import Labels, Observation
from semviz_annotation.triangulate import Failed, Triangulated, triangulate
from semviz_annotation.view import View, rig_view
from semviz_core.arrays import FloatArray

Place = Triangulated | Failed

ONE_VIEW = Failed("1 view; label it in a second image")
NEAR_M = REACH_M + 100.0
"""What is within reach of a camera, and was labelled up to 100 m away, was labelled by cameras this
near to it."""
KEPT = 8
"""Frames whose surroundings are kept: those on screen, of all pages."""
MANY = 100
"""Elements that differ; then it is not worth looking which frames show them."""
SLICE_S = 0.01
"""So long an answer waits for places that it does without."""


class Places:
    """Triangulates elements and keeps the results until their observations change.

    What a frame needs is placed at once, by ``near``. Of all the rest there may be many thousands:
    they are placed bit by bit, by ``settle``.
    """

    def __init__(self, cameras: Cameras) -> None:
        self._cameras = cameras
        poses = cameras.T_map_camera.items()
        posed = {one: pose for one, pose in poses if pose is not None}
        self._posed = np.array(list(posed), dtype=np.int64)
        self._centers_m = np.array([pose.translation for pose in posed.values()]).reshape(-1, 3)
        self._labels = Labels()
        self._stale: dict[str, None] = {}
        """Elements of the labels whose places are not known, or perhaps others by now."""
        self._seen: dict[str, tuple[Observation, ...]] = {}
        """What the places of elements were found from."""
        self._places: dict[str, Place] = {}
        self._mapped: dict[str, Triangulated] = {}
        self._ends: dict[str, FloatArray | None] = {}
        self._near: dict[int, Mapping[str, Triangulated]] = {}
        self._elements_in: dict[int, tuple[str, ...]] = {}
        """What is labelled in a frame, as far as it has been asked for."""
        self.version = 0
        """Another number when ``mapped`` may have changed."""

    def near(self, labels: Labels, frame_index: int) -> Mapping[str, Triangulated]:
        """The elements that have a place in the map frame, of those that can be in a frame's sight.

        They are those labelled by cameras within ``NEAR_M``, in this pass of the street or another.
        None where the frame has no pose.
        """
        self._follow(labels)
        if frame_index not in self._near:
            near: dict[str, Triangulated] = {}
            for element_id in self._labelled_near(frame_index):
                place = self._settled(element_id)
                if isinstance(place, Triangulated):
                    near[element_id] = place
            if len(self._near) >= KEPT:
                self._near.clear()
            self._near[frame_index] = near
        return self._near[frame_index]

    def centers_near(self, frame_index: int, reach_m: float) -> FloatArray:
        """(k, 3) cameras within a reach of that of a frame, which has a pose."""
        here = self._cameras.T_map_camera[frame_index]
        assert here is not None
        away_m = np.linalg.norm(self._centers_m - here.translation, axis=1)
        return np.asarray(self._centers_m[away_m <= reach_m])

    def mapped(self, labels: Labels) -> Mapping[str, Triangulated]:
        """The elements that have a place in the map frame, as far as they are settled, by id."""
        self.settle(labels)
        return self._mapped

    def settle(self, labels: Labels, seconds: float = SLICE_S) -> bool:
        """Places what is not placed yet, for so long; whether all is done."""
        self._follow(labels)
        end = time.monotonic() + seconds
        while self._stale and time.monotonic() < end:
            self._settled(next(iter(self._stale)))
        return not self._stale

    def of_element(self, labels: Labels, element_id: str) -> Place:
        """One element in the map frame."""
        self._follow(labels)
        return self._settled(element_id)

    def of_observations(self, observations: Sequence[Observation]) -> Place:
        """One element in the map frame, from the frames among ``observations`` that have poses."""
        posed = self.posed(observations)
        if len(posed) < 2:
            return ONE_VIEW
        return triangulate([self.view(one) for one in posed], posed)

    def best_ends(self, labels: Labels, element_id: str) -> FloatArray | None:
        """(2, 4) homogeneous, as ``fit.best_ends``, however narrow the rays; None for one view."""
        self._follow(labels)
        if element_id not in self._ends:
            posed = self.posed(labels.of_element(element_id))
            views = [self.view(one) for one in posed]
            self._ends[element_id] = best_ends(views, posed) if len(posed) > 1 else None
        return self._ends[element_id]

    def posed(self, observations: Iterable[Observation]) -> list[Observation]:
        """Those in frames that have a pose."""
        return [
            one
            for one in observations
            if self._cameras.T_map_camera.get(one.frame_index) is not None
        ]

    def of_pair(self, observations: Sequence[Observation]) -> Place:
        """One element in the coordinates of the left camera, from one frame's observations."""
        if len(observations) < 2:
            return ONE_VIEW
        return triangulate(
            [rig_view(self._cameras.rig, one.side) for one in observations], observations
        )

    def view(self, observation: Observation) -> View:
        """The camera of an observation."""
        return self._cameras.view(observation.frame_index, observation.side)

    def _follow(self, labels: Labels) -> None:
        """From now on places are those of ``labels``."""
        if labels is self._labels:
            return
        differing = sorted(labels.differing(self._labels))
        self._forget_frames(differing, labels)
        for element_id in differing:
            self._ends.pop(element_id, None)
            if element_id in labels.elements:
                self._stale[element_id] = None
            else:
                self._forget(element_id)
        self._labels = labels
        self._near.clear()

    def _forget_frames(self, differing: Sequence[str], labels: Labels) -> None:
        if len(differing) > MANY:
            self._elements_in.clear()
            return
        for element_id in differing:
            for state in (self._labels, labels):
                for row in state.of_element(element_id):
                    self._elements_in.pop(row.frame_index, None)

    def _forget(self, element_id: str) -> None:
        self.version += 1
        for known in (self._stale, self._seen, self._places, self._mapped):
            known.pop(element_id, None)

    def _settled(self, element_id: str) -> Place:
        if element_id in self._stale:
            observations = self._labels.of_element(element_id)
            if self._seen.get(element_id) != observations:
                self._put(element_id, self.of_observations(observations))
                self._seen[element_id] = observations
            del self._stale[element_id]
        return self._places.get(element_id, ONE_VIEW)

    def _put(self, element_id: str, place: Place) -> None:
        self.version += 1
        self._places[element_id] = place
        if isinstance(place, Triangulated):
            self._mapped[element_id] = place
        else:
            self._mapped.pop(element_id, None)

    def _labelled_near(self, frame_index: int) -> Iterable[str]:
        """Elements that are labelled in frames whose cameras are near, each once."""
        here = self._cameras.T_map_camera[frame_index]
        if here is None:
            return ()
        away_m = np.linalg.norm(self._centers_m - here.translation, axis=1)
        frames = self._posed[away_m <= NEAR_M].tolist()
        return dict.fromkeys(element_id for one in frames for element_id in self._labelled_in(one))

    def _labelled_in(self, frame_index: int) -> tuple[str, ...]:
        if frame_index not in self._elements_in:
            rows = self._labels.in_frame(frame_index)
            self._elements_in[frame_index] = tuple(dict.fromkeys(row.element_id for row in rows))
        return self._elements_in[frame_index]
