"""Decide whether a pole's bottom is hidden: the ground lies clearly below it.

The bottom's depth is that of the likely stereo correspondence. Ground height comes from the
driven path and the bottoms of poles that are mapped nearby, or will be once proposals are
accepted. A bottom marked well above the ground is hidden, for example by a car.
"""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from semviz.annotator.drawing.association import CONSISTENT_PX
from semviz.annotator.drawing.draft import ElementDraft
from semviz.annotator.element_positions import ElementPositions, reprojection_error_px
from semviz.annotator.panes import Cameras, Pane, Panes
from semviz.annotator.proposals.image_worker import ImageWorker
from semviz.annotator.proposals.label_proposals import CorrespondenceQuery, LabelProposal
from semviz.annotator.proposals.proposal_selection import ProposalSelection
from semviz_annotation.assist.marked_image import Mark
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.views import other_side
from semviz_annotation.mapping.placement import triangulation
from semviz_core.common.arrays import FloatArray

_CAMERA_M, _CAMERA_SIGMA_M = 1.65, 0.3
"""Height of a car's camera above the road, as long as no bottom is known."""
_BOTTOM_SIGMA_M = 0.12
"""Kerbs, and the noise of labelled bottoms."""
_SLOPE = 0.02
"""Slope of unknown ground, metres per metre."""
_LEAST_M = 0.25
_SIGMAS = 2.5


@dataclass(frozen=True, eq=False)
class GroundModel:
    """Ground height around one stretch of a drive, in a map frame whose z is up."""

    centers_m: FloatArray
    """(k, 3) camera centres, at least one."""
    bottoms_m: FloatArray
    """(n, 3) bottoms of poles."""

    def height_m(self, point_m: FloatArray) -> tuple[float, float]:
        """Return z of the ground below a point (3,), and its standard deviation."""
        away = np.linalg.norm(self.centers_m[:, :2] - point_m[:2], axis=1)
        nearest = int(np.argmin(away))
        below = self.centers_m[nearest, 2] - _CAMERA_M
        gaps = np.linalg.norm(self.bottoms_m[:, :2] - point_m[:2], axis=1)
        heights = np.append(self.bottoms_m[:, 2], below)
        sigmas = np.append(
            np.hypot(_BOTTOM_SIGMA_M, _SLOPE * gaps),
            np.hypot(_CAMERA_SIGMA_M, _SLOPE * away[nearest]),
        )
        order = np.argsort(heights, kind="stable")
        weights = 1.0 / sigmas[order] ** 2
        middle = int(np.searchsorted(np.cumsum(weights), weights.sum() / 2.0))
        sigma = max(1.0 / np.sqrt(weights.sum()), _SLOPE * min([*gaps, away[nearest]]))
        return float(heights[order[middle]]), float(sigma)

    def is_below(self, bottom_m: FloatArray, sigma_m: float) -> bool:
        """Whether the ground is clearly below a marked bottom (3,) with a height sigma of
        ``sigma_m``: then the pole's real bottom is hidden."""
        height, sigma = self.height_m(bottom_m)
        least = max(_LEAST_M, _SIGMAS * float(np.hypot(sigma, sigma_m)))
        return bool(bottom_m[2] - height > least)


NEAR_M = 60.0
"""Poles further away are no evidence of the ground here."""
SAME_POLE_M = 0.7
"""A bottom this close may belong to the same pole."""


class HiddenEnds:
    """Decides whether bottoms are hidden. One thread at a time."""

    def __init__(
        self,
        cameras: Cameras,
        panes: Panes,
        positions: ElementPositions,
        image_worker: ImageWorker,
        selection: ProposalSelection,
    ) -> None:
        self._cameras = cameras
        self._panes = panes
        self._positions = positions
        self._image_worker = image_worker
        self._selection = selection

    def is_hidden(
        self, drawing: ElementDraft, frame_index: int, selected_id: str | None, labels: Labels
    ) -> bool:
        """Whether a drawn pole's bottom is hidden; False if that is not clear."""
        panes = self._panes.of(frame_index)
        if other_side(drawing.side) not in panes or self._cameras.T_map_camera[frame_index] is None:
            return False
        here, there = panes[drawing.side], panes[other_side(drawing.side)]
        selected = _selected_mark(drawing, here, there, selected_id, labels)
        position = None
        if selected is not None:
            position = self._triangulated({here: drawing.mark, there: selected})
        if position is None:
            query = CorrespondenceQuery(drawing.class_id, here, drawing.mark, there)
            match = self._image_worker.best(query, there)
            if match is not None and match.sure:
                position = self._triangulated({here: drawing.mark, there: match.mark})
        return self._is_above_ground(position, frame_index, labels)

    def with_hidden_ends(
        self, proposals: Iterable[LabelProposal], frame_index: int, labels: Labels
    ) -> list[LabelProposal]:
        """Return the proposals; detected poles whose bottoms lie clearly above the ground have an
        unknown end. Those of a track stay as they were detected: so they are accepted."""
        poles: dict[str, dict[Pane, Mark]] = defaultdict(dict)
        if self._cameras.T_map_camera[frame_index] is not None:
            for proposal in proposals:
                mark = proposal.mark
                is_single = proposal.is_detected and proposal.track is None
                if is_single and mark is not None and mark.end_px is not None:
                    poles[proposal.element_id][proposal.pane] = mark
        hidden = {
            name
            for name, marks in poles.items()
            if len(marks) > 1 and all(mark.end_known for mark in marks.values())
            if self._is_above_ground(self._triangulated(marks), frame_index, labels)
        }
        return [
            replace(proposal, mark=replace(proposal.mark, end_known=False))
            if proposal.element_id in hidden and proposal.mark is not None
            else proposal
            for proposal in proposals
        ]

    def _is_above_ground(
        self, position: triangulation.Triangulated | None, frame_index: int, labels: Labels
    ) -> bool:
        if position is None:
            return False
        sigma = float(np.sqrt(position.covariance_m2[5, 5]))
        return self._ground(frame_index, labels, position).is_below(position.end_m, sigma)

    def _ground(
        self, frame_index: int, labels: Labels, pole: triangulation.Triangulated
    ) -> GroundModel:
        """The ground according to the other poles around ``pole``."""
        centers = self._positions.centers_near(frame_index, NEAR_M)
        near = self._positions.near(labels, frame_index).items()
        mapped = [position for id_, position in near if not labels.is_left_out(id_)]
        positions = [*mapped, *self._confident_matches(frame_index, labels)]
        ends = [position.end_m for position in positions if position.is_line and position.end_known]
        bottoms = np.array(ends).reshape(-1, 3)
        gaps = np.linalg.norm(bottoms[:, :2] - pole.end_m[:2], axis=1)
        return GroundModel(centers, bottoms[(gaps > SAME_POLE_M) & (gaps < NEAR_M)])

    def _confident_matches(
        self, frame_index: int, labels: Labels
    ) -> list[triangulation.Triangulated]:
        """Positions of poles, taking confident correspondences as accepted."""
        panes = self._panes.of(frame_index).values()
        positions = []
        for proposal in self._selection.proposals(frame_index, labels):
            if proposal.origin == "match" and proposal.is_confident and proposal.mark is not None:
                rows = [
                    labels.find(proposal.element_id, pane.frame_index, pane.side) for pane in panes
                ]
                marks = {Pane(row.frame_index, row.side): Mark.of(row) for row in rows if row}
                positions.append(self._triangulated(marks | {proposal.pane: proposal.mark}))
        return [position for position in positions if position is not None]

    def _triangulated(self, marks: dict[Pane, Mark]) -> triangulation.Triangulated | None:
        """The position of one pole from its marks; None if they disagree."""
        views = [self._cameras.view(pane.frame_index, pane.side) for pane in marks]
        rows = [mark.at(pane.frame_index, pane.side) for pane, mark in marks.items()]
        if reprojection_error_px(views, rows) > CONSISTENT_PX:
            return None
        position = triangulation.triangulate(views, rows)
        return None if isinstance(position, triangulation.TriangulationFailure) else position


def _selected_mark(
    drawing: ElementDraft, here: Pane, there: Pane, selected_id: str | None, labels: Labels
) -> Mark | None:
    """The selected pole's mark in the other image, if the drawing may continue that pole."""
    element = labels.elements.get(selected_id or "")
    if element is None or element.class_id != drawing.class_id:
        return None
    if labels.find(element.id, here.frame_index, here.side) is not None:
        return None
    row = labels.find(element.id, there.frame_index, there.side)
    return None if row is None else Mark.of(row)
