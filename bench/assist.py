"""Accuracy and reliability of snapping, stereo matching and propagation, on simulated streets.

    python bench/assist.py [--quick]        figures, on held-out seeds
    python bench/assist.py --fit            the weights of semviz_annotation.assist.score
    python bench/assist.py --only follow --kitti /data/kitti    real images too
    python bench/assist.py --only follow --seeds 1012 1013      other streets

Baseline with the same windows: template matching (NCC) along the epipolar line. Poses of streets
have errors, the same for both cameras of a frame. Marks are followed from frame to frame as people
work: what is sure is accepted unseen; see ``followed``.
"""

import argparse
import sys
import time
from collections import defaultdict
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from assist_cases import FAR_M, SIDES, Answer, correspondences, picture, snaps
from drives import KittiDrive, StreetDrive
from followed import Follower

from semviz_annotation.assist.marked_image import SURE
from semviz_annotation.assist.snap import CLEAR, best_snap
from semviz_annotation.assist.stereo_matching import candidates
from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.common.arrays import BoolArray, FloatArray
from semviz_core.simulation.street import Street, StreetOptions

SAID = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98, 1.01)
"""Bounds of the scores that are counted together."""
FIT_SEEDS, HELD_OUT_SEEDS = range(1, 25), range(1000, 1012)
RIDGE = 10.0
"""Weight of the squared weights in a fit, of evidence with standard deviation 1: chosen by leaving
out a tenth of ``FIT_SEEDS`` and of the elements of KITTI 02."""
KITTI_RUNS = (range(20), range(19, -1, -1), range(4, 20, 2))
"""Towards the elements, away from them, and at twice the speed."""


def answers(
    seeds: Sequence[int], quick: bool, only: str = "", kitti: Path | None = None
) -> list[Answer]:
    result: list[Answer] = []
    for seed in seeds:
        street, rng = Street(seed), np.random.default_rng(seed)
        frames = [12, 40] if quick else [5, 20, 35, 50]
        if only in ("", "snap"):
            result += snaps(street, frames, rng)
        if only in ("", "partner"):
            result += correspondences(street, frames)
        if only in ("", "follow"):
            worn = Street(seed, StreetOptions(signs="worn"))
            begin, count = 10 + 7 * (seed % 4), 8 if quick else 12
            frames_followed = range(begin, begin + count * (1 + seed % 2), 1 + seed % 2)
            result += Follower(StreetDrive(street), "new streets", seed).run(frames_followed)
            result += Follower(StreetDrive(worn), "worn streets", seed).run(frames_followed)
    if kitti is not None:
        drive = KittiDrive.of(kitti)
        for seed, frames_followed in enumerate(KITTI_RUNS):
            result += Follower(drive, "KITTI 02", seed).run(frames_followed)
    return result


def within(errors: FloatArray) -> str:
    return f"within 1 px {np.mean(errors < 1):.1%}, 2 px {np.mean(errors < 2):.1%}"


def print_figures(all_answers: list[Answer]) -> None:
    by_kind: dict[str, list[Answer]] = defaultdict(list)
    for answer in all_answers:
        if not answer.way:
            by_kind[answer.what].append(answer)
    followed = [row for row in all_answers if row.way]
    if followed:
        print_followed(followed)
    for what in sorted(by_kind):
        rows = by_kind[what]
        print(f"\n{what}")
        if what.startswith("snap"):
            print_snaps(rows)
        else:
            print_found([row for row in rows if row.best])
        print_reliability(rows)


def print_snaps(rows: list[Answer]) -> None:
    there = [row for row in rows if np.isfinite(row.error_px)]
    clear = [answer for answer in there if answer.probability >= CLEAR]
    nothing = [row for row in rows if not np.isfinite(row.error_px)]
    errors = np.array([answer.error_px for answer in clear])
    p50, p75, p90 = np.percentile(errors, (50, 75, 90))
    print(f"  snapped {len(clear)} of {len(there)}")
    print(f"  error median {p50:.2f}, p75 {p75:.2f}, p90 {p90:.2f} px")
    print(f"  more than 1 px off: {np.mean(errors > 1):.1%}, 2 px: {np.mean(errors > 2):.1%}")
    for name in sorted({answer.name for answer in clear}):
        of = np.array([answer.error_px for answer in clear if answer.name == name])
        p50, p90 = np.percentile(of, (50, 90))
        print(f"    {name:<17} {len(of):>4}: median {p50:.2f}, p90 {p90:.2f} px")
    slid = [off for answer in clear for off in answer.along_px]
    if slid:
        p50, p90 = np.percentile(slid, (50, 90))
        print(f"  ends found along the pole: {len(slid)}, median {p50:.2f}, p90 {p90:.2f} px")
    wrong = sum(answer.probability >= CLEAR for answer in nothing)
    print(f"  where no element is: {wrong} of {len(nothing)} snapped to something like one")


def print_found(rows: list[Answer]) -> None:
    visible = [row for row in rows if np.isfinite(row.error_px)]
    errors = np.array([answer.error_px for answer in visible])
    peers = np.array([answer.peer_px for answer in visible])
    sure = [row for row in rows if row.probability >= SURE]
    print(f"  {len(visible)} visible: {within(errors)}")
    print(f"  the plain peer: {within(peers)}")
    of_visible = np.mean([answer.probability >= SURE for answer in visible])
    wrong = np.mean([answer.error_px > 2 for answer in sure])
    print(f"  sure {of_visible:.1%} of the visible; wrong (2 px) {wrong:.2%} of {len(sure)} sure")
    hidden = [row.probability >= SURE for row in rows if not np.isfinite(row.error_px)]
    if hidden:
        print(
            f"  hidden, or looked for 30 to 70 px aside, yet sure: {sum(hidden)} of {len(hidden)}"
        )
    for name in sorted({answer.name for answer in visible}):
        for low, high in ((0, 12), (12, 25), (25, FAR_M)):
            of = [
                answer.error_px
                for answer in visible
                if answer.name == name and low <= answer.depth_m < high
            ]
            if of:
                good = np.mean(np.array(of) < 1)
                print(
                    f"    {name:<17} {low:>2}-{high:<3.0f} m {len(of):>4}: within 1 px {good:.1%}"
                )


def print_followed(rows: list[Answer]) -> None:
    """By drive and class: all proposals, the sure ones, and what is right by stated score."""
    stated = [f"{low:g}-{min(high, 1):g}" for low, high in pairwise(SAID[1:])]
    head = ["drive", "class", "proposals", "within 2 px", "sure", "of these within 2 px", *stated]
    print(f"| {' | '.join(head)} |")
    print("|---|---|" + "--:|" * (4 + len(stated)))
    for way, name in sorted({(row.way, row.name) for row in rows}):
        of = [row for row in rows if (row.way, row.name) == (way, name) and row.best]
        said = np.array([row.score for row in of])
        right = np.array([row.error_px <= 2.0 for row in of])
        bins = [(said >= low) & (said < high) for low, high in pairwise(SAID[1:])]
        shares = [share(right[one]) for one in (said >= SURE, *bins)]
        cells = [way, name, str(len(of)), f"{right.mean():.1%}", f"{np.mean(said >= SURE):.0%}"]
        print(f"| {' | '.join(cells + shares)} |")
        ends = [row.ends_right for row in of if row.score >= SURE and name == "pole"]
        if ends:
            print(f"ends of sure poles of {way}: right {np.mean(ends):.1%}", file=sys.stderr)


def share(right: BoolArray) -> str:
    return f"{right.mean():.1%} ({len(right)})" if len(right) else "-"


def print_reliability(rows: list[Answer]) -> None:
    print_shares(
        np.array([row.probability for row in rows]), np.array([_right(row) for row in rows])
    )


def print_shares(said: FloatArray, right: BoolArray) -> None:
    """Of answers that were said to be right with some probability, how many are."""
    print("    said   (mean)  answers  right")
    for low, high in pairwise(SAID):
        of = (said >= low) & (said < high)
        if of.any():
            print(
                f"    {low:.2f}-{min(high, 1):.2f} ({said[of].mean():.2f}) {of.sum():>7} "
                f"{right[of].mean():>7.1%}"
            )


def _right(answer: Answer) -> bool:
    """Of a pole, across it: its ends have scores of their own."""
    return answer.error_px < (1.0 if answer.what.startswith("snap") else 2.0)


def print_times() -> None:
    street = Street(1000)
    left, right = (picture(street, 12, side) for side in SIDES)
    times = defaultdict(list)
    for element_id in left.marks.keys() & right.marks.keys():
        mark, kind = left.marks[element_id], DEFAULT_CLASSES[left.classes[element_id]]
        for _ in range(3):
            begin = time.process_time()
            best_snap(left.shot, mark, kind)
            middle = time.process_time()
            candidates(left.shot, right.shot, mark, kind)
            times[f"snap {kind.kind}"].append(middle - begin)
            times[f"partner {kind.kind}"].append(time.process_time() - middle)
    print("\nprocessor time, median of one call")
    for name, all_s in sorted(times.items()):
        print(f"  {name:<15} {1000 * np.median(all_s):.1f} ms")


def print_fit(all_answers: list[Answer]) -> None:
    """Logistic regression of what is right, by kind."""
    for what in sorted({answer.what for answer in all_answers}):
        rows = [answer for answer in all_answers if answer.what == what and answer.growth < 1.5]
        X = np.array([[1.0, *row.evidence] for row in rows])
        y = np.array([_right(row) for row in rows], dtype=float)
        print(f'    "{what}": ({", ".join(f"{value:.2f}" for value in fitted(X, y))}),')


def fitted(X: FloatArray, y: FloatArray) -> FloatArray:
    """(k,) weights of evidence (n, k), a constant first, for what is right (n,): Newton's method
    with a ridge."""
    mean, spread = X.mean(axis=0), X.std(axis=0)
    constant = spread < 1e-9
    mean[0], spread[constant] = 0.0, 1.0
    Z = (X - mean) / spread
    Z[:, 1:][:, constant[1:]] = 0.0
    ridge = np.diag(np.r_[1e-6, np.full(X.shape[1] - 1, RIDGE)])
    weights = np.zeros(X.shape[1])
    for _ in range(60):
        p = 1.0 / (1.0 + np.exp(-Z @ weights))
        H = (Z * (p * (1.0 - p) + 1e-9)[:, None]).T @ Z + ridge
        weights = weights + np.linalg.solve(H, Z.T @ (y - p) - ridge @ weights)
    weights = weights / spread
    weights[0] -= weights[1:] @ mean[1:]
    return np.asarray(weights)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="two streets instead of twelve")
    parser.add_argument("--seeds", type=int, nargs="*", help="other streets than the twelve")
    parser.add_argument("--fit", action="store_true", help="fit the weights instead")
    parser.add_argument("--only", choices=["snap", "partner", "follow"], default="")
    parser.add_argument("--kitti", type=Path, help="folder of KITTI odometry")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    if arguments.fit:
        print_fit(answers(FIT_SEEDS, False, arguments.only, arguments.kitti))
        return
    seeds = arguments.seeds or HELD_OUT_SEEDS[: 2 if arguments.quick else None]
    print(f"simulated streets, seeds {', '.join(map(str, seeds))}; nearer than {FAR_M:.0f} m")
    print_figures(answers(seeds, arguments.quick, arguments.only, arguments.kitti))
    print_times()


if __name__ == "__main__":
    main()
