"""Calibration of the score of a detector's proposals in the labelling tool, on rendered streets.

    python bench/detector_proposals.py            figures, on held-out streets
    python bench/detector_proposals.py --fit      weights of assist.score, on tuning streets

The shipped detector processes both images of some frames. As on the page, detections are paired,
refined on the edges, and searched for in the other image, and each proposal gets its score. A
proposal is right if all its marks are within 2 px of one element of its class, across a pole, and
the ends of a pole that it calls visible are visible, and within 6 px. Elements more than 60 m ahead
are left out: the page is never confident of them, and the street has no truth for them.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from assist import fitted, print_shares
from assist_cases import Picture, picture

from semviz.annotator.element_positions import REACH_M
from semviz_annotation.assist.detection_refinement import (
    END,
    RawDetection,
    RefinedDetection,
    refine_detection,
)
from semviz_annotation.assist.marked_image import SURE, Mark
from semviz_annotation.assist.score import probability
from semviz_annotation.assist.stereo_matching import stereo_pairs
from semviz_annotation.labels.detections import as_proposals
from semviz_annotation.labels.proposal import Proposal
from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.base.frame import Side
from semviz_core.common.arrays import BoolArray, FloatArray
from semviz_core.detection.detector import Detector, load_detector
from semviz_core.simulation.street import Street

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

    settled: RefinedDetection
    own_score: float
    """The detector's, of the image where it is surer."""
    is_right: bool
    is_there: bool
    """Whether there is such an element at all, perhaps not so exactly there."""
    ends: tuple[End, ...]


def offered(seeds: range, detector: Detector) -> Iterator[Offered]:
    for seed in seeds:
        street = Street(seed)
        for index in FRAMES:
            yield from _in_frame(street, index, detector)


def _in_frame(street: Street, index: int, detector: Detector) -> Iterator[Offered]:
    both = {side: picture(street, index, side) for side in SIDES}
    found = {}
    for side, view in both.items():
        elements = detector.detect(view.shot.image)
        camera = view.shot.view.camera
        found[side] = as_proposals(index, side, elements, camera, detector.finder.name)
    here, there = (both[side].shot.view for side in SIDES)
    pairs = stereo_pairs(here, there, found["left"], found["right"])
    paired = {found["left"][n].id for n, _ in pairs} | {found["right"][n].id for _, n in pairs}
    things = [[found["left"][n], found["right"][m]] for n, m in pairs]
    things += [
        [detection] for side in SIDES for detection in found[side] if detection.id not in paired
    ]
    for thing in things:
        yield from _judged(thing, both)


def _judged(thing: list[Proposal], both: dict[Side, Picture]) -> Iterator[Offered]:
    """Nothing of what is too far away."""
    seen = [
        RawDetection(
            both[detection.side].shot,
            mark_of(detection),
            detection.score,
            detection.sigma_px,
            detection.sigma_along_px,
        )
        for detection in thing
    ]
    others = [side for side in SIDES if side not in {detection.side for detection in thing}]
    class_id = thing[0].class_id
    other = both[others[0]].shot if others else None
    settled = refine_detection(seen, other, DEFAULT_CLASSES[class_id])
    if (settled.depth_m or 0.0) > REACH_M:
        return
    sides = [*(detection.side for detection in thing), *others]
    shown = [both[side] for side in sides[: len(settled.marks)]]
    meant, roughly = (
        [mark for mark in shown[0].marks if _fits(settled.marks, shown, mark, class_id, wide)]
        for wide in (1.0, 5.0)
    )
    ends = () if not meant else tuple(_ends(settled, [view.marks[meant[0]] for view in shown]))
    is_right = bool(meant) and all(
        _end_is_right(settled.marks, [view.marks[meant[0]] for view in shown], which)
        for which in range(2)
    )
    yield Offered(
        settled, max(detection.score for detection in thing), is_right, bool(roughly), ends
    )


def _fits(
    marks: Sequence[Mark], shown: Sequence[Picture], element: int, class_id: int, wide: float
) -> bool:
    """Whether an element of a class is at marks, one in each image."""
    for mark, view in zip(marks, shown, strict=True):
        truth = view.marks.get(element)
        if truth is None or view.classes[element] != class_id:
            return False
        if max(mark.gap_px(truth), truth.gap_px(mark)) > wide * RIGHT_PX:
            return False
    return True


def _ends(settled: RefinedDetection, truths: Sequence[Mark]) -> Iterator[End]:
    for which, evidence in settled.ends.items():
        if all((truth.anchor_known, truth.end_known)[which] for truth in truths):
            yield End(evidence, _end_is_right(settled.detector_marks, truths, which))


def _end_is_right(marks: Sequence[Mark], truths: Sequence[Mark], which: int) -> bool:
    """Where a mark says that an end is seen, and it is."""
    for mark, truth in zip(marks, truths, strict=True):
        known = (
            pose.end_px is not None and (pose.anchor_known, pose.end_known)[which]
            for pose in (mark, truth)
        )
        if all(known) and np.linalg.norm(mark.ends_px[which] - truth.ends_px[which]) > ALONG_PX:
            return False
    return True


def mark_of(proposal: Proposal) -> Mark:
    return Mark(proposal.anchor_px, proposal.end_px, proposal.anchor_known, proposal.end_known)


def print_figures(offers: list[Offered]) -> None:
    kinds: dict[str, list[Offered]] = defaultdict(list)
    for offer in offers:
        kinds[offer.settled.what].append(offer)
    for what, rows in sorted(kinds.items()):
        sure = [row for row in rows if row.settled.score >= SURE]
        print(
            f"\n{what}: {len(rows)} offers, {np.mean([row.is_right for row in rows]):.1%} right, "
            f"{np.mean([row.is_there for row in rows]):.1%} there; "
            f"{len(sure)} confident, of these wrong: "
            f"{np.mean([not offer.is_right for offer in sure]):.1%}"
        )
        for name, said in (
            ("score", [row.settled.score for row in rows]),
            ("the detector's own", [row.own_score for row in rows]),
        ):
            print(f"  {name}")
            print_shares(np.array(said), np.array([row.is_right for row in rows]))


def print_ends(offers: list[Offered]) -> None:
    ends = [end for offer in offers for end in offer.ends]
    said = np.array([probability("found end", end.evidence) for end in ends])
    right = np.array([end.is_right for end in ends])
    sure = said >= END
    print(
        f"\nends that the detector sees, and are seen: {len(ends)}, {right.mean():.1%} within "
        f"{ALONG_PX:g} px; {sure.mean():.1%} are taken for seen, {right[sure].mean():.1%} of those"
    )
    print_shares(said, right)


def print_fit(offers: list[Offered]) -> None:
    for what in sorted({offer.settled.what for offer in offers}):
        rows = [offer for offer in offers if offer.settled.what == what]
        evidence = np.array([row.settled.evidence for row in rows])
        print_weights(what, evidence, np.array([row.is_right for row in rows]))
    ends = [end for offer in offers for end in offer.ends]
    evidence = np.array([end.evidence for end in ends])
    print_weights("found end", evidence, np.array([end.is_right for end in ends]))


def print_weights(what: str, evidence: FloatArray, right: BoolArray) -> None:
    X = np.column_stack([np.ones(len(evidence)), evidence])
    weights = fitted(X, right.astype(np.float64))
    print(f'    "{what}": ({", ".join(f"{weight:.2f}" for weight in weights)}),  # {len(right)}')


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
