"""What is proposed for the images on the page: partners, mapped elements, a detector's finds.

Where an element should be follows from geometry at once; exactly where it is, and how sure that is,
only the images tell. So an offer carries a question, which a ``Looker`` answers in its own time.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from semviz.annotator.ghosts import Ghost
from semviz.annotator.panes import Pane
from semviz_annotation.assist.shot import SURE, Mark, Proposed, clipped
from semviz_annotation.labels import Labels, Observation, proposal_id
from semviz_annotation.proposals import Proposal
from semviz_annotation.triangulate import Triangulated
from semviz_core.camera import Camera
from semviz_core.sources.source import Side

Origin: TypeAlias = Literal["map", "partner", "detector"]

DETECTED_PX = 6.0
"""The same for a detector's: it marks no better than that."""
TAKEN_PX = 1.5
"""An offer this near to a label of its class lies on a thing that has one already. Poles that stand
one behind the other may well be a little further apart."""


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
class Settle:
    """Exactly where is what a detector marked in ``there``?"""

    class_id: int
    mark: Mark
    score: float
    there: Pane


Question: TypeAlias = FindPartner | Follow | Settle


@dataclass(frozen=True)
class Answer:
    """What the images say; nothing was found where ``best`` is None."""

    best: Proposed | None
    runner_up: Proposed | None = None


@dataclass(frozen=True)
class Offer:
    """An observation that is proposed for one image."""

    id: str
    """By which it is turned down."""
    pane: Pane
    class_id: int
    origin: Origin
    element_id: str | None
    """None: a detector's, of which nobody knows yet to what it belongs."""
    mark: Mark | None
    """None where only the image can tell."""
    score: float | None = None
    """Probability that the mark is within 2 px; None before anybody has looked."""
    runner_up: Proposed | None = None
    depth_m: float | None = None
    question: Question | None = None

    @property
    def is_detected(self) -> bool:
        return self.origin == "detector"

    @property
    def sure(self) -> bool:
        return self.score is not None and self.score >= SURE

    def answered(self, answer: Answer) -> "Offer":
        """With what the images say. What is expected stays where it was not found, unsure."""
        if answer.best is None:
            return replace(self, score=0.0, question=None)
        return replace(
            self,
            mark=answer.best.mark,
            score=answer.best.score,
            runner_up=answer.runner_up,
            question=None,
        )


def offers_in(
    panes: Mapping[Side, Pane],
    expected: Iterable[Expected],
    detected: Iterable[Proposal],
    labels: Labels,
    order: Mapping[int, int],
) -> list[Offer]:
    """All offers for ``panes``, before anybody has looked.

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
    offers = [*(mapped | partners).values(), *_detected(panes, detected, labels)]
    return [one for one in offers if one.id not in turned_down]


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


def _detected(
    panes: Mapping[Side, Pane], detected: Iterable[Proposal], labels: Labels
) -> list[Offer]:
    """A detector's finds, but for those that a label has spent or made needless."""
    found = []
    for one in detected:
        pane = Pane(one.frame_index, one.side)
        mark = Mark(one.anchor_px, one.end_px, one.anchor_known, one.end_known)
        rows = labels.in_frame(pane.frame_index, pane.side)
        needless = any(_gap_px(mark, row) < DETECTED_PX for row in rows)
        if pane in panes.values() and one.id not in labels.observations and not needless:
            question = Settle(one.class_id, mark, one.score, pane)
            offer = Offer(one.id, pane, one.class_id, "detector", None, mark, one.score)
            found.append(replace(offer, question=question))
    return found


def checked(offers: Sequence[Offer], labels: Labels) -> list[Offer]:
    """Answered offers, unsure where a label or another offer is in the same place.

    A detector's are left out there: what is known of an element says more.
    """
    kept: list[Offer] = []
    for one in sorted(offers, key=lambda offer: (offer.is_detected, -(offer.score or 0.0))):
        rows = labels.in_frame(one.pane.frame_index, one.pane.side)
        labelled = any(
            labels.element(row.element_id).class_id == one.class_id and _near(one.mark, row)
            for row in rows
        )
        offered = any(
            other.pane == one.pane and other.class_id == one.class_id and _same(other, one)
            for other in kept
        )
        if labelled or offered:
            if one.is_detected:
                continue
            one = replace(one, score=0.0)
        kept.append(one)
    return kept


def _near(mark: Mark | None, row: Observation) -> bool:
    return mark is not None and _gap_px(mark, row) < TAKEN_PX


def _same(one: Offer, two: Offer) -> bool:
    if one.mark is None or two.mark is None:
        return False
    if two.is_detected:
        return _gap_px(one.mark, two.mark) < DETECTED_PX
    both_known = one.score is not None and two.score is not None
    return both_known and _gap_px(one.mark, two.mark) < TAKEN_PX


def _gap_px(mark: Mark, other: Mark | Observation) -> float:
    """Between anchors; between poles, across the line of the other at the two ends of the first."""
    if mark.end_px is None or other.end_px is None:
        return float(np.hypot(*np.subtract(mark.anchor_px, other.anchor_px)))
    along = np.subtract(other.end_px, other.anchor_px)
    length = max(float(np.hypot(*along)), 1e-9)
    gaps = np.subtract([mark.anchor_px, mark.end_px], other.anchor_px)
    across = np.abs(gaps @ np.array([along[1], -along[0]])) / length
    shares = gaps @ along / length**2
    overlap = min(shares.max(), 1.0) - max(shares.min(), 0.0)
    return float(across.max()) if overlap > 0.0 else float("inf")


def inside(mark: Mark, camera: Camera) -> Mark | None:
    """What of a mark is in the image; None where nothing is."""
    part = clipped(mark, mark.ends_px, camera)
    return part if camera.contains(part.ends_px).all() else None
