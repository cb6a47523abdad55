"""Labels of a simulated street, as machines and forgetful people give them, with the truth.

A detector knows which of its finds are one element in the two images of a frame, not over frames; a
person knows that over some frames. Both pair and name elements wrongly now and then.
"""

from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from semviz_annotation.assist.marked_image import Mark
from semviz_annotation.labels.labels import LabelElement, Labels, Observation
from semviz_annotation.labels.rows import derived_id
from semviz_core.base.camera import Rig
from semviz_core.base.frame import Frame, Side
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame
from semviz_core.common.arrays import ByteImage
from semviz_core.simulation.detector import Detection
from semviz_core.simulation.street import Street

Detect = Callable[[int, Side], Detection]
_SIDES: tuple[Side, Side] = ("left", "right")
_SAME_ROW_PX = 10.0
_DISPARITY_PX = (5.0, 130.0)
"""In KITTI's geometry of elements 3 to 80 m away."""
_TURN_RAD_PER_M = 0.002


class Truth(NamedTuple):
    """What only a simulation knows of an observation."""

    element_id: int
    """In the street's ``truth_map``; -1 for what is nothing."""
    sigma_px: tuple[float, float]
    """What its ends were drawn with: across and along a pole, both alike for signs."""


@dataclass(frozen=True, eq=False)
class StreetLabels:
    """Labels, and the truth of each observation by its id."""

    labels: Labels
    truth: dict[str, Truth]


def careful(street: Street, sigma_px: float, seed: int) -> Detect:
    """What a careful person sees: everything, each end off by ``sigma_px`` in each direction."""

    def see(index: int, side: Side) -> Detection:
        rng = np.random.default_rng([seed, index, side == "right"])
        seen, ids = street.labels(index, side)
        noise = rng.normal(0.0, sigma_px, (2, len(ids), 2))
        drawn = replace(
            seen,
            anchor_px=seen.anchor_px + noise[0],
            end_px=seen.end_px + noise[1],
            sigma_px=np.full((len(ids), 2), sigma_px),
        )
        return Detection(drawn, ids)

    return see


def label_street(detect: Detect, frames: Iterable[int], memory: int = 1) -> StreetLabels:
    """Everything that is detected in both images of ``frames``.

    An element gets a new label element every ``memory`` frames; 1 is a detector. Detections in one
    image only are paired by class, row and disparity, so wrongly.
    """
    rows: list[Observation] = []
    truth: dict[str, Truth] = {}
    elements: dict[Hashable, LabelElement] = {}
    for index in frames:
        seen = {side: detect(index, side) for side in _SIDES}
        names = {side: _names(index, side, value, memory) for side, value in seen.items()}
        for i, j in _mispaired(seen["left"], seen["right"]):
            names["right"][j] = names["left"][i]
        for side, side_elements in seen.items():
            for row, name in enumerate(names[side]):
                new = LabelElement(
                    derived_id(f"element {name}"),
                    len(elements) + 1,
                    int(side_elements.observed.class_id[row]),
                )
                element = elements.setdefault(name, new)
                id = derived_id(f"observation {index} {side} {row}")
                rows.append(
                    Mark.of_element(side_elements.observed, row).at(index, side, id, element.id)
                )
                across, along = side_elements.observed.sigma_px[row].tolist()
                truth[id] = Truth(int(side_elements.element_id[row]), (across, along))
    return StreetLabels(Labels.from_rows([*elements.values(), *rows]), truth)


def _names(index: int, side: Side, seen: Detection, memory: int) -> list[Hashable]:
    """Of the label element of each find; elements change theirs in different frames."""
    return [
        ("thing", thing, (index + 7 * thing) // memory)
        if thing >= 0
        else ("nothing", index, side, row)
        for row, thing in enumerate(seen.element_id.tolist())
    ]


def _mispaired(left: Detection, right: Detection) -> list[tuple[int, int]]:
    """Rows of the left and the right image that look like a pair and are none."""
    pairs: list[tuple[int, int]] = []
    a, b = left.observed, right.observed
    lonely = ~np.isin(right.element_id, left.element_id) | (right.element_id < 0)
    for i in np.flatnonzero(~np.isin(left.element_id, right.element_id) | (left.element_id < 0)):
        disparity, down = (a.anchor_px[i] - b.anchor_px).T
        fits = lonely & (np.abs(down) < _SAME_ROW_PX) & (a.class_id[i] == b.class_id)
        fits &= (disparity > _DISPARITY_PX[0]) & (disparity < _DISPARITY_PX[1])
        for j in np.flatnonzero(fits)[:1]:
            lonely[j] = False
            pairs.append((int(i), int(j)))
    return pairs


def with_mistakes(given: StreetLabels, count: int, seed: int) -> tuple[StreetLabels, set[str]]:
    """Two elements under one name, ``count`` times; and the ids of those label elements.

    The second element is of the first one's class, and never in an image with it.
    """
    labels = given.labels
    images = {
        element: {(row.frame_index, row.side) for row in labels.of_element(element)}
        for element in labels.elements
    }
    rng = np.random.default_rng(seed)
    order = rng.permutation(sorted(labels.elements)).tolist()
    renamed: dict[str, str] = {}
    for pair in order:
        for other in order:
            if len(renamed) == count or pair in (taken := renamed.keys() | renamed.values()):
                break
            alike = labels.element(pair).class_id == labels.element(other).class_id
            if other not in taken and alike and _are_two(given, images, pair, other):
                renamed[other] = pair
    rows = [
        replace(row, element_id=renamed.get(row.element_id, row.element_id))
        for row in labels.observations.values()
    ]
    kept = [element for element in labels.elements.values() if element.id not in renamed]
    return StreetLabels(Labels.from_rows([*kept, *rows]), given.truth), set(renamed.values())


def _are_two(
    given: StreetLabels, images: dict[str, set[tuple[int, Side]]], text: str, other: str
) -> bool:
    """Whether two label elements are of two elements, and in no image together."""
    things = {
        given.truth[row.id].element_id
        for name in (text, other)
        for row in given.labels.of_element(name)
    }
    return len(things) == 2 and -1 not in things and not images[text] & images[other]


class DrivenTwice:
    """A street driven down twice; the second time, the poses drift.

    A ``Source``: frames ``n`` to ``2n - 1`` are the second pass. Their stated poses are off by
    ``drift_m`` horizontally, in a direction that changes slowly, and turned a little.
    """

    def __init__(self, street: Street, drift_m: float, seed: int) -> None:
        self.street = street
        n = len(street.frames)
        phase = float(np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi))
        self.frames: tuple[Frame, ...] = street.frames + tuple(
            Frame(n + i, street.frames[-1].time_s + frame.time_s, _drifted(frame, drift_m, phase))
            for i, frame in enumerate(street.frames)
        )

    @property
    def map_frame(self) -> MapFrame:
        return self.street.map_frame

    @property
    def rig(self) -> Rig:
        return self.street.rig

    def image(self, index: int, side: Side) -> ByteImage:
        """Of the street, as at the first pass."""
        return self.street.image(index % len(self.street.frames), side)

    def seen_by(self, first: Detect, second: Detect) -> Detect:
        """What two detectors find, one in each pass."""
        n = len(self.street.frames)

        def see(index: int, side: Side) -> Detection:
            return first(index, side) if index < n else second(index - n, side)

        return see


def _drifted(frame: Frame, drift_m: float, phase: float) -> Pose:
    assert frame.T_map_camera is not None  # a street knows the truth
    angle = phase + 0.02 * frame.index
    by = drift_m * np.array([np.cos(angle), np.sin(angle), 0.1])
    turn = _TURN_RAD_PER_M * drift_m * np.array([0.0, 0.0, 1.0])
    pose = frame.T_map_camera
    return Pose(Pose.from_rotvec(turn, np.zeros(3)).rotation @ pose.rotation, pose.translation + by)
