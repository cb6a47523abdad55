"""Truth of the scripted annotator: what is visible in a street, and which marks are right."""

from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import numpy as np
from drives import SIDES, Drive, focal_px

from semviz.annotator.proposals.proposal_views import ProposalMark, ProposalView
from semviz_annotation.labels.labels import Labels
from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.base.frame import Side

REACH_M = 40.0
RIGHT_PX, RIGHT_M = 2.0, 0.04
"""A mark this near to the truth, by one or the other, is right: across a pole, to a middle."""
ALONG_PX, ALONG_M = 6.0, 0.12
"""And along a pole, where the mark says that an end is seen and it is."""
NEAR_PX = 12.0
"""What is wrong but so near to an element is meant for it."""


@dataclass(frozen=True)
class Truth:
    """What is visible in a frame: marks by element, in one image or both."""

    marks: dict[int, dict[str, tuple[np.ndarray, np.ndarray]]]
    known: dict[int, dict[str, tuple[bool, bool]]]
    """Whether a pole's peak and bottom are to be seen."""
    class_id: dict[int, int]
    depth_m: dict[int, float]
    focal_px: float
    measured: set[int]
    """Elements whose marks were measured in all images of this frame."""

    @property
    def wanted(self) -> list[int]:
        """What is to be labelled: near, and in both images. Class by class."""
        both = [mark for mark in self.marks if mark in self.measured]
        near = [element for element in both if self.depth_m[element] < REACH_M]
        return sorted(near, key=lambda element: (self.class_id[element], self.depth_m[element]))

    def is_right(self, element: int, side: Side, anchor: Any, end: Any) -> bool:
        if side not in self.marks[element]:
            return False
        return error_px((anchor, end), self.marks[element][side]) <= self.within_px(
            element, RIGHT_PX, RIGHT_M
        )

    def are_ends_right(self, element: int, side: Side, offered: ProposalMark) -> bool:
        """Of a proposed mark that ``is_right``: those that it says are seen, and are."""
        if offered.end is None:
            return True
        both_known = np.array([offered.anchor_known, offered.end_known])
        both_known &= self.known[element][side]
        ends = np.array([offered.anchor, offered.end])
        gaps = np.linalg.norm(ends - self.marks[element][side], axis=1)
        return bool((gaps[both_known] <= self.within_px(element, ALONG_PX, ALONG_M)).all())

    def middle(self, element: int, side: Side) -> np.ndarray:
        return np.asarray(np.nanmean(self.marks[element][side], axis=0))

    def named(self, element: int) -> str:
        name = DEFAULT_CLASSES[self.class_id[element]].name
        return f"{name} {element} at {self.depth_m[element]:.0f} m"

    def within_px(self, element: int, pixels: float, metres: float) -> float:
        return max(pixels, metres * self.focal_px / self.depth_m[element])


def truth_of(drive: Drive, frame: int) -> Truth:
    seen = {side: drive.known(frame, side) for side in SIDES}
    measured = set.intersection(*(set(drive.seen(frame, side)) for side in SIDES))
    depths = drive.depths_m(frame)
    visible = sorted((seen["left"].keys() | seen["right"].keys()) & depths.keys())
    marks = {
        element: {side: seen[side][element][:2] for side in SIDES if element in seen[side]}
        for element in visible
    }
    known = {
        element: {side: seen[side][element][3] for side in SIDES if element in seen[side]}
        for element in visible
    }
    return Truth(
        marks,
        known,
        {element: (seen["left"].get(element) or seen["right"][element])[2] for element in visible},
        depths,
        focal_px(drive.source.rig.left),
        measured,
    )


def meant(offer: ProposalView, truth: Truth) -> int | None:
    """The element that all marks of a proposal are right for."""
    sides = [side for side in SIDES if side in offer.marks]
    for element in truth.marks:
        if truth.class_id[element] == offer.class_id and all(
            truth.is_right(element, side, offer.marks[side].anchor, offer.marks[side].end)
            and truth.are_ends_right(element, side, offer.marks[side])
            for side in sides
        ):
            return element
    return None


def error_px(mark: tuple[Any, Any], truth: tuple[np.ndarray, np.ndarray]) -> float:
    """Of a sign's middle; across the true line at both ends of a pole, if they overlap at all."""
    anchor, end = truth
    if (mark[1] is None) != (not np.isfinite(end).all()):
        return float("inf")
    if mark[1] is None:
        return float(np.hypot(*np.subtract(mark[0], anchor)))
    along = end - anchor
    gaps = np.subtract([mark[0], mark[1]], anchor)
    shares = gaps @ along / (along @ along)
    if shares.max() < 0.2 or shares.min() > 0.8:
        return float("inf")
    across = gaps @ np.array([along[1], -along[0]]) / np.linalg.norm(along)
    return float(np.abs(across).max())


def flags_right(labels: Labels, drive: Drive) -> tuple[float, float]:
    """Shares of the poles' ends in labels that are said to be seen, and hidden, of those that
    truly are."""
    said: dict[bool, list[bool]] = {True: [], False: []}
    for row in labels.observations.values():
        if row.end_px is None:
            continue
        marks = list(drive.known(row.frame_index, row.side).values())
        gaps = [error_px((row.anchor_px, row.end_px), mark[:2]) for mark in marks]
        if min(gaps, default=np.inf) <= RIGHT_PX:
            known = marks[int(np.argmin(gaps))][3]
            for told, true in zip((row.anchor_known, row.end_known), known, strict=True):
                said[true].append(told == true)
    return float(np.mean(said[True])), float(np.mean(said[False]))


def errors_px(labels: Labels, drive: Drive) -> dict[int, list[float]]:
    """How far each label is from the nearest truth of its kind, by class."""
    errors: dict[int, list[float]] = defaultdict(list)
    for row in labels.observations.values():
        marks = drive.known(row.frame_index, row.side).values()
        gaps = [error_px((row.anchor_px, row.end_px), mark[:2]) for mark in marks]
        class_id = labels.element(row.element_id).class_id
        errors[class_id].append(min(gaps, default=float("inf")))
    return errors


def is_about(offer: ProposalView, truth: Truth, element: int, near_px: float = NEAR_PX) -> bool:
    """Whether a proposal lies near an element, of whatever class, in one of the images."""
    return any(
        error_px((offer.marks[side].anchor, offer.marks[side].end), marks) < near_px
        for side, marks in truth.marks[element].items()
        if side in offer.marks
    )


def why_wrong(offer: ProposalView, truth: Truth) -> str:
    """What a proposal that is right for nothing has wrong; of an element that it may mean."""
    about = [mark for mark in truth.marks if is_about(offer, truth, mark)]
    if not about:
        return "nothing there"
    alike = [element for element in about if truth.class_id[element] == offer.class_id]
    if not alike:
        return "another class"
    sides = [side for side in SIDES if side in offer.marks]
    right = {
        element: [
            truth.is_right(element, side, offer.marks[side].anchor, offer.marks[side].end)
            for side in sides
        ]
        for element in alike
    }
    if any(all(each) for each in right.values()):
        element = next(element for element, each in right.items() if all(each))
        if all(truth.are_ends_right(element, side, offer.marks[side]) for side in sides):
            return "another element than it was"
        return "an end is off along it"
    return "off in one image" if any(any(each) for each in right.values()) else "off"


def told(offer: ProposalView) -> str:
    marks = ", ".join(
        f"{side} {np.round(offer.marks[side].anchor).tolist()} {offer.marks[side].anchor_known:d}"
        + (
            f" to {np.round(offer.marks[side].end).tolist()} {offer.marks[side].end_known:d}"
            if offer.marks[side].end
            else ""
        )
        for side in SIDES
        if side in offer.marks
    )
    return f"{offer.origin}, class {offer.class_id}, score {offer.score or 0.0:.2f}: {marks}"
