"""What is proposed for the images on the page: partners, mapped elements, a detector's finds.

Where an element should be follows from geometry at once; exactly where it is, and how sure that is,
only the images tell. So an offer carries a question, which a ``Looker`` answers in its own time.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from semviz.annotator.ghosts import REACH_M, Ghost
from semviz.annotator.panes import Pane
from semviz_annotation.assist.shot import SURE, Mark, Proposed, clipped
from semviz_annotation.labels import Labels, proposal_id
from semviz_annotation.triangulate import Triangulated
from semviz_core.camera import Camera
from semviz_core.sources.source import Side

Origin: TypeAlias = Literal["map", "partner", "detector"]

DETECTED_PX = 6.0
"""A detector's find this near to something known is that thing: it marks no better."""


@dataclass(frozen=True)
class Expected:
    """A known element, where it should be in an image that it is not labelled in."""

    pane: Pane
    ghost: Ghost
    place: Triangulated | None
    """None where the rays tell only a direction."""


@dataclass(frozen=True)
class FindPartner:
    """Where is what is marked in ``here``, in ``there``?"""

    class_id: int
    here: Pane
    mark: Mark
    there: Pane
    element: Triangulated | None = None
    """What it is of, as far as that has a place."""


@dataclass(frozen=True)
class Sought:
    """An image to be searched, and one in which what is sought is marked."""

    there: Pane
    here: Pane
    mark: Mark


@dataclass(frozen=True)
class Follow:
    """Is a mapped element in these images of one moment too; exactly where in each?"""

    class_id: int
    element: Triangulated
    sought: tuple[Sought, ...]


@dataclass(frozen=True)
class Detected:
    """What a detector marked in an image."""

    pane: Pane
    mark: Mark
    score: float
    sigma_px: float
    sigma_along_px: float | None


@dataclass(frozen=True)
class Settle:
    """Exactly where is one thing that a detector found in one image or in two, and is it there?"""

    class_id: int
    found: tuple[Detected, ...]
    other: Pane | None
    """Where it may be too, though the detector did not find it there."""


Question: TypeAlias = FindPartner | Follow | Settle


@dataclass(frozen=True)
class Answer:
    """What the images say; nothing was found where ``best`` is None."""

    best: Proposed | None
    runner_up: Proposed | None = None
    depth_m: float | None = None
    """Of what a detector found; infinite where the images do not tell."""


@dataclass(frozen=True)
class Offer:
    """An observation that is proposed for one image."""

    id: str
    """By which it is turned down."""
    pane: Pane
    class_id: int
    origin: Origin
    element_id: str
    """Of a detector's: which there will be when it is accepted."""
    mark: Mark | None
    """None where only the image can tell."""
    score: float | None = None
    """Probability that the mark is within 2 px, of a detector's that all its marks are; None before
    anybody has looked."""
    runner_up: Proposed | None = None
    depth_m: float | None = None
    question: Question | None = None
    turned_down: bool = False
    """Nobody wants to see it; but what else is found in its place is turned down with it."""
    refused: bool = False
    """The same thing was turned down in another frame: it is shown, but never sure."""

    @property
    def is_detected(self) -> bool:
        return self.origin == "detector"

    @property
    def sure(self) -> bool:
        """Whether a key may take it along with the others."""
        too_far = self.is_detected and (self.depth_m or 0.0) > REACH_M
        return self.score is not None and self.score >= SURE and not (too_far or self.refused)

    def answered(self, answer: Answer) -> "Offer":
        """With what the images say. What is expected stays where it was not found, unsure."""
        if answer.best is None:
            return replace(self, score=0.0, question=None)
        return replace(
            self,
            mark=answer.best.mark,
            score=answer.best.score,
            runner_up=answer.runner_up,
            depth_m=self.depth_m if answer.depth_m is None else answer.depth_m,
            question=None,
        )


def offers_in(
    panes: Mapping[Side, Pane],
    expected: Iterable[Expected],
    labels: Labels,
    order: Mapping[int, int],
) -> list[Offer]:
    """All offers of elements for ``panes``, before anybody has looked.

    ``order`` is the place of each frame in time.
    """
    turned_down = {
        one.id for pane in panes.values() for one in labels.dismissed_in(pane.frame_index)
    }
    expected = list(expected)
    mapped = {one.id: one for one in _expected(expected, labels, order)}
    places = {one.ghost.element_id: one.place for one in expected}
    partners = {one.id: one for one in _partners(panes, labels, places)}
    for both in mapped.keys() & partners.keys():  # the other image of the same moment says more
        partners[both] = replace(partners[both], mark=mapped[both].mark)
    return [replace(one, turned_down=one.id in turned_down) for one in (mapped | partners).values()]


def _partners(
    panes: Mapping[Side, Pane], labels: Labels, places: Mapping[str, Triangulated | None]
) -> list[Offer]:
    """What is labelled in one of two images is proposed for the other."""
    if len(panes) < 2:
        return []
    found = []
    for here, there in ((panes["left"], panes["right"]), (panes["right"], panes["left"])):
        for row in labels.in_frame(here.frame_index, here.side):
            if labels.find(row.element_id, there.frame_index, there.side) is None:
                class_id = labels.element(row.element_id).class_id
                place = places.get(row.element_id)
                offer = Offer(
                    id=proposal_id(row.element_id, there.frame_index, there.side),
                    pane=there,
                    class_id=class_id,
                    origin="partner",
                    element_id=row.element_id,
                    mark=None,
                    question=FindPartner(class_id, here, Mark.of(row), there, place),
                )
                found.append(offer)
    return found


def _expected(
    expected: Sequence[Expected], labels: Labels, order: Mapping[int, int]
) -> list[Offer]:
    found = []
    for one in expected:
        pane, ghost = one.pane, one.ghost
        class_id = labels.element(ghost.element_id).class_id
        offer = Offer(
            id=proposal_id(ghost.element_id, pane.frame_index, pane.side),
            pane=pane,
            class_id=class_id,
            origin="map",
            element_id=ghost.element_id,
            mark=Mark(ghost.anchor_px, ghost.end_px),
            depth_m=ghost.depth_m if np.isfinite(ghost.depth_m) else None,
        )
        if one.place is None:  # too vague to be looked for
            offer = replace(offer, score=0.0)
        else:
            panes = [
                other.pane
                for other in expected
                if other.ghost.element_id == ghost.element_id
                and other.pane.frame_index == pane.frame_index
            ]
            sought = tuple(_sought(ghost.element_id, pane, labels, order) for pane in panes)
            offer = replace(offer, question=Follow(class_id, one.place, sought))
        found.append(offer)
    return found


def _sought(element_id: str, there: Pane, labels: Labels, order: Mapping[int, int]) -> Sought:
    """With the labelled image of an element nearest in time, of the same camera if it may be."""
    rows = [one for one in labels.of_element(element_id) if one.frame_index in order]
    here = order[there.frame_index]
    row = min(rows, key=lambda one: (abs(order[one.frame_index] - here), one.side != there.side))
    return Sought(there, Pane(row.frame_index, row.side), Mark.of(row))


def inside(mark: Mark, camera: Camera) -> Mark | None:
    """What of a mark is in the image; None where nothing is."""
    part = clipped(mark, mark.ends_px, camera)
    return part if camera.contains(part.ends_px).all() else None
