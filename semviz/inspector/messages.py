"""The requests of the page of ``semviz serve``, and the union of its events.

Events are defined in ``views`` and ``views_*``.
"""

from typing import Annotated, Literal

from pydantic import Field

from semviz.inspector import views, views_frame, views_run, what_if_options
from semviz.inspector.map_over_time import over_time_requests, views_over_time
from semviz.inspector.state import ImageMode, MapColors, View
from semviz.inspector.views_run import BaseFrameEvent, ComparisonEvent, GatesEvent
from semviz.web.protocol import (
    BackdropEvent,
    ErrorEvent,
    HelloEvent,
    Request,
    SceneEvent,
    SetBackdropRequest,
    SetThemeRequest,
)
from semviz.web.shapes import Theme
from semviz_annotation.storage.operations import EditBase
from semviz_core.base.frame import Side

Point = tuple[float, float, float]


class OpenRunRequest(Request):
    """Show a run at the frame with this number. Default: the first run, its worst frame."""

    type: Literal["open_run"] = "open_run"
    run: str | None = None
    frame: int | None = None
    theme: Theme = "dark"


class GoToPositionRequest(Request):
    """Show the frame at a position of the run."""

    type: Literal["go_to_position"] = "go_to_position"
    position: int


class DrawFrameRequest(Request):
    """Draw the frame in 3D. The page sends no request for frames that it skips."""

    type: Literal["draw_frame"] = "draw_frame"


class SelectRequest(Request):
    """Select a detection, a map element, a pair of them, or nothing."""

    type: Literal["select"] = "select"
    observed: int | None = None
    element: int | None = None


class SetViewRequest(Request):
    """Look from a named viewpoint in 3D."""

    type: Literal["set_view"] = "set_view"
    view: View


class ShowAlternativesRequest(Request):
    """Show or hide the alternative poses."""

    type: Literal["show_alternatives"] = "show_alternatives"
    shown: bool


class SetMapColorsRequest(Request):
    """Colour the 3D map. Null: leave as it is."""

    type: Literal["set_map_colors"] = "set_map_colors"
    colors: MapColors | None = None
    ellipsoids: bool | None = None


class GetViewpointRequest(Request):
    """Request the user's viewpoint in 3D."""

    type: Literal["get_viewpoint"] = "get_viewpoint"


class GoToViewpointRequest(Request):
    """Look from ``eye`` to ``target``, metres in the map frame."""

    type: Literal["go_to_viewpoint"] = "go_to_viewpoint"
    eye: Point
    target: Point


class RenderSceneRequest(Request):
    """Render the 3D pane as an image of this size (px)."""

    type: Literal["render_scene"] = "render_scene"
    width: int
    height: int


class SetImageRequest(Request):
    """Choose the image and what is drawn on it. Null: leave as it is."""

    type: Literal["set_image"] = "set_image"
    mode: ImageMode | None = None
    side: Side | None = None
    neighbours: bool | None = None


class GetOriginsRequest(Request):
    """Read the labels behind the selected element."""

    type: Literal["get_origins"] = "get_origins"


class GetSolverRequest(Request):
    """Request the solver's stages for this frame."""

    type: Literal["get_solver"] = "get_solver"


class ShowSearchPoseRequest(Request):
    """Show a candidate pose of the search in 3D. Null: hide it."""

    type: Literal["show_search_pose"] = "show_search_pose"
    row: int | None


class GetElementsRequest(Request):
    """Diagnose the whole run, with statistics of each map element."""

    type: Literal["get_elements"] = "get_elements"


class GetStoryRequest(Request):
    """Tell the story of the open run."""

    type: Literal["get_story"] = "get_story"


class FindFramesRequest(Request):
    """Find the frames that detect an element, or whose estimate uses it."""

    type: Literal["find_frames"] = "find_frames"
    element: int


class ShowForecastRequest(Request):
    """Show or hide the expected error along the route."""

    type: Literal["show_forecast"] = "show_forecast"
    shown: bool


class GetDecisionsRequest(Request):
    """List the decisions of map building and, on request, the findings of lint (slower)."""

    type: Literal["get_decisions"] = "get_decisions"
    findings: bool = False


class GoToDecisionRequest(Request):
    """Select the element of a decision in a frame that shows it."""

    type: Literal["go_to_decision"] = "go_to_decision"
    key: str


class AnswerDecisionRequest(Request):
    """Store a review decision in the labels."""

    type: Literal["answer_decision"] = "answer_decision"
    key: str
    name: str
    base: EditBase | None = None
    """What the page had seen of the labels."""


class UndoAnswerRequest(Request):
    """Undo a review decision that was made here."""

    type: Literal["undo_answer"] = "undo_answer"
    key: str
    base: EditBase | None = None
    """What the page had seen of the labels."""


class GetLabelEditsRequest(Request):
    """Count the label edits that are newer than the map of this run."""

    type: Literal["get_label_edits"] = "get_label_edits"


class OpenLabelRequest(Request):
    """Open the label of an element. Default: the element that the diagnosis names."""

    type: Literal["open_label"] = "open_label"
    element: int | None = None


class MergeDuplicatesRequest(Request):
    """Link the labels that the diagnosis of this frame calls duplicates."""

    type: Literal["merge_duplicates"] = "merge_duplicates"
    base: EditBase | None = None
    """What the page had seen of the labels."""


class ExcludeElementRequest(Request):
    """Edit the labels of an element so that maps leave it out."""

    type: Literal["exclude_element"] = "exclude_element"
    element: int
    base: EditBase | None = None
    """What the page had seen of the labels."""


class UndoLabelEditRequest(Request):
    """Undo the last label edit that was made here."""

    type: Literal["undo_label_edit"] = "undo_label_edit"
    base: EditBase | None = None
    """What the page had seen of the labels."""


class RebuildMapRequest(Request):
    """Build the map from the labels again and localize the run in it."""

    type: Literal["rebuild_map"] = "rebuild_map"


class StopRebuildRequest(Request):
    """Stop rebuilding."""

    type: Literal["stop_rebuild"] = "stop_rebuild"


class KeepMapRequest(Request):
    """Save the new map as the map of the workspace."""

    type: Literal["keep_map"] = "keep_map"


class GetWhatIfOptionsRequest(Request):
    """List the changes that fit the selection and the frame."""

    type: Literal["get_what_if_options"] = "get_what_if_options"


class SuggestWhatIfRequest(Request):
    """Find the change most likely to explain the failure of this frame."""

    type: Literal["suggest_what_if"] = "suggest_what_if"


class SolveWhatIfRequest(Request):
    """Solve the frame with a change, in addition to the kept changes."""

    type: Literal["solve_what_if"] = "solve_what_if"
    change: what_if_options.ChangeValues


class SolveSuggestionRequest(Request):
    """Solve the frame with the suggested change."""

    type: Literal["solve_suggestion"] = "solve_suggestion"


class KeepWhatIfRequest(Request):
    """Keep the change for all frames."""

    type: Literal["keep_what_if"] = "keep_what_if"


class DropWhatIfRequest(Request):
    """Drop the change."""

    type: Literal["drop_what_if"] = "drop_what_if"


class ForgetWhatIfRequest(Request):
    """Drop a kept change, by its index."""

    type: Literal["forget_what_if"] = "forget_what_if"
    number: int


class SweepWhatIfRequest(Request):
    """Solve all frames that the kept changes affect."""

    type: Literal["sweep_what_if"] = "sweep_what_if"


class StopSweepRequest(Request):
    """Stop the sweep; the frames solved so far count."""

    type: Literal["stop_sweep"] = "stop_sweep"


class SaveSweepRequest(Request):
    """Save the frames of a finished sweep as a run."""

    type: Literal["save_sweep"] = "save_sweep"


class CompareRunsRequest(Request):
    """Compare with the run ``base``, side by side or not. Empty: no comparison."""

    type: Literal["compare_runs"] = "compare_runs"
    base: str
    side_by_side: bool


class CheckGatesRequest(Request):
    """Check conditions of ``semviz compare --fail-if``."""

    type: Literal["check_gates"] = "check_gates"
    conditions: tuple[str, ...]


InspectorRequest = Annotated[
    OpenRunRequest
    | GoToPositionRequest
    | DrawFrameRequest
    | SelectRequest
    | SetViewRequest
    | SetThemeRequest
    | SetBackdropRequest
    | ShowAlternativesRequest
    | SetMapColorsRequest
    | GetViewpointRequest
    | GoToViewpointRequest
    | RenderSceneRequest
    | SetImageRequest
    | GetOriginsRequest
    | GetSolverRequest
    | ShowSearchPoseRequest
    | GetElementsRequest
    | GetStoryRequest
    | FindFramesRequest
    | ShowForecastRequest
    | GetDecisionsRequest
    | GoToDecisionRequest
    | AnswerDecisionRequest
    | UndoAnswerRequest
    | over_time_requests.GetOverTimeRequest
    | over_time_requests.GoToChangeRequest
    | over_time_requests.DecideChangesRequest
    | over_time_requests.UndoChangeAnswerRequest
    | over_time_requests.OpenAskedLabelRequest
    | over_time_requests.WriteChangedMapRequest
    | GetLabelEditsRequest
    | OpenLabelRequest
    | MergeDuplicatesRequest
    | ExcludeElementRequest
    | UndoLabelEditRequest
    | RebuildMapRequest
    | StopRebuildRequest
    | KeepMapRequest
    | GetWhatIfOptionsRequest
    | SuggestWhatIfRequest
    | SolveWhatIfRequest
    | SolveSuggestionRequest
    | KeepWhatIfRequest
    | DropWhatIfRequest
    | ForgetWhatIfRequest
    | SweepWhatIfRequest
    | StopSweepRequest
    | SaveSweepRequest
    | CompareRunsRequest
    | CheckGatesRequest,
    Field(discriminator="type"),
]
InspectorEvent = (
    HelloEvent
    | views_run.RunsEvent
    | SceneEvent
    | views_run.ReadingEvent
    | views.RunEvent
    | views.FrameEvent
    | views.StateEvent
    | views.MapColorsEvent
    | BackdropEvent
    | views.ViewpointEvent
    | views.SceneImageEvent
    | views_frame.RightImageEvent
    | views_frame.NeighboursEvent
    | views_frame.SelectionEvent
    | views_frame.OriginsEvent
    | views_frame.SolverEvent
    | views_run.ElementsEvent
    | views_run.StoryEvent
    | views_run.ElementFramesEvent
    | views_run.ForecastEvent
    | views_run.DecisionsEvent
    | views_over_time.OverTimeEvent
    | views_over_time.ChangeAnswersEvent
    | views_over_time.ChangedMapEvent
    | views_run.LabelEditsEvent
    | views_run.LabelPageEvent
    | views_run.MapSavedEvent
    | what_if_options.WhatIfOptionsEvent
    | what_if_options.SuggestionEvent
    | what_if_options.SuggestionStatusEvent
    | what_if_options.WhatIfEvent
    | ComparisonEvent
    | BaseFrameEvent
    | GatesEvent
    | ErrorEvent
)
