"""The requests of the view "Map over time"."""

from typing import Literal

from semviz.web.protocol import Request
from semviz.workspace.maps.map_decisions import Answer


class GetOverTimeRequest(Request):
    """Search the runs for changes of the open run's map."""

    type: Literal["get_over_time"] = "get_over_time"


class GoToChangeRequest(Request):
    """Show the frame that shows a change best, before it or after, and select its element."""

    type: Literal["go_to_change"] = "go_to_change"
    name: str
    is_after: bool


class DecideChangesRequest(Request):
    """Decide on changes of the map, by their names."""

    type: Literal["decide_changes"] = "decide_changes"
    names: tuple[str, ...]
    answer: Answer
    seen: int
    """Number of decisions that the page had seen."""


class UndoChangeAnswerRequest(Request):
    """Undo the last decision on changes that was made on this page."""

    type: Literal["undo_change_answer"] = "undo_change_answer"
    seen: int
    """Number of decisions that the page had seen."""


class OpenAskedLabelRequest(Request):
    """Open the frame in which a label of a change is asked for."""

    type: Literal["open_asked_label"] = "open_asked_label"
    name: str


class WriteChangedMapRequest(Request):
    """Write the map after the decided changes as a new map of the workspace."""

    type: Literal["write_changed_map"] = "write_changed_map"
    name: str
