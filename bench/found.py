"""How honest the score of a detector's proposals is in the labelling tool, on rendered streets.

    python bench/found.py            figures, on streets that nothing was fitted to
    python bench/found.py --fit      weights of semviz_annotation.assist.score, on tuning streets

The detector that ships looks at both images of some frames; what it finds is paired, settled on the
edges, its partner is looked for, and each offer gets its score: as the page does it. An offer is
right where all its marks are within 2 px of one element of its class, across a pole, and the ends
of a pole that it says are seen, and are, within 6 px. What is more than 60 m ahead is left out: the
page is never sure of it, and what stands there the street does not tell.

The score is fitted with the ends as known that the weights of ``found end`` leave; so where those
change, fit twice.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from assist import fitted, print_shares
from assist_cases import Picture, picture

from semviz.annotator.ghosts import REACH_M
from semviz_annotation.assist.pairs import stereo_pairs
from semviz_annotation.assist.score import probability
from semviz_annotation.assist.settle import END, Found, Settled, settle
from semviz_annotation.assist.shot import SURE, Mark
from semviz_annotation.detections import as_proposals
from semviz_annotation.proposals import Proposal
from semviz_core.arrays import BoolArray, FloatArray
from semviz_core.classes import DEFAULT_CLASSES
from semviz_core.detection.detector import Detector
from semviz_core.detection.models import load_detector
from semviz_core.sources.source import Side
from semviz_core.sources.street.street import Street

SIDES: tuple[Side, Side] = ("left", "right")
TUNING, HELD_OUT = 20_000, 30_000
FRAMES = (3, 17, 31, 45)
RIGHT_PX, ALONG_PX = 2.0, 6.0


@dataclass(frozen=True, eq=False)
class End:
    """An end of a pole that the detector says is seen, and is."""

    evidence: FloatArray
    is_right: bool


@dataclass(frozen=True, eq=False)
class Offered:
    """One offer, and whether it is right."""

    settled: Settled
    own_score: float
    """The detector's, of the image where it is surer."""
    is_right: bool
    is_there: bool
    """Whether there is such a thing at all, perhaps not so exactly there."""
    ends: tuple[End, ...]


def offered(seeds: range, detector: Detector) -> Iterator[Offered]:
    for seed in seeds:
        street = Street(seed)
        for index in FRAMES:
            yield from _in_frame(street, index, detector)


def _in_frame(street: Street, index: int, detector: Detector) -> Iterator[Offered]:
    both = {side: picture(street, index, side) for side in SIDES}
    found = {}
    for side, one in both.items():
        elements = detector.detect(one.shot.image)
        camera = one.shot.view.camera
        found[side] = as_proposals(index, side, elements, camera, detector.finder.name)
    here, there = (both[side].shot.view for side in SIDES)
    pairs = stereo_pairs(here, there, found["left"], found["right"])
    paired = {found["left"][n].id for n, _ in pairs} | {found["right"][n].id for _, n in pairs}
    things = [[found["left"][n], found["right"][m]] for n, m in pairs]
    things += [[one] for side in SIDES for one in found[side] if one.id not in paired]
    for thing in things:
        yield from _judged(thing, both)


def _judged(thing: list[Proposal], both: dict[Side, Picture]) -> Iterator[Offered]:
    """Nothing of what is too far away."""
    seen = [
        Found(both[one.side].shot, mark_of(one), one.score, one.sigma_px, one.sigma_along_px)
        for one in thing
    ]
    others = [side for side in SIDES if side not in {one.side for one in thing}]
    class_id = thing[0].class_id
    other = both[others[0]].shot if others else None
    settled = settle(seen, other, DEFAULT_CLASSES[class_id])
    if (settled.depth_m or 0.0) > REACH_M:
        return
    sides = [*(one.side for one in thing), *others]
    shown = [both[side] for side in sides[: len(settled.marks)]]
    meant, roughly = (
        [one for one in shown[0].marks if _fits(settled.marks, shown, one, class_id, wide)]
        for wide in (1.0, 5.0)
    )
    ends = () if not meant else tuple(_ends(settled, [one.marks[meant[0]] for one in shown]))
    is_right = bool(meant) and all(
        _end_is_right(settled.marks, [one.marks[meant[0]] for one in shown], which)
        for which in range(2)
    )
    yield Offered(settled, max(one.score for one in thing), is_right, bool(roughly), ends)


def _fits(
    marks: Sequence[Mark], shown: Sequence[Picture], element: int, class_id: int, wide: float
) -> bool:
    """Whether an element of a class is at marks, one in each image."""
    for mark, one in zip(marks, shown, strict=True):
        truth = one.marks.get(element)
        if truth is None or one.classes[element] != class_id:
            return False
        if max(mark.gap_px(truth), truth.gap_px(mark)) > wide * RIGHT_PX:
            return False
    return True


def _ends(settled: Settled, truths: Sequence[Mark]) -> Iterator[End]:
    for which, evidence in settled.ends.items():
        if all((one.anchor_known, one.end_known)[which] for one in truths):
            yield End(evidence, _end_is_right(settled.said, truths, which))


def _end_is_right(marks: Sequence[Mark], truths: Sequence[Mark], which: int) -> bool:
    """Where a mark says that an end is seen, and it is."""
    for mark, truth in zip(marks, truths, strict=True):
        known = (
            one.end_px is not None and (one.anchor_known, one.end_known)[which]
            for one in (mark, truth)
        )
        if all(known) and np.linalg.norm(mark.ends_px[which] - truth.ends_px[which]) > ALONG_PX:
            return False
    return True


def mark_of(one: Proposal) -> Mark:
    return Mark(one.anchor_px, one.end_px, one.anchor_known, one.end_known)


def print_figures(offers: list[Offered]) -> None:
    kinds: dict[str, list[Offered]] = defaultdict(list)
    for one in offers:
        kinds[one.settled.what].append(one)
    for what, rows in sorted(kinds.items()):
        sure = [one for one in rows if one.settled.score >= SURE]
        print(
            f"\n{what}: {len(rows)} offers, {np.mean([one.is_right for one in rows]):.1%} right, "
            f"{np.mean([one.is_there for one in rows]):.1%} there; "
            f"{len(sure)} sure, wrong of those {np.mean([not one.is_right for one in sure]):.1%}"
        )
        for name, said in (
            ("score", [one.settled.score for one in rows]),
            ("the detector's own", [one.own_score for one in rows]),
        ):
            print(f"  {name}")
            print_shares(np.array(said), np.array([one.is_right for one in rows]))


def print_ends(offers: list[Offered]) -> None:
    ends = [end for one in offers for end in one.ends]
    said = np.array([probability("found end", one.evidence) for one in ends])
    right = np.array([one.is_right for one in ends])
    sure = said >= END
    print(
        f"\nends that the detector sees, and are seen: {len(ends)}, {right.mean():.1%} within "
        f"{ALONG_PX:g} px; {sure.mean():.1%} are taken for seen, {right[sure].mean():.1%} of those"
    )
    print_shares(said, right)


def print_fit(offers: list[Offered]) -> None:
    for what in sorted({one.settled.what for one in offers}):
        rows = [one for one in offers if one.settled.what == what]
        evidence = np.array([one.settled.evidence for one in rows])
        print_weights(what, evidence, np.array([one.is_right for one in rows]))
    ends = [end for one in offers for end in one.ends]
    evidence = np.array([one.evidence for one in ends])
    print_weights("found end", evidence, np.array([one.is_right for one in ends]))


def print_weights(what: str, evidence: FloatArray, right: BoolArray) -> None:
    X = np.column_stack([np.ones(len(evidence)), evidence])
    weights = fitted(X, right.astype(np.float64))
    print(f'    "{what}": ({", ".join(f"{one:.2f}" for one in weights)}),  # {len(right)}')


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fit", action="store_true", help="fit the weights instead")
    parser.add_argument("--streets", type=int, default=12)
    parser.add_argument("--model", help="as of 'semviz detect'")
    arguments = parser.parse_args()
    first = TUNING if arguments.fit else HELD_OUT
    seeds = range(first, first + arguments.streets)
    offers = list(offered(seeds, load_detector(arguments.model)))
    if arguments.fit:
        print_fit(offers)
    print(f"rendered streets, seeds {seeds[0]} to {seeds[-1]}, frames {FRAMES}")
    print_figures(offers)
    print_ends(offers)


if __name__ == "__main__":
    main()
