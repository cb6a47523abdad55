"""How honest the score of a detector's proposals is in the labelling tool, on rendered streets.

    python bench/found.py            figures, on streets that nothing was fitted to
    python bench/found.py --fit      weights of semviz_annotation.assist.score, on tuning streets

The detector that ships looks at both images of some frames; what it finds is paired, settled on the
edges, its partner is looked for, and each offer gets its score: as the page does it. An offer is
right where all its marks are within 2 px of one element of its class, across a pole; where a pole
ends is not judged.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from assist import Picture, fitted, picture, print_shares

from semviz_annotation.assist.pairs import stereo_pairs
from semviz_annotation.assist.settle import Found, Settled, settle
from semviz_annotation.assist.shot import SURE, Mark
from semviz_annotation.detections import as_proposals
from semviz_annotation.proposals import Proposal
from semviz_core.classes import DEFAULT_CLASSES
from semviz_core.detection.detector import Detector
from semviz_core.detection.models import load_detector
from semviz_core.sources.source import Side
from semviz_core.sources.street.street import Street

SIDES: tuple[Side, Side] = ("left", "right")
TUNING, HELD_OUT = 20_000, 30_000
FRAMES = (3, 17, 31, 45)
RIGHT_PX = 2.0


@dataclass(frozen=True, eq=False)
class Offered:
    """One offer, and whether it is right."""

    settled: Settled
    own_score: float
    """The detector's, of the image where it is surer."""
    is_right: bool
    is_there: bool
    """Whether there is such a thing at all, perhaps not so exactly there."""


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
        yield _judged(thing, both)


def _judged(thing: list[Proposal], both: dict[Side, Picture]) -> Offered:
    seen = [Found(both[one.side].shot, mark_of(one), one.score) for one in thing]
    others = [side for side in SIDES if side not in {one.side for one in thing}]
    class_id = thing[0].class_id
    other = both[others[0]].shot if others else None
    settled = settle(seen, other, DEFAULT_CLASSES[class_id])
    sides = [*(one.side for one in thing), *others]
    shown = [both[side] for side in sides[: len(settled.marks)]]
    own_score = max(one.score for one in thing)
    is_right, is_there = (
        any(
            all(
                _fits(mark, one, element, class_id, wide)
                for mark, one in zip(settled.marks, shown, strict=True)
            )
            for element in shown[0].marks
        )
        for wide in (1.0, 5.0)
    )
    return Offered(settled, own_score, is_right, is_there)


def _fits(mark: Mark, shown: Picture, element: int, class_id: int, wide: float) -> bool:
    truth = shown.marks.get(element)
    if truth is None or shown.classes[element] != class_id:
        return False
    return max(mark.gap_px(truth), truth.gap_px(mark)) <= wide * RIGHT_PX


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


def print_fit(offers: list[Offered]) -> None:
    for what in sorted({one.settled.what for one in offers}):
        rows = [one for one in offers if one.settled.what == what]
        X = np.array([[1.0, *one.settled.evidence] for one in rows])
        y = np.array([one.is_right for one in rows], dtype=float)
        print(f'    "{what}": ({", ".join(f"{one:.2f}" for one in fitted(X, y))}),  # {len(rows)}')


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


if __name__ == "__main__":
    main()
