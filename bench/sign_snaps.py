"""Clicks near the middle of signs: how many snap, and to the right outline?

    python bench/sign_snaps.py --seeds 1016 1017 1018 1019 --kitti /data/kitti

Clicks are off by ``CLICK_PX`` in each direction. Streets have new, then worn signs; the signs of
KITTI 02 are listed one by one. Right is within 1 px of the middle.
"""

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np
from drives import KITTI_FRAMES, SIDES, Drive, KittiDrive, StreetDrive, view_of

from semviz_annotation.assist.marked_image import Mark, MarkedImage, pixel
from semviz_annotation.assist.score import probability
from semviz_annotation.assist.snap import CLEAR, best_snap
from semviz_core.base.classes import DEFAULT_CLASSES, POLE, TriangleCenter
from semviz_core.simulation.street import Street, StreetOptions

CLICK_PX = 1.4
CLICKS = 3
FARTHEST_M = 45.0
STREET_FRAMES = range(5, 50, 15)

Errors = dict[str, list[float]]
"""Distances from the middle (px) by name; infinite where nothing is clear."""


def errors_px(
    drive: Drive, frames: range, center: TriangleCenter, seed: int, *, by_element: bool
) -> Errors:
    rng = np.random.default_rng(seed)
    errors: Errors = defaultdict(list)
    for frame in frames:
        depths = drive.depths_m(frame)
        for side in SIDES:
            view = view_of(drive.source, frame, side)
            image = MarkedImage.of(view, drive.source.image(frame, side), center)
            for element, (middle, _, class_id, _) in sorted(drive.seen(frame, side).items()):
                if class_id == POLE or depths.get(element, np.inf) > FARTHEST_M:
                    continue
                kind = DEFAULT_CLASSES[class_id]
                name = f"{kind.name} {element}" if by_element else kind.name
                for _ in range(CLICKS):
                    mark = Mark(pixel(middle + rng.normal(0.0, CLICK_PX, 2)))
                    snap = best_snap(image, mark, kind)
                    is_clear = snap and probability("snap sign", snap.evidence) >= CLEAR
                    place = snap.snapped.mark.ends_px[0] if snap and is_clear else np.inf
                    errors[name].append(float(np.linalg.norm(place - middle)))
    return errors


def print_rows(drive: str, errors: Errors) -> None:
    for name, of in sorted(errors.items()):
        off = np.array(of)
        there = np.isfinite(off)
        cells = [there.mean(), (off <= 1.0).mean(), ((off > 2.0) & there).mean()]
        shares = " | ".join(f"{share:.1%}" for share in cells)
        print(f"| {drive} | {name} | {len(off)} | {shares} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="*", default=[1016, 1017, 1018, 1019])
    parser.add_argument("--kitti", type=Path, help="folder of KITTI odometry")
    arguments = parser.parse_args()
    print("| drive | sign | clicks | snapped | right | more than 2 px off |")
    print("|---|---|--:|--:|--:|--:|")
    for signs in ("new", "worn"):
        total: Errors = defaultdict(list)
        for seed in arguments.seeds:
            street = StreetDrive(Street(seed, StreetOptions(signs=signs)))
            found = errors_px(street, STREET_FRAMES, "centroid", seed, by_element=False)
            for name, off in found.items():
                total[name] += off
        print_rows(f"streets, {signs} signs", total)
    if arguments.kitti is not None:
        drive = KittiDrive.of(arguments.kitti)
        print_rows("KITTI 02", errors_px(drive, KITTI_FRAMES, "box", 0, by_element=True))


if __name__ == "__main__":
    main()
