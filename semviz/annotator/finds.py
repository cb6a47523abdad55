"""What a detector found, thing by thing, as offers: one key accepts it in both images."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from semviz.annotator.cameras import Cameras
from semviz.annotator.offers import DETECTED_PX, Detected, Offer, Settle
from semviz.annotator.panes import Pane
from semviz_annotation.assist.pairs import stereo_pairs
from semviz_annotation.assist.shot import Mark
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


def offers_of(finds: Iterable[Find], panes: Mapping[Side, Pane], labels: Labels) -> list[Offer]:
    """Finds that no label has spent and nobody has turned down, before anybody has looked.

    A find in one image is offered in the other too, where the images show its partner.
    """
    return [
        offer
        for find in finds
        if not any(_is_settled(one, labels) for one in find.proposals)
        for offer in _offers(find, panes.values())
    ]


def _is_settled(one: Proposal, labels: Labels) -> bool:
    """Accepted, turned down, or where something of its kind is labelled anyhow."""
    mark = _mark(one)
    return (
        one.id in labels.observations
        or one.id in labels.dismissals
        or any(
            mark.is_line == (row.end_px is not None) and mark.gap_px(Mark.of(row)) < DETECTED_PX
            for row in labels.in_frame(one.frame_index, one.side)
        )
    )


def _offers(find: Find, panes: Iterable[Pane]) -> Sequence[Offer]:
    """One for each image, all with the same question."""
    seen = {Pane(one.frame_index, one.side): one for one in find.proposals}
    others = [pane for pane in panes if pane not in seen]
    class_id = find.proposals[0].class_id
    found = tuple(Detected(pane, _mark(one), one.score) for pane, one in seen.items())
    question = Settle(class_id, found, others[0] if others else None)

    def offer(pane: Pane, name: str, mark: Mark | None) -> Offer:
        return Offer(name, pane, class_id, "detector", find.element_id, mark, question=question)

    return [
        *(offer(pane, one.id, _mark(one)) for pane, one in seen.items()),
        *(offer(one, _name(find, one), None) for one in others),
    ]


def _name(find: Find, pane: Pane) -> str:
    """Of an offer where the detector found nothing."""
    return proposal_id(find.element_id, pane.frame_index, pane.side)


def _mark(one: Proposal) -> Mark:
    return Mark(one.anchor_px, one.end_px, one.anchor_known, one.end_known)
