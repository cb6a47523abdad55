"""Where a detector sees something else in a frame than people labelled and mapped."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from semviz.annotator.finds import Find, mark_of
from semviz.annotator.ghosts import Ghost
from semviz.annotator.panes import Pane
from semviz_annotation.assist.shot import Mark, both_ends_px, gaps_px
from semviz_annotation.labels import Labels, proposal_id
from semviz_annotation.proposals import Proposals

SURELY = 0.5
"""What a detector gives at least this score it surely sees."""
NEAR_PX = 8.0
"""What is this near, and of the same kind, is the same thing."""
REACH_M = 40.0
"""Nobody blames a detector for what is further away."""
MAPPED, LABELLED = 0.5, 1.0
"""How much it weighs that a thing is not seen: where it was labelled, and where it should be but
something may well hide it."""


@dataclass(frozen=True)
class Disagreement:
    """About one frame."""

    new: int
    """Things that a detector surely sees, where nothing is labelled, mapped or turned down."""
    unseen: int
    """Elements labelled here, or mapped and in view, that it does not see in any image of it."""
    weight: float
    """The larger the worse: scores of the new ones, ``MAPPED`` or ``LABELLED`` for each unseen."""
    worst_id: str | None
    """The element that weighs most, or that a find will be of."""


@dataclass(frozen=True)
class Known:
    """What there is in an image, as far as people know."""

    element_id: str
    pane: Pane
    mark: Mark
    weight: float
    """If it is not seen; 0 for what is far away, and where somebody said that it can't be."""


def looked_at(panes: Iterable[Pane], detected: Proposals) -> list[Pane]:
    """Those that a detector looked at: if nobody says it, those in which it found something."""
    if detected.looked is not None:
        return [one for one in panes if (one.frame_index, one.side) in detected.looked.images]
    return [one for one in panes if detected.in_frame(one.frame_index, one.side)]


def disagreement(
    looked: Sequence[Pane], finds: Iterable[Find], known: Iterable[Known], labels: Labels
) -> Disagreement:
    """Of images that were ``looked`` at: ``finds``, and what is ``known`` to be in them."""
    there: dict[Pane, list[Known]] = defaultdict(list)
    for one in known:
        there[one.pane].append(one)
    found: dict[Pane, list[tuple[Find, Mark]]] = defaultdict(list)
    for find in finds:
        for proposal in find.proposals:
            found[Pane(proposal.frame_index, proposal.side)].append((find, mark_of(proposal)))
    matched: set[str] = set()
    seen: set[str] = set()
    for pane in looked:
        near = gaps_px(
            both_ends_px([mark for _, mark in found[pane]]),
            both_ends_px([one.mark for one in there[pane]]),
        )
        for row, column in np.argwhere(near < NEAR_PX).tolist():
            matched.add(found[pane][row][0].element_id)
            seen.add(there[pane][column].element_id)
    here = {find.element_id: find for pane in looked for find, _ in found[pane]}
    unmatched = [find for name, find in here.items() if name not in matched]
    missing = [one for pane in looked for one in there[pane] if one.element_id not in seen]
    return _summed(unmatched, missing, labels)


def _summed(finds: Iterable[Find], missing: Iterable[Known], labels: Labels) -> Disagreement:
    """Of finds where nothing is known, and what is known where nothing was found."""
    new = {
        one.element_id: one.score
        for one in finds
        if one.score >= SURELY and not one.is_turned_down(labels)
    }
    unseen: dict[str, float] = {}
    for one in missing:
        if one.weight > 0.0:
            unseen[one.element_id] = max(one.weight, unseen.get(one.element_id, 0.0))
    weights = new | unseen
    worst = max(weights, key=lambda name: weights[name], default=None)
    return Disagreement(len(new), len(unseen), sum(weights.values()), worst)


def known_in(
    looked: Iterable[Pane],
    ghosts: Iterable[Ghost],
    labels: Labels,
    depth_m: Callable[[str], float],
) -> list[Known]:
    """What is labelled in images, and the ``ghosts`` of the mapped elements that are not.

    ``depth_m`` says how far away an element is.
    """
    known = []
    for pane in looked:
        for row in labels.in_frame(pane.frame_index, pane.side):
            weight = LABELLED if depth_m(row.element_id) <= REACH_M else 0.0
            known.append(Known(row.element_id, pane, Mark.of(row), weight))
        reviewed = labels.review(pane.frame_index) in ("reviewed", "reviewed, empty")
        for ghost in ghosts:
            if ghost.side == pane.side:
                name = proposal_id(ghost.element_id, pane.frame_index, pane.side)
                told = reviewed or name in labels.dismissals
                weight = 0.0 if told or ghost.depth_m > REACH_M else MAPPED
                mark = Mark(ghost.anchor_px, ghost.end_px)
                known.append(Known(ghost.element_id, pane, mark, weight))
    return known
