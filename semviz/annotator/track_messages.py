"""The messages of the view "Tracks"."""

from typing import Literal

from semviz.annotator import track_details, track_rows
from semviz.web import protocol
from semviz_annotation.labels.labels import Id


class ShowTracksRequest(protocol.Request):
    """Request the rows of all elements; those that are not known yet follow."""

    type: Literal["show_tracks"] = "show_tracks"


class ShowTrackRequest(protocol.Request):
    """Request one element: its labels, what is wrong, what could be done."""

    type: Literal["show_track"] = "show_track"
    element_id: Id


class SearchTrackRequest(protocol.Request):
    """Search the images of a range of frames for an element; ``track_proposals`` follows. A later
    one replaces it."""

    type: Literal["search_track"] = "search_track"
    element_id: Id
    first: int
    last: int


class PreviewReSnapRequest(protocol.Request):
    """Find where the accepted labels of an element snap to; ``resnap`` follows."""

    type: Literal["preview_resnap"] = "preview_resnap"
    element_id: Id


class TracksEvent(protocol.Event):
    """Rows of elements and open tracks, and what is expected in frames; added to those before."""

    type: Literal["tracks"] = "tracks"
    rows: list[track_rows.TrackRow]
    frames: list[track_rows.TrackFrame]
    total: int | None = None
    """Number of all rows, in the answer to ``show_tracks``."""
    waiting: int = 0
    """Number of rows whose residuals are still being computed."""


class TrackEvent(protocol.Event):
    """One element."""

    type: Literal["track"] = "track"
    track: track_details.TrackDetails


class TrackProposalsEvent(protocol.Event):
    """What the images of a range of frames show of an element that is not labelled there."""

    type: Literal["track_proposals"] = "track_proposals"
    element: str
    first: int
    last: int
    proposals: list[track_details.TrackProposal]


class ReSnapEvent(protocol.Event):
    """What a re-snap of an element would do."""

    type: Literal["resnap"] = "resnap"
    element: str
    preview: track_details.ReSnapPreview
