"""Exactly where is what a detector found, in both images, and how likely it is there at all."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from semviz_annotation.assist.partner import Partners, find_partner
from semviz_annotation.assist.score import probability
from semviz_annotation.assist.seen import end_evidence
from semviz_annotation.assist.shot import Mark, Proposed, Shot
from semviz_annotation.assist.snap import CLEAR, best_snap
from semviz_annotation.assist.warp import end_on_line
from semviz_annotation.triangulate import Failed, triangulate
from semviz_core.arrays import FloatArray
from semviz_core.classes import ElementClass

_PARTNER = 0.5
"""A partner that is less likely is none."""
END = 0.8
"""An end of a pole that is less likely where it is said to be is not said to be seen."""
_STRAY_SIGMAS = 6.0
"""An outline whose middle is further from the detector's is another one, such as the inner edge of
a sign's border."""
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
    sigma_px: float
    """Of a sign's middle along each axis; across a pole."""
    sigma_along_px: float | None = None
    """Of a pole's known ends; None where nobody says."""


@dataclass(frozen=True, eq=False)
class Settled:
    """Where it is in each image, with what speaks for all of that together."""

    said: tuple[Mark, ...]
    """In the images where it was found; then in the other, if it was looked for and is there. With
    the ends of a pole as known that the detector says are seen."""
    what: str
    evidence: FloatArray
    ends: Mapping[int, FloatArray]
    """What speaks for each of those ends, peak (0) and bottom (1), being where it is said to be."""
    depth_m: float | None
    """Of its peak or middle, from the first image; None where only one shows it."""

    @cached_property
    def marks(self) -> tuple[Mark, ...]:
        """As ``said``, with those ends as known that are likely where they are said to be."""
        known = {k for k, one in self.ends.items() if probability("found end", one) >= END}
        return tuple(
            replace(
                one,
                anchor_known=one.anchor_known and (one.end_px is None or 0 in known),
                end_known=one.end_known and 1 in known,
            )
            for one in self.said
        )

    @property
    def score(self) -> float:
        """Estimated probability that there is such a thing, every mark within 2 px of it, and the
        known ends of a pole within 6 px along it."""
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
    shots = [one.shot for one in found]
    if len(found) == 2:
        partners = find_partner(shots[0], shots[1], marks[0], element_class)
        alike = _agreement(partners, marks[1])
        both = _agreed(shots[0], shots[1], *marks)
        return _settled(found, shots, both, f"found pair {kind}", [*scores, *clear, *alike])
    partners = None if other is None else find_partner(shots[0], other, marks[0], element_class)
    if other is None or partners is None or partners.best.score < _PARTNER:
        return _settled(found, shots, marks, f"found alone {kind}", [*scores, *clear])
    both = (marks[0], partners.best.mark)
    evidence = [*scores, *clear, _logit(partners.best.score)]
    return _settled(found, [*shots, other], both, f"found one {kind}", evidence)


def _settled(
    found: Sequence[Found],
    shots: Sequence[Shot],
    marks: tuple[Mark, ...],
    what: str,
    evidence: Sequence[float],
) -> Settled:
    stated = [one.sigma_along_px for one in found if one.sigma_along_px is not None]
    sigma_px = max(stated, default=None)
    known = [
        marks[0].end_px is not None and all(one.anchor_known for one in marks),
        marks[0].end_px is not None and all(one.end_known for one in marks),
    ]
    ends = {k: end_evidence(shots, marks, k, sigma_px) for k in range(2) if known[k]}
    depth_m = None if len(marks) < 2 else _depth_m(shots, marks)
    return Settled(marks, what, np.array(evidence), ends, depth_m)


def _depth_m(shots: Sequence[Shot], marks: Sequence[Mark]) -> float:
    """From the first of two images; infinite where they do not tell."""
    views = [one.view for one in shots]
    place = triangulate(views, [one.at(n) for n, one in enumerate(marks)], min_angle_rad=0.0)
    if isinstance(place, Failed):
        return float("inf")
    depth = float(views[0].depth_m(place.anchor_m[None])[0])
    return depth if depth > 0.0 else float("inf")


def _snapped(found: Found, element_class: ElementClass) -> tuple[Mark, float]:
    """Where the edges are clear, on them; and how clear they are."""
    best = best_snap(found.shot, found.mark, element_class)
    if best is None:
        return found.mark, -_MOST_LOGIT
    is_sign = found.mark.end_px is None
    clear = probability("snap sign" if is_sign else "snap pole", best.evidence)
    is_other = is_sign and best.snapped.moved_px > _STRAY_SIGMAS * found.sigma_px
    return (found.mark if is_other or clear < CLEAR else best.snapped.mark), _logit(clear)


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
