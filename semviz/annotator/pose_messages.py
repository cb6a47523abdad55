"""The messages about poses between the labelling page and its server; parts of ``messages``."""

from typing import Annotated, Literal

from pydantic import Field

from semviz.annotator.pose_views import PoseMark, PosesView
from semviz.annotator.pose_work import PoseState
from semviz.web import protocol
from semviz.workspace.pose_choices import Choice, Subject
from semviz_annotation.labels.labels import Id, Index


class ShowPosesRequest(protocol.Request):
    """Compare the poses with the images, unless that is done; ``poses`` events follow."""

    type: Literal["show_poses"] = "show_poses"


class ShowPoseFrameRequest(protocol.Request):
    """Request the elements of a frame under the given and the refined pose."""

    type: Literal["show_pose_frame"] = "show_pose_frame"
    frame: int
    stretch: Annotated[int, Field(ge=0)]
    """Its place in the list of stretches."""


class ChoosePosesRequest(protocol.Request):
    """Choose what to do with the poses of a stretch; its ``id`` is stored, so a request that is
    sent twice is applied once."""

    type: Literal["choose_poses"] = "choose_poses"
    id: Id
    choice: Choice
    first: Index
    last: Index
    subject: Subject


class PosesEvent(protocol.Event):
    """How the poses compare with the images, as far as that is known."""

    type: Literal["poses"] = "poses"
    state: PoseState
    done: int
    total: int
    """Pairs of frames that are measured, and that there are."""
    seconds: float
    failure: str
    poses: PosesView | None
    """None until they have been compared."""


class PoseFrameEvent(protocol.Event):
    """The elements of a frame under the given and the refined pose."""

    type: Literal["pose_frame"] = "pose_frame"
    frame: int
    stretch: int
    marks: list[PoseMark]


class PosesChosenEvent(protocol.Event):
    """A choice for poses is on disk; the workspace is sent again with the chosen poses."""

    type: Literal["poses_chosen"] = "poses_chosen"
    text: str
