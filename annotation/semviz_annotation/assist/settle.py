"""Exactly where is what a detector found, in both images, and how likely it is there at all."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semviz_annotation.assist.partner import Partners, find_partner
from semviz_annotation.assist.score import probability
from semviz_annotation.assist.shot import Mark, Proposed, Shot
from semviz_annotation.assist.snap import CLEAR, best_snap
from semviz_annotation.assist.warp import end_on_line
from semviz_core.arrays import FloatArray
from semviz_core.classes import ElementClass

_PARTNER = 0.5
"""A partner that is less likely is none."""
_SAME_END_PX = 6.0
"""What two images say of an end of a pole is of one point if it differs by less, along the pole."""
_MOST_LOGIT = 5.0
_MOST_GAP_PX = 10.0


@dataclass(frozen=True, eq=False)
class Found:
    """What a detector marked in one image."""

    shot: Shot
    mark: Mark
    score: float


@dataclass(frozen=True, eq=False)
class Settled:
    """Where it is in each image, with what speaks for all of that together."""

    marks: tuple[Mark, ...]
    """In the images where it was found; then in the other, if it was looked for and is there."""
    what: str
    evidence: FloatArray

    @property
    def score(self) -> float:
        """Estimated probability that there is such a thing, and every mark within 2 px of it."""
        return probability(self.what, self.evidence)

    @property
    def proposed(self) -> tuple[Proposed, ...]:
        return tuple(Proposed(one, self.score) for one in self.marks)


def settle(found: Sequence[Found], other: Shot | None, element_class: ElementClass) -> Settled:
    """What a detector found in one image or in two, on the edges that it is meant to be on.

    ``other`` is the second image where it was found in one. An end of a pole counts as seen where
    both images show it, at one point of the pole.
    """
    kind = "pole" if element_class.kind == "line" else "sign"
    marks, clear = zip(*(_snapped(one, element_class) for one in found), strict=True)
    scores = [_logit(one.score) for one in found]
    if len(found) == 2:
        partners = find_partner(found[0].shot, found[1].shot, marks[0], element_class)
        alike = _agreement(partners, marks[1])
        both = _agreed(found[0].shot, found[1].shot, *marks)
        return Settled(both, f"found pair {kind}", np.array([*scores, *clear, *alike]))
    partners = (
        None if other is None else find_partner(found[0].shot, other, marks[0], element_class)
    )
    if partners is None or partners.best.score < _PARTNER:
        return Settled(marks, f"found alone {kind}", np.array([*scores, *clear]))
    evidence = np.array([*scores, *clear, _logit(partners.best.score)])
    return Settled((marks[0], partners.best.mark), f"found one {kind}", evidence)


def _snapped(found: Found, element_class: ElementClass) -> tuple[Mark, float]:
    """Where the edges are clear, on them; and how clear they are."""
    best = best_snap(found.shot, found.mark, element_class)
    if best is None:
        return found.mark, -_MOST_LOGIT
    what = "snap pole" if found.mark.end_px is not None else "snap sign"
    clear = probability(what, best.evidence)
    return (best.snapped.mark if clear >= CLEAR else found.mark), _logit(clear)


def _agreement(partners: Partners | None, mark: Mark) -> tuple[float, float]:
    """How likely the image alone thinks a partner is the right one, and how far off it is."""
    tried = () if partners is None else (partners.best, partners.runner_up)
    near = [(min(one.mark.gap_px(mark), _MOST_GAP_PX), one) for one in tried if one is not None]
    if not near:
        return -_MOST_LOGIT, float(np.log1p(_MOST_GAP_PX))
    gap, one = min(near, key=lambda each: each[0])
    return _logit(one.score), float(np.log1p(gap))


def _agreed(here: Shot, there: Shot, one: Mark, other: Mark) -> tuple[Mark, Mark]:
    """With the ends as known that both images show, at one point of the pole."""
    known = [True, True]
    if one.end_px is not None and other.end_px is not None:
        ends, others = one.ends_px, other.ends_px
        along = (others[1] - others[0]) / max(float(np.linalg.norm(others[1] - others[0])), 1e-9)
        for k in range(2):
            place = end_on_line(here.view, there.view, ends, others, k)
            known[k] = place is None or abs(float((place - others[k]) @ along)) < _SAME_END_PX
    peak = known[0] and one.anchor_known and other.anchor_known
    bottom = known[1] and one.end_known and other.end_known
    first, second = (replace(each, anchor_known=peak, end_known=bottom) for each in (one, other))
    return first, second


def _logit(share: float) -> float:
    least = 1.0 / (1.0 + np.exp(_MOST_LOGIT))
    bounded = float(np.clip(share, least, 1.0 - least))
    return float(np.log(bounded / (1.0 - bounded)))
