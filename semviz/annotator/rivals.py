"""Offers that are in one place, or where a label is already: which of them stay, and how sure."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace

from semviz.annotator.offers import DETECTED_PX, Offer
from semviz_annotation.assist.shot import Mark
from semviz_annotation.labels import Labels

TAKEN_PX = 1.5
"""An offer this near to a label of its class lies on a thing that has one already. Poles that stand
one behind the other may well be a little further apart."""
_ON_LINE_PX = 1.0
"""A pole that a detector found is surely the one that is followed if it is no further off."""


def checked(offers: Sequence[Offer], labels: Labels) -> list[Offer]:
    """Answered offers, unsure where a label or another offer is in the same place.

    What a detector found there is left out: more is known of an element. It may know better though
    where that is, or see its peak. What was turned down is left out, with all that a detector
    found there.
    """
    known = _known([one for one in offers if not one.turned_down], labels)
    down = [one for one in offers if one.turned_down]
    found: dict[str, list[Offer]] = defaultdict(list)
    for one in offers:
        if one.is_detected and not one.turned_down:
            found[one.element_id].append(one)
    new: list[Offer] = []
    for thing in sorted(found.values(), key=lambda marks: -(marks[0].score or 0.0)):
        meant = {n for n, other in enumerate(known) if any(_is_at(one, other) for one in thing)}
        for n in meant:
            known[n] = _joined(known[n], thing)
        known = _seen_further(known, thing)
        taken = any(_is_labelled(one, labels, DETECTED_PX) for one in thing)
        if not (
            meant or taken or any(_is_at(one, other) for one in thing for other in [*down, *new])
        ):
            new += thing
    return [*known, *new]


def _known(offers: Sequence[Offer], labels: Labels) -> list[Offer]:
    """Those of elements; unsure where something else is in the same place, the better one first."""
    kept: list[Offer] = []
    for one in sorted(offers, key=lambda offer: -(offer.score or 0.0)):
        if one.is_detected:
            continue
        if _is_labelled(one, labels, TAKEN_PX, one.class_id) or any(
            _same(other, one) for other in kept
        ):
            one = replace(one, score=0.0)
        kept.append(one)
    return kept


def _joined(known: Offer, thing: Sequence[Offer]) -> Offer:
    """What is expected but not clear is where a detector surely found something of its class."""
    for one in thing:
        if not known.sure and one.sure and one.class_id == known.class_id and _is_at(one, known):
            return replace(known, mark=one.mark, score=one.score, runner_up=None)
    return known


def _seen_further(known: list[Offer], thing: Sequence[Offer]) -> list[Offer]:
    """Surely followed poles, with the peaks that only a detector sees of them.

    It must have found them in more than one image, and on their lines in all: in a single one poles
    may stand one behind the other.
    """
    on_line = {
        n: one
        for n, other in enumerate(known)
        for one in thing
        if other.sure and one.sure and one.class_id == other.class_id
        if one.pane == other.pane and _is_on_line(one.mark, other.mark)
    }
    images = Counter(known[n].element_id for n in on_line)
    return [
        replace(one, mark=_with_peak(one.mark, on_line[n].mark))
        if n in on_line and images[one.element_id] == len(thing) > 1
        else one
        for n, one in enumerate(known)
    ]


def _is_on_line(one: Mark | None, other: Mark | None) -> bool:
    return one is not None and other is not None and one.gap_px(other) <= _ON_LINE_PX


def _with_peak(mark: Mark | None, found: Mark | None) -> Mark | None:
    """A pole's mark with its peak, if only ``found`` knows it. Not so with bottoms: what hides one
    often looks like its end."""
    if mark is None or found is None or mark.end_px is None:
        return mark
    if found.anchor_known and not mark.anchor_known:
        return replace(mark, anchor_px=found.anchor_px, anchor_known=True)
    return mark


def _is_labelled(
    offer: Offer, labels: Labels, within_px: float, class_id: int | None = None
) -> bool:
    """Whether a label lies where something is offered; of one class only where that is given."""
    return offer.mark is not None and any(
        offer.mark.gap_px(Mark.of(row)) < within_px
        for row in labels.in_frame(offer.pane.frame_index, offer.pane.side)
        if class_id in (None, labels.element(row.element_id).class_id)
    )


def _is_at(found: Offer, other: Offer) -> bool:
    """Whether a detector's find and another offer are of one place, whatever class it may have."""
    if found.mark is None or other.mark is None or found.pane != other.pane:
        return False
    return found.mark.gap_px(other.mark) < DETECTED_PX


def _same(one: Offer, two: Offer) -> bool:
    if one.mark is None or two.mark is None or one.pane != two.pane:
        return False
    both_known = one.score is not None and two.score is not None
    alike = one.class_id == two.class_id and one.mark.gap_px(two.mark) < TAKEN_PX
    return both_known and alike
