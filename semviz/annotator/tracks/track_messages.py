"""The messages of the view "Tracks", and notes on elements."""

from datetime import UTC, datetime
from typing import Literal

from pydantic import Field

from semviz.annotator.tracks import track_details, track_rows
from semviz.web import protocol
from semviz_annotation.labels.edits import WriteNote
from semviz_annotation.labels.labels import Id, Index
from semviz_annotation.labels.rows import MAX_NOTE_LENGTH, Note


class NoteEdit(protocol.Part):
    """Write a note on an element, in the name of who is connected."""

    kind: Literal["note"]
    note_id: Id
    element_id: Id
    frame_index: Index | None = None
    unsure: bool = False
    text: str = Field(default="", max_length=MAX_NOTE_LENGTH)

    def note(self, author: str) -> WriteNote:
        """Return the edit of the labels, written now."""
        time = datetime.now(UTC).isoformat(timespec="milliseconds")
        return WriteNote(
            Note(
                self.note_id,
                self.element_id,
                self.frame_index,
                self.unsure,
                self.text,
                author,
                time,
            )
        )


class ShowTracksRequest(protocol.Request):
    """Request the rows of all elements; those that are not known yet follow."""

    type: Literal["show_tracks"] = "show_tracks"


class ShowTrackRequest(protocol.Request):
    """Request one element: its labels, what is wrong, what could be done."""

    type: Literal["show_track"] = "show_track"
    element_id: Id


class ShowOpenTrackRequest(protocol.Request):
    """Request the detections of an open track."""

    type: Literal["show_open_track"] = "show_open_track"
    track_id: Id


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


class OpenTrackEvent(protocol.Event):
    """The detections of an open track; none if it is no longer open."""

    type: Literal["open_track"] = "open_track"
    track_id: str
    views: list[track_details.TrackImage]


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
