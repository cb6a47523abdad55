"""Handle the requests of a page's filmstrip: search frames beside that on screen, follow drags."""

from collections.abc import Callable, Sequence

from semviz.annotator import messages
from semviz.annotator.filmstrip import filmstrip_messages
from semviz.annotator.filmstrip.filmstrip_corrections import CorrectedRow
from semviz.annotator.proposals.proposal_views import ProposalView
from semviz.annotator.services import SearchServices
from semviz.web import protocol
from semviz.web.protocol import RefusedError


class FilmstripRequests:
    """Those of one opened page."""

    def __init__(
        self, send: Callable[[messages.AnnotatorEvent], None], shared: SearchServices
    ) -> None:
        self._send = send
        self._shared = shared
        self._wanted = ""
        """The request whose search goes on; an older one ends."""

    @protocol.handles(filmstrip_messages.SearchFilmstripRequest)
    def _search_filmstrip(self, request: filmstrip_messages.SearchFilmstripRequest) -> None:
        self._check_frames(request.frames)
        self._wanted = request.id
        self._shared.search_thread.submit(self._search, request)

    def _search(self, request: filmstrip_messages.SearchFilmstripRequest) -> None:
        """Search frame by frame, and send what each shows."""
        session = self._shared.session
        for index in request.frames:
            with self._shared.lock:
                queries = session.pending_queries(index)
            for query in queries:
                if self._wanted != request.id:
                    return
                session.image_worker.search(query)
            with self._shared.lock:
                proposals = session.frame(index).proposals
            self._send(
                filmstrip_messages.FilmstripEvent(
                    reply_to=request.id, frame=index, proposals=_of_elements(proposals, index)
                )
            )

    @protocol.handles(filmstrip_messages.FollowCorrectionsRequest)
    def _follow_corrections(self, request: filmstrip_messages.FollowCorrectionsRequest) -> None:
        corrected = tuple(mark.labelled for mark in request.corrected)
        self._check_frames([*request.frames, *(each.pane.frame_index for each in corrected)])
        session = self._shared.session
        with self._shared.lock:
            labels = session.labels
        row = CorrectedRow(request.element_id, corrected, labels, session.tracks.cameras)
        row.check()
        self._shared.search_thread.submit(self._follow, request, row)

    def _follow(
        self, request: filmstrip_messages.FollowCorrectionsRequest, row: CorrectedRow
    ) -> None:
        worker = self._shared.session.image_worker
        views = {index: row.view(index, worker) for index in request.frames}
        cells = [
            filmstrip_messages.FilmstripCell(frame=index, proposal=view)
            for index, view in views.items()
            if view is not None
        ]
        self._send(
            filmstrip_messages.FilmstripRowEvent(
                reply_to=request.id,
                element_id=request.element_id,
                frames=request.frames,
                cells=cells,
            )
        )

    def _check_frames(self, frames: Sequence[int]) -> None:
        unknown = [index for index in frames if index not in self._shared.session.frames]
        if unknown:
            raise RefusedError("not_found", f"frame {unknown[0]} is not in this sequence")


def _of_elements(proposals: list[ProposalView], index: int) -> list[ProposalView]:
    """Return the proposals of known elements, with their marks in the images of a frame."""
    own = (
        proposal.model_copy(
            update={
                "marks": {
                    side: mark for side, mark in proposal.marks.items() if mark.frame == index
                }
            }
        )
        for proposal in proposals
        if proposal.origin != "detector"
    )
    return [proposal for proposal in own if proposal.marks]
