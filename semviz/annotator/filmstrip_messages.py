"""The messages of the filmstrip: what is proposed in frames beside that on screen."""

from typing import Annotated, Literal, TypeAlias

from pydantic import Field

from semviz.annotator.proposal_views import ProposalView
from semviz.web import protocol
from semviz_annotation.labels.labels import Index

MOST_FRAMES = 8
"""More do not fit on a screen at a size that shows an error of 2 px."""
StripFrames: TypeAlias = Annotated[list[Index], Field(min_length=1, max_length=MOST_FRAMES)]


class SearchFilmstripRequest(protocol.Request):
    """Search the images of some frames for all known elements; a ``filmstrip`` event follows for
    each. A later request replaces it."""

    type: Literal["search_filmstrip"] = "search_filmstrip"
    frames: StripFrames


class FilmstripEvent(protocol.Event):
    """What is proposed in a frame, after its images were searched: of known elements, its own
    images alone."""

    type: Literal["filmstrip"] = "filmstrip"
    frame: int
    proposals: list[ProposalView]
