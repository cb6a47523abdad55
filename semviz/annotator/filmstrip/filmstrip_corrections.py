"""Follow the marks that a person corrected in a row of the filmstrip into its other images.

The marks of a row follow labels, so they share an offset that these have. What a person has just
placed is right: the other images follow the nearest of them, whatever their labels are.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from semviz.annotator.element_positions import ProjectedElement, projected_elements
from semviz.annotator.panes import Cameras, Pane
from semviz.annotator.proposals.image_worker import ImageWorker
from semviz.annotator.proposals.label_proposals import (
    CorrespondenceQuery,
    ImageQuery,
    LabelledPane,
    LabelProposal,
    PropagationQuery,
    SearchImage,
)
from semviz.annotator.proposals.proposal_selection import select_distinct
from semviz.annotator.proposals.proposal_views import ProposalView, proposal_views
from semviz_annotation.assist.marked_image import Mark
from semviz_annotation.assist.score import growth, look_again, views_beside
from semviz_annotation.labels.labels import Labels, proposal_id
from semviz_annotation.labels.views import other_side
from semviz_annotation.mapping.placement.triangulation import (
    Triangulated,
    TriangulationFailure,
    triangulate,
)
from semviz_core.base.frame import Side
from semviz_core.common.errors import SemvizError

_PLACED = 1.0
"""Score of a mark that a person placed."""


@dataclass(frozen=True, eq=False)
class CorrectedRow:
    """An element with marks that were corrected, but are no labels yet."""

    element_id: str
    corrected: tuple[LabelledPane, ...]
    labels: Labels
    cameras: Cameras

    def check(self) -> None:
        """Raise SemvizError if a mark does not fit its element, or all together do not."""
        is_line = self.labels.classes[self._class_id].kind == "line"
        for each in self.corrected:
            if each.pane.side not in self.cameras.sides:
                raise SemvizError("a corrected mark is in an image that the frame has not")
            if (each.mark.end_px is not None) != is_line:
                raise SemvizError("a corrected mark does not fit the class of its element")
        _ = self._position  # raises

    def view(self, frame_index: int, worker: ImageWorker) -> ProposalView | None:
        """Search the images of a frame, and return what is proposed; None if nothing is."""
        proposals = [*self._proposals(frame_index)]
        for query in worker.pending(proposals):
            worker.search(query)
        found = select_distinct(worker.with_results(proposals), self.labels)
        panes = {side: Pane(frame_index, side) for side in self.cameras.sides}
        classes = self.labels.classes
        views = proposal_views(found, panes, self.labels, self.cameras.rig, classes)
        return views[0] if views else None

    @cached_property
    def _marked(self) -> tuple[LabelledPane, ...]:
        """The corrected marks, then the labels."""
        rows = (
            LabelledPane(Pane(row.frame_index, row.side), Mark.of(row))
            for row in self.labels.of_element(self.element_id)
            if self.cameras.T_map_camera.get(row.frame_index) is not None
        )
        return (*self.corrected, *rows)

    @cached_property
    def _position(self) -> Triangulated:
        """Raise SemvizError if the marks do not fix it."""
        views = [self.cameras.view(each.pane.frame_index, each.pane.side) for each in self._marked]
        marks = [each.mark.at(0, each.pane.side) for each in self._marked]
        found = triangulate(views, marks)
        if isinstance(found, TriangulationFailure):
            raise SemvizError(f"its marks have no common position: {found.reason}")
        return found

    @property
    def _class_id(self) -> int:
        return self.labels.element(self.element_id).class_id

    def _proposals(self, frame_index: int) -> Iterator[LabelProposal]:
        """Yield what is to be searched for in a frame, and its corrected marks as they are."""
        expected = self._expected(frame_index)
        rejected = {dismissal.id for dismissal in self.labels.dismissed_in(frame_index)}
        for side in self.cameras.sides:
            pane, projection = Pane(frame_index, side), expected.get(side)
            placed = self._placed(pane)
            id_ = proposal_id(self.element_id, frame_index, side)
            if id_ in rejected or self.labels.find(self.element_id, frame_index, side):
                continue
            if placed is not None:
                yield self._proposal(id_, pane, projection, placed, None)
            elif projection is not None:
                mark = Mark(projection.anchor_px, projection.end_px)
                yield self._proposal(id_, pane, projection, mark, self._query(pane, [*expected]))

    def _proposal(
        self,
        id_: str,
        pane: Pane,
        projection: ProjectedElement | None,
        mark: Mark,
        query: ImageQuery | None,
    ) -> LabelProposal:
        return LabelProposal(
            id=id_,
            pane=pane,
            class_id=self._class_id,
            origin="map",
            element_id=self.element_id,
            mark=mark,
            score=_PLACED if query is None else None,
            depth_m=None if projection is None else projection.depth_m,
            query=query,
        )

    def _expected(self, frame_index: int) -> dict[Side, ProjectedElement]:
        T_camera_map = self.cameras.T_camera_map(frame_index)
        if T_camera_map is None:
            return {}
        mapped = {self.element_id: self._position}
        found = {
            side: projected_elements(
                frame_index, side, T_camera_map, self.cameras.rig, self.labels, mapped
            )
            for side in self.cameras.sides
        }
        return {side: each[0] for side, each in found.items() if each}

    def _placed(self, pane: Pane) -> Mark | None:
        return next((each.mark for each in self.corrected if each.pane == pane), None)

    def _query(self, pane: Pane, sides: Sequence[Side]) -> ImageQuery:
        """Return the search of an image: for what the other image of its time shows if that was
        corrected, else of both together for the nearest correction."""
        other = Pane(pane.frame_index, other_side(pane.side))
        beside = self._placed(other)
        if beside is not None:
            return CorrespondenceQuery(self._class_id, other, beside, pane, self._position)
        images = [Pane(pane.frame_index, side) for side in sides]
        return self._propagation(images, self._position)

    def _propagation(self, images: Sequence[Pane], position: Triangulated) -> PropagationQuery:
        ranks, there = self.cameras.rank, [each.pane for each in self._marked]
        moments = np.array([ranks[pane.frame_index] for pane in there])
        moments = np.abs(moments - ranks[images[0].frame_index])
        sizes, now = np.split(self.cameras.sizes_px(position, [*there, *images]), [len(there)])
        placed = moments[: len(self.corrected)]
        followed = [
            int(np.lexsort(([each.pane.side != image.side for each in self.corrected], placed))[0])
            for image in images
        ]
        return PropagationQuery(
            self._class_id,
            position,
            tuple(
                SearchImage(image, there[row], self._marked[row].mark)
                for image, row in zip(images, followed, strict=True)
            ),
            tuple(self._marked[row] for row in views_beside(moments, followed)),
            growth(sizes, float(now.max()), look_again(position)),
        )
