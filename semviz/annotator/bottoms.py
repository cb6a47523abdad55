"""Whether the bottom of a pole that is being drawn, or that a detector found, is hidden: the ground
is clearly below it.

Depth is that of its likely partner in the other image. Where the ground is, the drive tells, and
the bottoms of poles that are mapped nearby, or will be once their partners are accepted.
"""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from semviz.annotator.cameras import Cameras
from semviz.annotator.fit import misfit_px
from semviz.annotator.hand import Drawing
from semviz.annotator.looker import Looker
from semviz.annotator.offers import FindPartner, Offer
from semviz.annotator.pairing import CONSISTENT_PX
from semviz.annotator.panes import Pane, Panes
from semviz.annotator.places import Places
from semviz.annotator.proposing import Proposing
from semviz_annotation.assist.ground import Ground
from semviz_annotation.assist.shot import Mark
from semviz_annotation.labels import Labels
from semviz_annotation.triangulate import Failed, Triangulated, triangulate
from semviz_annotation.view import other

NEAR_M = 60.0
"""What is further away says nothing about the ground here."""
OTHER_M = 0.7
"""A bottom this near may well be of the same pole."""


class Bottoms:
    """Judges bottoms. One thread at a time."""

    def __init__(
        self, cameras: Cameras, panes: Panes, places: Places, looker: Looker, proposing: Proposing
    ) -> None:
        self._cameras = cameras
        self._panes = panes
        self._places = places
        self._looker = looker
        self._proposing = proposing

    def is_hidden(
        self, drawing: Drawing, frame_index: int, selected_id: str | None, labels: Labels
    ) -> bool:
        """Of a pole. Unless that is clear, it is not."""
        panes = self._panes.of(frame_index)
        if other(drawing.side) not in panes or self._cameras.T_map_camera[frame_index] is None:
            return False
        here, there = panes[drawing.side], panes[other(drawing.side)]
        selected = _going_on(drawing, here, there, selected_id, labels)
        place = None if selected is None else self._place({here: drawing.mark, there: selected})
        if place is None:
            question = FindPartner(drawing.class_id, here, drawing.mark, there)
            found = self._looker.found(question, there)
            if found is not None and found.sure:
                place = self._place({here: drawing.mark, there: found.mark})
        return self._is_above_ground(place, frame_index, labels)

    def judged(self, offers: Iterable[Offer], frame_index: int, labels: Labels) -> list[Offer]:
        """Offers, with the bottoms of a detector's poles hidden where the ground is clearly
        below them."""
        found: dict[str, dict[Pane, Mark]] = defaultdict(dict)
        if self._cameras.T_map_camera[frame_index] is not None:
            for one in offers:
                if one.is_detected and one.mark is not None and one.mark.end_px is not None:
                    found[one.element_id][one.pane] = one.mark
        hidden = {
            name
            for name, marks in found.items()
            if len(marks) > 1 and all(one.end_known for one in marks.values())
            if self._is_above_ground(self._place(marks), frame_index, labels)
        }
        return [
            replace(one, mark=replace(one.mark, end_known=False))
            if one.element_id in hidden and one.mark is not None
            else one
            for one in offers
        ]

    def _is_above_ground(
        self, place: Triangulated | None, frame_index: int, labels: Labels
    ) -> bool:
        if place is None:
            return False
        sigma = float(np.sqrt(place.covariance_m2[5, 5]))
        return self._ground(frame_index, labels, place).is_below(place.end_m, sigma)

    def _ground(self, frame_index: int, labels: Labels, around: Triangulated) -> Ground:
        """As other poles show it."""
        centers = self._places.centers_near(frame_index, NEAR_M)
        mapped = self._places.near(labels, frame_index).values()
        places = [*mapped, *self._partnered(frame_index, labels)]
        ends = [one.end_m for one in places if one.is_line and one.end_known]
        bottoms = np.array(ends).reshape(-1, 3)
        gaps = np.linalg.norm(bottoms[:, :2] - around.end_m[:2], axis=1)
        return Ground(centers, bottoms[(gaps > OTHER_M) & (gaps < NEAR_M)])

    def _partnered(self, frame_index: int, labels: Labels) -> list[Triangulated]:
        """Where poles are if their partners are those that are proposed and sure."""
        shown = self._panes.of(frame_index).values()
        places = []
        for one in self._proposing.offers(frame_index, labels):
            if one.origin == "partner" and one.sure and one.mark is not None:
                rows = [labels.find(one.element_id, each.frame_index, each.side) for each in shown]
                here = {Pane(row.frame_index, row.side): Mark.of(row) for row in rows if row}
                places.append(self._place(here | {one.pane: one.mark}))
        return [one for one in places if one is not None]

    def _place(self, marks: dict[Pane, Mark]) -> Triangulated | None:
        views = [self._cameras.view(pane.frame_index, pane.side) for pane in marks]
        rows = [one.at(pane.frame_index, pane.side) for pane, one in marks.items()]
        if misfit_px(views, rows) > CONSISTENT_PX:
            return None
        place = triangulate(views, rows)
        return None if isinstance(place, Failed) else place


def _going_on(
    drawing: Drawing, here: Pane, there: Pane, selected_id: str | None, labels: Labels
) -> Mark | None:
    """A selected pole in the other image that is not labelled in this one: it may go on here."""
    element = labels.elements.get(selected_id or "")
    if element is None or element.class_id != drawing.class_id:
        return None
    if labels.find(element.id, here.frame_index, here.side) is not None:
        return None
    row = labels.find(element.id, there.frame_index, there.side)
    return None if row is None else Mark.of(row)
