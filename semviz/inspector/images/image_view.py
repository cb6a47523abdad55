"""What is drawn on the image, which image it is, and those before and after it."""

import numpy as np

from semviz.inspector.session import Selection, State, matched_elements
from semviz.inspector.topic import Topic, Verbs
from semviz.inspector.views import Json, numbers, place
from semviz.projection import Projected, project_elements
from semviz.recording.run import FrameRecord, Run
from semviz.web.sessions import Message
from semviz_core.camera import Rig
from semviz_core.errors import SemvizError
from semviz_core.localization import Localization
from semviz_core.pose import Pose

REACH = 2
"""So many frames before and after are shown."""


class ImageTopic(Topic):
    """Tells of the right image and of neighbours only while they are shown."""

    def verbs(self) -> Verbs:
        return {"image": self._image}

    def on_frame(self) -> None:
        self._tell_right()
        self._tell_neighbours()

    def on_state(self) -> None:
        self._tell_neighbours()

    def _image(self, message: Message) -> None:
        """What the message leaves out stays as it is."""
        state, run = self.desk.state, self.desk.run
        side = str(message.get("side", state.side))
        if side == "right" and run.info.rig.right is None:
            raise SemvizError("this run has one camera; there is no right image")
        neighbours = bool(message.get("neighbours", state.neighbours))
        self.desk.state = state.picturing(str(message.get("mode", state.mode)), side, neighbours)
        self.desk.tell_state()
        self._tell_right()

    def _tell_right(self) -> None:
        if self.desk.state.side == "right":
            self.desk.say("right", right_view(self.desk.run, self.desk.state.position))

    def _tell_neighbours(self) -> None:
        if self.desk.state.neighbours:
            self.desk.say("neighbours", neighbours_view(self.desk.run, self.desk.state))


def right_view(run: Run, position: int) -> Json:
    """Where each row of the submap is in the right image. What is seen is of the left one."""
    record = run.frames[position]
    estimate, truth = record.localization.T_camera_map, _true_pose(record)
    estimated, true = (_in_right(record, run.info.rig, pose) for pose in (estimate, truth))
    rows = range(len(record.localization.submap))
    mapped = [{"estimate": place(estimated, row), "truth": place(true, row)} for row in rows]
    return {"position": position, "mapped": mapped}


def _in_right(record: FrameRecord, rig: Rig, T_camera_map: Pose | None) -> Projected | None:
    if T_camera_map is None or rig.right is None or rig.T_right_left is None:
        return None
    submap = record.localization.submap
    return project_elements(submap, rig.T_right_left @ T_camera_map, rig.right)


def neighbours_view(run: Run, state: State) -> list[Json]:
    """The frames around the state's, with the selected element as each sees it and the map has it
    under its own estimate, or, where it has none, the truth."""
    first, last = max(0, state.position - REACH), min(len(run.frames) - 1, state.position + REACH)
    return [_neighbour(run, position, state) for position in range(first, last + 1)]


def _neighbour(run: Run, position: int, state: State) -> Json:
    record, selection = run.frames[position], state.selection
    observed = selection.observed if position == state.position else None
    if observed is None:
        observed = _observed_row(run, position, selection)
    return {
        "position": position,
        "seen": None if observed is None else _seen(record.localization, observed),
        "mapped": _mapped(run, record, selection.element),
    }


def _observed_row(run: Run, position: int, selection: Selection) -> int | None:
    """The row that was matched with the selected element or, without a match, truly is it."""
    record, element = run.frames[position], selection.element
    if element is None:
        return None
    matched = (i for i, id in matched_elements(run, position).items() if id == element)
    true = np.flatnonzero(record.element_id == element).tolist()
    return next(matched, next(iter(true), None))


def _seen(localization: Localization, row: int) -> Json:
    seen = localization.observed
    end = numbers(seen.end_px[row]) if seen.is_line[row] else None
    return {"class": int(seen.class_id[row]), "place": [numbers(seen.anchor_px[row]), end]}


def _mapped(run: Run, record: FrameRecord, element: int | None) -> Json | None:
    elements = run.semantic_map.elements
    rows = np.flatnonzero(elements.id == element)
    pose = record.localization.T_camera_map or _true_pose(record)
    if not len(rows) or pose is None:
        return None
    chosen = elements[rows[:1]]
    there = place(project_elements(chosen, pose, record.localization.camera), 0)
    return None if there is None else {"class": int(chosen.class_id[0]), "place": there}


def _true_pose(record: FrameRecord) -> Pose | None:
    truth = record.frame.T_map_camera
    return None if truth is None else truth.inverse()
