"""What a detector found, thing by thing, as offers: one key accepts it in both images."""

from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np

from semviz.annotator.cameras import Cameras
from semviz.annotator.offers import DETECTED_PX, Detected, Offer, Settle
from semviz.annotator.panes import Pane
from semviz_annotation.assist.pairs import stereo_pairs
from semviz_annotation.assist.shot import Mark, both_ends_px, gaps_px
from semviz_annotation.labels import Labels, proposal_id
from semviz_annotation.proposals import Proposal, Proposals
from semviz_annotation.rows import derived_id
from semviz_core.sources.source import Side


@dataclass(frozen=True)
class Find:
    """One thing that a detector found."""

    proposals: tuple[Proposal, ...]
    """In one image, or in both of those on the page."""

    @property
    def element_id(self) -> str:
        """Of the element that it becomes when it is accepted."""
        return derived_id(f"thing {self.proposals[0].id}")

    @property
    def score(self) -> float:
        """The detector's own, of the image where it is surer."""
        return max(one.score for one in self.proposals)

    def is_turned_down(self, labels: Labels) -> bool:
        return any(one.id in labels.dismissals for one in self.proposals)


def finds_in(panes: Mapping[Side, Pane], detected: Proposals, cameras: Cameras) -> tuple[Find, ...]:
    """All finds in the images on the page, those that are one thing in both together."""
    seen = [detected.in_frame(pane.frame_index, pane.side) for pane in panes.values()]
    if len(seen) < 2:
        return tuple(Find((one,)) for found in seen for one in found)
    here, there = (cameras.view(pane.frame_index, pane.side) for pane in panes.values())
    pairs = dict(stereo_pairs(here, there, *seen))
    partners = {seen[1][n].id for n in pairs.values()}
    finds = [
        Find((one, seen[1][pairs[n]])) if n in pairs else Find((one,))
        for n, one in enumerate(seen[0])
    ]
    return (*finds, *(Find((one,)) for one in seen[1] if one.id not in partners))


def offers_of(
    finds: Iterable[Find], panes: Mapping[Side, Pane], labels: Labels, refused: Set[str]
) -> list[Offer]:
    """Finds that no label has spent, before anybody has looked.

    A find in one image is offered in the other too, where the images show its partner. Those whose
    element ids are among ``refused`` were turned down in another frame.
    """
    finds = list(finds)
    spent = labelled([one for find in finds for one in find.proposals], labels)
    return [
        replace(offer, refused=find.element_id in refused)
        for find in finds
        if not any(one.id in spent for one in find.proposals)
        for offer in _offers(find, panes.values(), find.is_turned_down(labels))
    ]


def labelled(proposals: Sequence[Proposal], labels: Labels) -> set[str]:
    """Ids of those that were accepted, or where something of their kind is labelled anyhow."""
    found = {one.id for one in proposals if one.id in labels.observations}
    for pane in {Pane(one.frame_index, one.side) for one in proposals}:
        here = [one for one in proposals if pane == Pane(one.frame_index, one.side)]
        rows = labels.in_frame(pane.frame_index, pane.side)
        ends, others = both_ends_px(map(mark_of, here)), both_ends_px(map(Mark.of, rows))
        near = np.argwhere(gaps_px(ends, others) < DETECTED_PX)
        found |= {here[row].id for row, _ in near.tolist()}
    return found


def _offers(find: Find, panes: Iterable[Pane], turned_down: bool) -> Sequence[Offer]:
    """One for each image, all with the same question."""
    seen = {Pane(one.frame_index, one.side): one for one in find.proposals}
    others = [pane for pane in panes if pane not in seen]
    class_id = find.proposals[0].class_id
    found = tuple(
        Detected(pane, mark_of(one), one.score, one.sigma_px, one.sigma_along_px)
        for pane, one in seen.items()
    )
    question = Settle(class_id, found, others[0] if others else None)

    def offer(pane: Pane, name: str, mark: Mark | None) -> Offer:
        return Offer(
            name,
            pane,
            class_id,
            "detector",
            find.element_id,
            mark,
            question=question,
            turned_down=turned_down,
        )

    return [
        *(offer(pane, one.id, mark_of(one)) for pane, one in seen.items()),
        *(offer(one, _name(find, one), None) for one in others),
    ]


def _name(find: Find, pane: Pane) -> str:
    """Of an offer where the detector found nothing."""
    return proposal_id(find.element_id, pane.frame_index, pane.side)


def mark_of(one: Proposal) -> Mark:
    """What a detector marked."""
    return Mark(one.anchor_px, one.end_px, one.anchor_known, one.end_known)
