"""The messages between the labelling page and its server."""

from typing import Annotated, ClassVar, Literal, TypeAlias

from pydantic import ConfigDict, Field

from semviz.annotator import views
from semviz.annotator.drawing.draft import (
    DraftPreview,
    DraftState,
    ElementDraft,
    LabelledFrameView,
    PagePixel,
)
from semviz.annotator.drive import pose_views
from semviz.annotator.drive.drive_view import (
    DriveEvent,
    DriveFrameEvent,
    ShowDriveFrameRequest,
    ShowDriveRequest,
)
from semviz.annotator.filmstrip.filmstrip_messages import (
    FilmstripEvent,
    FilmstripRowEvent,
    FollowCorrectionsRequest,
    SearchFilmstripRequest,
)
from semviz.annotator.history import PastFrame
from semviz.annotator.map_review import ReviewEntry, ReviewList
from semviz.annotator.panes import SecondImage
from semviz.annotator.team import blind_views, people_view, team_view
from semviz.annotator.tracks import track_messages
from semviz.annotator.tracks.track_edits import (
    AcceptSureTracksEdit,
    AcceptTracksEdit,
    AlignLabelsEdit,
    RejectTracksEdit,
)
from semviz.web import protocol
from semviz_annotation.labels.edits import Edit
from semviz_annotation.labels.labels import Id, Index, Pixel
from semviz_annotation.storage.label_file import HealthState
from semviz_annotation.storage.operations import EditBase
from semviz_core.base.frame import Side

Count = Annotated[int, Field(ge=0)]


class DrawnMark(protocol.Part):
    """A mark on a pane, of element ``element_id``. With a ``class_id`` it starts that element,
    unless it fits an existing one."""

    model_config: ClassVar[ConfigDict] = ConfigDict(strict=True)

    observation_id: Id
    element_id: Id
    frame_index: Index
    side: Side
    """Side on the page: with one camera, right is another frame."""
    second: Index | None = None
    """Frame of the second image as the page shows it; None: the frame's own right one."""
    anchor_px: PagePixel
    end_px: PagePixel | None = None
    anchor_known: bool = True
    end_known: bool = True
    class_id: Index | None = None

    def draft(self, class_id: int, snap: bool, asks_bottom: bool) -> ElementDraft:
        """Return the mark as a drawing of this class."""
        return ElementDraft(
            side=self.side,
            class_id=class_id,
            anchor_px=self.anchor_px,
            end_px=self.end_px,
            anchor_known=self.anchor_known,
            end_known=self.end_known,
            snap=snap,
            asks_bottom=asks_bottom,
        )


class DrawEdit(DrawnMark):
    """Draw a mark; it joins the element ``selected_id`` if it fits or was chosen."""

    kind: Literal["draw"]
    selected_id: Id | None = None
    is_chosen: bool = False
    """Whether a person chose the selected element in this frame."""
    asks_same: bool = False
    """Whether to refuse a mark that lies on a label; see ``SamePlaceEvent``."""
    snap: bool = False
    asks_bottom: bool = False
    """Whether the server may mark the bottom as hidden."""


class AcceptEdit(protocol.Part):
    """Accept proposals as the page showed them, all or none, but those that somebody else labelled
    meanwhile."""

    kind: Literal["accept"]
    marks: list[DrawnMark] = Field(min_length=1)


class MergeFrameEdit(protocol.Part):
    """Take labels for a frame that two people labelled blind, as the page showed them."""

    kind: Literal["merge frame"]
    frame_index: Index
    marks: list[DrawnMark]
    of_second: tuple[Id, ...] = ()
    """Elements of which the second person's attributes count where both have one."""


class UndoEdit(protocol.Part):
    """Undo the author's last edit, or that of a request."""

    kind: Literal["undo"]
    request: Id | None = None


class RedoEdit(protocol.Part):
    """Redo what the author undid last."""

    kind: Literal["redo"]


class NameEdit(protocol.Part):
    """Name the present state."""

    kind: Literal["name"]
    name: str


class RestoreEdit(protocol.Part):
    """Restore the state after an operation."""

    kind: Literal["restore"]
    number: Count


PageEdit: TypeAlias = Annotated[
    DrawEdit
    | AcceptEdit
    | MergeFrameEdit
    | AcceptTracksEdit
    | RejectTracksEdit
    | AcceptSureTracksEdit
    | AlignLabelsEdit
    | track_messages.NoteEdit
    | UndoEdit
    | RedoEdit
    | NameEdit
    | RestoreEdit
    | Edit,
    Field(discriminator="kind"),
]

# -- requests


class ApplyEditRequest(protocol.Request):
    """Apply an edit; its ``id`` is stored, so a request that is sent twice is applied once."""

    type: Literal["apply_edit"] = "apply_edit"
    id: Id
    edit: PageEdit
    base: EditBase | None = None
    """What the page had shown when the edit was begun."""


class GoToFrameRequest(protocol.Request):
    """Show another frame."""

    type: Literal["go_to_frame"] = "go_to_frame"
    frame: int
    second: SecondImage | None = None


class PreviewDraftRequest(protocol.Request):
    """Request guides and numbers of a draft."""

    type: Literal["preview_draft"] = "preview_draft"
    draft: DraftState


class ShowPastFrameRequest(protocol.Request):
    """Request a frame as it was after an operation."""

    type: Literal["show_past_frame"] = "show_past_frame"
    operation: Count
    frame: int
    second: Index | None = None
    """Frame of the second image, as for ``DrawnMark``."""


class ListOperationsRequest(protocol.Request):
    """Request the operations before a number, newest first."""

    type: Literal["list_operations"] = "list_operations"
    before: Count


class ListNamedStatesRequest(protocol.Request):
    """Request the named states."""

    type: Literal["list_named_states"] = "list_named_states"


class ShowReviewRequest(protocol.Request):
    """Open the entry of a list ``by`` places after the one with ``key``."""

    type: Literal["show_review"] = "show_review"
    list_name: ReviewList
    key: str | None = None
    place: Count = 0
    by: Literal[-1, 0, 1] = 0


class CloseReviewRequest(protocol.Request):
    """Close the open entry."""

    type: Literal["close_review"] = "close_review"


class BuildMapRequest(protocol.Request):
    """Build the map."""

    type: Literal["build_map"] = "build_map"


class StopMapBuildRequest(protocol.Request):
    """Cancel the map build."""

    type: Literal["stop_map_build"] = "stop_map_build"


AnnotatorRequest: TypeAlias = Annotated[
    ApplyEditRequest
    | GoToFrameRequest
    | PreviewDraftRequest
    | ShowPastFrameRequest
    | ListOperationsRequest
    | ListNamedStatesRequest
    | ShowReviewRequest
    | CloseReviewRequest
    | BuildMapRequest
    | StopMapBuildRequest
    | team_view.ShowTeamRequest
    | team_view.AssignFramesRequest
    | blind_views.AssignShareRequest
    | blind_views.EndShareRequest
    | blind_views.ShowComparedRequest
    | blind_views.OpenShareRequest
    | track_messages.ShowTracksRequest
    | track_messages.ShowTrackRequest
    | track_messages.ShowOpenTrackRequest
    | track_messages.SearchTrackRequest
    | track_messages.PreviewReSnapRequest
    | SearchFilmstripRequest
    | FollowCorrectionsRequest
    | ShowDriveRequest
    | ShowDriveFrameRequest
    | pose_views.ShowPosesRequest
    | pose_views.ShowPoseFrameRequest
    | pose_views.ChoosePosesRequest
    | protocol.SetThemeRequest
    | protocol.SetBackdropRequest,
    Field(discriminator="type"),
]

# -- events


class WorkspaceEvent(protocol.Event):
    """The workspace and its labels; sent when the page connects."""

    type: Literal["workspace"] = "workspace"
    workspace: views.WorkspaceView
    labels: views.LabelsView


class LabelFileEvent(protocol.Event):
    """What is known about the label file; sent when the page connects and when it changes."""

    type: Literal["label_file"] = "label_file"
    state: HealthState
    text: str
    """One line for people; empty while all is well."""


class LabelledFrameEvent(protocol.Event):
    """The frame on screen."""

    type: Literal["frame"] = "frame"
    frame: LabelledFrameView


class FrameListEvent(protocol.Event):
    """Changed entries of the list of frames."""

    type: Literal["frame_list"] = "frame_list"
    frames: list[views.FrameSummary]


class UpdateEvent(protocol.Event):
    """The labels have changed, on another page or in another process."""

    type: Literal["update"] = "update"
    labels: views.LabelsView
    frame: LabelledFrameView | None
    """None if all changes are too far away to show in the frame on screen."""


class SavedOperationEvent(protocol.Event):
    """An edit is on disk; ``edit_saved`` follows."""

    type: Literal["saved_operation"] = "saved_operation"
    operation: int


class EditSavedEvent(protocol.Event):
    """An edit is on disk, with the labels and the frame on screen after it."""

    type: Literal["edit_saved"] = "edit_saved"
    labels: views.LabelsView
    frame: LabelledFrameView
    element: str | None
    """The element to which a drawing, link or unlinked view now belongs; None for other edits."""
    added: int
    """Number of observations added; negative for removed ones."""
    note: str
    """Message for the user; empty for most edits."""


class ConflictEvent(protocol.ErrorEvent):
    """An edit would overwrite what others did since; it is applied if it knows ``overwritten``."""

    code: Literal["conflict"] = "conflict"
    overwritten: list[str]
    """Requests of the others."""
    is_deleted: bool
    """Whether the edited observation no longer exists."""
    operation: int
    """The last one of the others."""
    author: str
    """Who wrote it."""
    time: str
    """When: UTC, ISO 8601."""


class SamePlaceEvent(protocol.ErrorEvent):
    """A drawing lies on a label: it may be that one's correction, or another element."""

    code: Literal["conflict"] = "conflict"
    element_id: str
    name: str
    """Of the element whose label that is."""
    observation_id: str
    """Of that label."""
    anchor: Pixel | None
    """Ends of the drawing, snapped; None where it is hidden, so that a known one stays."""
    end: Pixel | None


class DraftPreviewEvent(protocol.Event):
    """Guides and numbers of a draft."""

    type: Literal["draft_preview"] = "draft_preview"
    preview: DraftPreview


class PastFrameEvent(protocol.Event):
    """A frame of an earlier state."""

    type: Literal["past_frame"] = "past_frame"
    past: PastFrame


class OperationsEvent(protocol.Event):
    """Older operations, newest first."""

    type: Literal["operations"] = "operations"
    operations: list[views.OperationView]


class NamedStatesEvent(protocol.Event):
    """The named states, newest first."""

    type: Literal["named_states"] = "named_states"
    states: list[views.OperationView]


class ReviewEvent(protocol.Event):
    """The open decision or finding; None for none."""

    type: Literal["review"] = "review"
    review: ReviewEntry | None


class ElementClickedEvent(protocol.Event):
    """An element or an open track was clicked in the 3D scene."""

    type: Literal["element_clicked"] = "element_clicked"
    element: str
    is_track: bool


AnnotatorEvent: TypeAlias = (
    protocol.HelloEvent
    | WorkspaceEvent
    | LabelFileEvent
    | LabelledFrameEvent
    | FrameListEvent
    | UpdateEvent
    | SavedOperationEvent
    | EditSavedEvent
    | DraftPreviewEvent
    | PastFrameEvent
    | OperationsEvent
    | NamedStatesEvent
    | ReviewEvent
    | track_messages.TracksEvent
    | track_messages.TrackEvent
    | track_messages.OpenTrackEvent
    | track_messages.TrackProposalsEvent
    | track_messages.ReSnapEvent
    | FilmstripEvent
    | FilmstripRowEvent
    | people_view.PeopleEvent
    | blind_views.TeamEvent
    | blind_views.ComparedEvent
    | blind_views.ShareOpenedEvent
    | DriveEvent
    | DriveFrameEvent
    | pose_views.PosesEvent
    | pose_views.PoseFrameEvent
    | pose_views.PosesChosenEvent
    | protocol.SceneEvent
    | protocol.BackdropEvent
    | ElementClickedEvent
    | protocol.ErrorEvent
    | ConflictEvent
    | SamePlaceEvent
)
