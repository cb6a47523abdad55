"""Where label elements are in space, as far as their observations tell."""

from collections.abc import Iterable, Mapping, Sequence

from semviz.annotator.fit import best_ends
from semviz_annotation.labels import Labels, Observation
from semviz_annotation.triangulate import Failed, Triangulated, triangulate
from semviz_annotation.view import View, rig_view
from semviz_core.arrays import FloatArray
from semviz_core.camera import Rig
from semviz_core.frame import Frame
from semviz_core.pose import Pose

Place = Triangulated | Failed

ONE_VIEW = Failed("1 view; label it in a second image")


class Places:
    """Triangulates elements and keeps the results until their observations change."""

    def __init__(self, rig: Rig, frames: Iterable[Frame]) -> None:
        self._rig = rig
        self._T_camera_map = {
            frame.index: None if frame.T_map_camera is None else frame.T_map_camera.inverse()
            for frame in frames
        }
        self._labels = Labels()
        self._mapped: dict[str, Triangulated] = {}
        self._known: dict[str, tuple[tuple[Observation, ...], Place]] = {}
        self._ends: dict[str, tuple[tuple[Observation, ...], FloatArray | None]] = {}

    def mapped(self, labels: Labels) -> Mapping[str, Triangulated]:
        """The elements of ``labels`` that have a place in the map frame, by id."""
        if labels is not self._labels:
            places = {one: self.of_element(labels, one) for one in labels.elements}
            self._labels = labels
            self._mapped = {
                one: place for one, place in places.items() if isinstance(place, Triangulated)
            }
        return self._mapped

    def of_element(self, labels: Labels, element_id: str) -> Place:
        """One element in the map frame."""
        observations = labels.of_element(element_id)
        known = self._known.get(element_id)
        if known is None or known[0] != observations:
            known = observations, self.of_observations(observations)
            self._known[element_id] = known
        return known[1]

    def of_observations(self, observations: Sequence[Observation]) -> Place:
        """One element in the map frame, from the frames among ``observations`` that have poses."""
        posed = self.posed(observations)
        if len(posed) < 2:
            return ONE_VIEW
        return triangulate([self.view(one) for one in posed], posed)

    def best_ends(self, labels: Labels, element_id: str) -> FloatArray | None:
        """(2, 4) homogeneous, as ``fit.best_ends``, however narrow the rays; None for one view."""
        observations = labels.of_element(element_id)
        known = self._ends.get(element_id)
        if known is None or known[0] != observations:
            posed = self.posed(observations)
            views = [self.view(one) for one in posed]
            known = observations, best_ends(views, posed) if len(posed) > 1 else None
            self._ends[element_id] = known
        return known[1]

    def posed(self, observations: Iterable[Observation]) -> list[Observation]:
        """Those in frames that have a pose."""
        return [one for one in observations if self._T_camera_map[one.frame_index] is not None]

    def of_pair(self, observations: Sequence[Observation]) -> Place:
        """One element in the coordinates of the left camera, from one frame's observations."""
        if len(observations) < 2:
            return ONE_VIEW
        return triangulate([rig_view(self._rig, one.side) for one in observations], observations)

    def view(self, observation: Observation) -> View:
        """The camera of an observation, in the map frame (in its left camera's without a pose)."""
        return rig_view(self._rig, observation.side, self.T_camera_map(observation.frame_index))

    def T_camera_map(self, frame_index: int) -> Pose | None:  # noqa: N802 - the frames' names
        """Pose of a frame's left camera; None where it is not known."""
        return self._T_camera_map[frame_index]
