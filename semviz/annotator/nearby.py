"""Elements labelled a few frames away that may well be here, though it is not known where."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semviz.annotator.cameras import Cameras
from semviz.annotator.fit import seen_at
from semviz.annotator.ghosts import Ghost
from semviz.annotator.places import Places
from semviz_annotation.assist.shot import pixel
from semviz_annotation.labels import Labels
from semviz_annotation.view import View
from semviz_core.arrays import FloatArray
from semviz_core.sources.source import Side

NEARBY_FRAMES = 5
"""An element is offered this many frames before and after one in which it is labelled."""


@dataclass(frozen=True)
class Nearby:
    """An element to continue: too far away to be expected, or seen only once so far."""

    element_id: str
    labelled_in: int
    """The nearest frame in which it is labelled."""
    ghosts: tuple[Ghost, ...]
    """Weak: from rays that are nearly parallel. Empty where it has one view, or a pose lacks."""


def nearby_in(
    frame_index: int,
    order: Sequence[int],
    expected: Iterable[str],
    labels: Labels,
    cameras: Cameras,
    places: Places,
) -> tuple[Nearby, ...]:
    """What is labelled near a frame, and neither ``expected`` in it nor labelled in both images.

    ``order`` holds all frames in order of time. What the rays say is out of sight is left out.
    """
    known = set(expected)
    sides: tuple[Side, ...] = ("left",) if cameras.rig.right is None else ("left", "right")
    views = {side: cameras.view(frame_index, side) for side in sides}
    is_posed = cameras.T_map_camera[frame_index] is not None
    found = []
    for element_id, labelled_in in _labelled_near(frame_index, order, labels).items():
        lacking = [side for side in sides if not labels.find(element_id, frame_index, side)]
        if element_id in known or not lacking:
            continue
        ends = places.best_ends(labels, element_id) if is_posed else None
        ghosts = () if ends is None else _ghosts(element_id, lacking, views, ends)
        if ghosts or (ends is None and labelled_in != frame_index):
            found.append(Nearby(element_id, labelled_in, ghosts))
    return tuple(found)


def _labelled_near(frame_index: int, order: Sequence[int], labels: Labels) -> dict[str, int]:
    """The nearest frame of each element that is labelled around here, nearest first."""
    here = order.index(frame_index)
    around = range(max(0, here - NEARBY_FRAMES), min(len(order), here + NEARBY_FRAMES + 1))
    nearest: dict[str, int] = {}
    for place in sorted(around, key=lambda one: abs(one - here)):
        for row in labels.in_frame(order[place]):
            nearest.setdefault(row.element_id, order[place])
    return nearest


def _ghosts(
    element_id: str, sides: Iterable[Side], views: Mapping[Side, View], ends: FloatArray
) -> tuple[Ghost, ...]:
    """Where an element would be seen; none where it is out of sight."""
    seen = [_ghost(element_id, side, views[side], ends) for side in sides]
    return tuple(ghost for ghost in seen if ghost is not None)


def _ghost(element_id: str, side: Side, view: View, ends: FloatArray) -> Ghost | None:
    pixels = seen_at(view, ends)
    is_line = not np.isnan(ends[1]).any()
    behind = np.isnan(pixels[: 1 + is_line]).any()
    if behind or not view.camera.contains(pixels).any():
        return None
    anchor, end = (pixel(one) for one in pixels)
    return Ghost(element_id, side, anchor, end if is_line else None, depth_m=float("inf"))
