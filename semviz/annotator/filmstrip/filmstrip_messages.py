"""The messages of the filmstrip: what is proposed in frames beside that on screen."""

from typing import Annotated, ClassVar, Literal, TypeAlias

from pydantic import ConfigDict, Field

from semviz.annotator.drawing.draft import PagePixel
from semviz.annotator.panes import Pane
from semviz.annotator.proposals.label_proposals import LabelledPane
from semviz.annotator.proposals.proposal_views import ProposalView
from semviz.web import protocol
from semviz_annotation.assist.marked_image import Mark
from semviz_annotation.labels.labels import Id, Index
from semviz_core.base.frame import Side

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


class DraggedMark(protocol.Part):
    """A mark that a person corrected in the strip, in an image of its frame."""

    model_config: ClassVar[ConfigDict] = ConfigDict(strict=True)

    frame: Index
    side: Side
    anchor: PagePixel
    end: PagePixel | None
    anchor_known: bool
    end_known: bool

    @property
    def labelled(self) -> LabelledPane:
        mark = Mark(self.anchor, self.end, self.anchor_known, self.end_known)
        return LabelledPane(Pane(self.frame, self.side), mark)


class FollowCorrectionsRequest(protocol.Request):
    """Search some frames for one element anew, by the marks of it that were corrected in the strip;
    a ``filmstrip_row`` event follows."""

    type: Literal["follow_corrections"] = "follow_corrections"
    element_id: Id
    frames: StripFrames
    corrected: Annotated[list[DraggedMark], Field(min_length=1, max_length=2 * MOST_FRAMES)]


class FilmstripCell(protocol.Part):
    """What is proposed for one element in a frame."""

    frame: int
    proposal: ProposalView


class FilmstripRowEvent(protocol.Event):
    """What is proposed for one element in frames of the strip: nothing in those without a cell."""

    type: Literal["filmstrip_row"] = "filmstrip_row"
    element_id: str
    frames: list[int]
    cells: list[FilmstripCell]
