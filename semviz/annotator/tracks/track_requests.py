"""Handle the requests of a page about tracks: the rows of all elements, and one of them."""

from collections.abc import Callable, Sequence

from semviz.annotator import messages
from semviz.annotator.services import SearchServices
from semviz.annotator.tracks import track_messages
from semviz.annotator.tracks.track_details import TrackProposal
from semviz.annotator.tracks.track_rows import TrackFrame, TrackRow
from semviz.web import protocol
from semviz_core.common.errors import SemvizError

MOST_FRAMES = 300
"""Frames of a range that are searched for an element: half a second each on a slow machine."""


class TrackRequests:
    """Those of one opened page."""

    def __init__(
        self, send: Callable[[messages.AnnotatorEvent], None], shared: SearchServices
    ) -> None:
        self._send = send
        self._shared = shared
        self._is_shown = False
        self._wanted = ""
        """The request whose search goes on; an older one ends."""

    def send_rows(self, rows: Sequence[TrackRow], frames: Sequence[TrackFrame]) -> None:
        """Send rows and frames that were computed, if the page has asked for them."""
        if self._is_shown and (rows or frames):
            self._send(
                track_messages.TracksEvent(
                    rows=list(rows), frames=list(frames), waiting=self._waiting
                )
            )

    @property
    def _waiting(self) -> int:
        return self._shared.session.tracks.rows.waiting

    @protocol.handles(track_messages.ShowTracksRequest)
    def _show_tracks(self, request: track_messages.ShowTracksRequest) -> None:
        """Send the rows known so far; the others follow as they are computed."""
        with self._shared.lock:
            rows, frames, total = self._shared.session.tracks.known()
            self._is_shown = True
            self._send(
                track_messages.TracksEvent(
                    reply_to=request.id,
                    rows=rows,
                    frames=frames,
                    total=total,
                    waiting=self._waiting,
                )
            )

    @protocol.handles(track_messages.ShowTrackRequest)
    def _show_track(self, request: track_messages.ShowTrackRequest) -> None:
        with self._shared.lock:
            inspector, placed = self._shared.session.tracks.inspector(request.element_id)
        details = inspector.details(request.element_id, placed)
        self._send(track_messages.TrackEvent(reply_to=request.id, track=details))

    @protocol.handles(track_messages.ShowOpenTrackRequest)
    def _show_open_track(self, request: track_messages.ShowOpenTrackRequest) -> None:
        with self._shared.lock:
            views = self._shared.session.tracks.open_track_views(request.track_id)
        self._send(
            track_messages.OpenTrackEvent(
                reply_to=request.id, track_id=request.track_id, views=views
            )
        )

    @protocol.handles(track_messages.SearchTrackRequest)
    def _search_track(self, request: track_messages.SearchTrackRequest) -> None:
        self._wanted = request.id
        self._shared.search_thread.submit(self._search, request)

    def _search(self, request: track_messages.SearchTrackRequest) -> None:
        """Search the images of a range for an element, frame by frame."""
        session = self._shared.session
        frames = [index for index in session.frames if request.first <= index <= request.last]
        found: list[TrackProposal] = []
        for index in frames[:MOST_FRAMES]:
            if self._wanted != request.id:
                return
            with self._shared.lock:
                queries = session.tracks.queries(request.element_id, index)
            for query in queries:
                session.image_worker.search(query)
            with self._shared.lock:
                found += session.tracks.proposals(request.element_id, index)
        self._send(
            track_messages.TrackProposalsEvent(
                reply_to=request.id,
                element=request.element_id,
                first=request.first,
                last=request.last,
                proposals=found,
            )
        )

    @protocol.handles(track_messages.PreviewReSnapRequest)
    def _preview_resnap(self, request: track_messages.PreviewReSnapRequest) -> None:
        with self._shared.lock:
            self._shared.session.labels.element(request.element_id)
        self._shared.search_thread.submit(self._resnap, request)

    def _resnap(self, request: track_messages.PreviewReSnapRequest) -> None:
        try:
            preview = self._shared.session.tracks.preview_resnap(request.element_id)
        except SemvizError as error:  # it was deleted meanwhile
            self._send(protocol.error_event(error, request.id))
            return
        self._send(
            track_messages.ReSnapEvent(
                reply_to=request.id, element=request.element_id, preview=preview
            )
        )
