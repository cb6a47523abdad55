"""Images of which is known what they show: rendered streets, and what people labelled."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from semviz.annotator.cameras import Cameras
from semviz.annotator.ghosts import Ghost, ghosts_in
from semviz.annotator.places import Places
from semviz.workspace import Workspace
from semviz_annotation.labels import Labels, Observation, proposal_id
from semviz_annotation.observe import observe
from semviz_annotation.triangulate import Triangulated
from semviz_core.arrays import ByteImage, FloatArray
from semviz_core.elements import Elements2D, joined
from semviz_core.errors import SemvizError
from semviz_core.evaluation.detection import HELD_OUT_SEED, REACH_M, Truth
from semviz_core.evaluation.street_truth import street_truth
from semviz_core.sources.source import Side
from semviz_core.sources.street.street import Street


@dataclass(frozen=True, eq=False)
class KnownImage:
    """An image and its truth, made or read when they are asked for."""

    place: str
    """The street or workspace."""
    frame_index: int
    side: Side
    read: Callable[[], ByteImage]
    """SemvizError where it cannot be read."""
    truth: Callable[[], Truth]
    is_complete: bool = True
    """Nothing but its truth is there, as far as anybody knows."""

    @property
    def name(self) -> str:
        return f"{self.place}, frame {self.frame_index}, {self.side}"


def street_images(
    streets: int, frames_a_street: int, sides: Sequence[Side], reach_m: float = REACH_M
) -> tuple[KnownImage, ...]:
    """Of the first ``streets`` streets that nothing is trained or tuned on, spread evenly."""
    return tuple(
        KnownImage(
            street.map_frame.name,
            index,
            side,
            partial(street.image, index, side),
            partial(street_truth, street, index, side, reach_m),
        )
        for street in map(Street, range(HELD_OUT_SEED, HELD_OUT_SEED + streets))
        for index in _spread(len(street.frames), frames_a_street)
        for side in sides
    )


def _spread(count: int, chosen: int) -> list[int]:
    """``chosen`` of ``count``, or all; each in the middle of its share of them."""
    few = min(count, chosen)
    return [int((number + 0.5) * count / few) for number in range(few)]


def labelled_images(
    workspace: Workspace,
    frames: range | None,
    sides: Sequence[Side],
    reach_m: float = REACH_M,
) -> tuple[KnownImage, ...]:
    """The images of a workspace that people labelled or reviewed.

    Raises SemvizError where there are none. What is mapped from the labels and should be seen, but
    is not labelled, does not count, unless somebody said that it is not there; nor do elements that
    are to be left out of maps.
    """
    labelled = _Labelled(workspace, reach_m)
    found = tuple(labelled.images(frames, sides))
    if not found:
        among = "" if frames is None else f" in frames {frames.start}:{frames.stop}"
        raise SemvizError(
            f"{workspace.path}: nothing is labelled{among}, so nobody knows what is to be found; "
            f"'semviz annotate {workspace.path}' labels"
        )
    return found


class _Labelled:
    """A workspace's labels, and where they are in space."""

    def __init__(self, workspace: Workspace, reach_m: float) -> None:
        self._reach_m = reach_m
        self._name, self._source = workspace.name, workspace.source
        self._labels: Labels = workspace.read_labels()
        self._cameras = Cameras(self._source.rig, self._source.frames)
        self._places = Places(self._cameras)

    def images(self, frames: range | None, sides: Sequence[Side]) -> Iterator[KnownImage]:
        """In order of time."""
        if self._source.rig.right is None:
            sides = ("left",)
        for frame in self._source.frames:
            index = frame.index
            state = self._labels.review(index)
            for side in sides if frames is None or index in frames else ():
                if self._labels.in_frame(index, side) or state == "reviewed, empty":
                    yield KnownImage(
                        self._name,
                        index,
                        side,
                        partial(self._source.image, index, side),
                        partial(self._truth, index, side),
                        is_complete=state != "in work",
                    )

    def _truth(self, index: int, side: Side) -> Truth:
        rows = self._labels.in_frame(index, side)
        labelled, _ = observe(self._labels, index, side)
        unlabelled = self._unlabelled(index, side)
        left_out = [self._is_left_out(row) for row in rows] + [True] * len(unlabelled)
        distance = [self._distance_m(row) for row in rows]
        return Truth.of(
            joined(labelled, unlabelled),
            distance_m=np.array(distance + [np.nan] * len(unlabelled)),
            ignored=np.array(left_out, dtype=bool),
            reach_m=self._reach_m,
        )

    def _is_left_out(self, row: Observation) -> bool:
        judged = self._labels.judgements_of(row.element_id)
        return any(one.verdict == "leave out" for one in judged)

    def _distance_m(self, row: Observation) -> float:
        """From the left camera, horizontally; NaN where the element or the camera has no place."""
        place = self._places.of_element(self._labels, row.element_id)
        pose = self._cameras.T_map_camera[row.frame_index]
        if pose is None or not isinstance(place, Triangulated):
            return float("nan")
        return float(np.linalg.norm((place.anchor_m - pose.translation)[:2]))

    def _unlabelled(self, index: int, side: Side) -> Elements2D:
        """What is mapped and should be seen; nobody said whether it is."""
        T_camera_map = self._cameras.T_camera_map(index)
        if T_camera_map is None or self._labels.review(index) == "reviewed, empty":
            return Elements2D.from_ends([], [], [])
        near = self._places.near(self._labels, index)
        ghosts = ghosts_in(index, side, T_camera_map, self._cameras.rig, self._labels, near)
        kept = [one for one in ghosts if not self._is_told(one, index)]
        return Elements2D.from_ends(
            _points(one.anchor_px for one in kept),
            _points(one.end_px or (np.nan, np.nan) for one in kept),
            [self._labels.element(one.element_id).class_id for one in kept],
        )

    def _is_told(self, ghost: Ghost, index: int) -> bool:
        """Whether somebody said that an element is not to be seen; of what something hides, a part
        may be."""
        said = self._labels.dismissals.get(proposal_id(ghost.element_id, index, ghost.side))
        return said is not None and said.why != "occluded"


def _points(pixels: Iterator[tuple[float, float]]) -> FloatArray:
    return np.array(list(pixels), dtype=np.float64).reshape(-1, 2)
