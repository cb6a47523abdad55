"""Poles labelled by half: are they proposed whole in nearer frames?

    python bench/half_poles.py --kitti /data/kitti

Each pole of a frame is labelled by its lower, then by its upper half, exactly, in both images. It
is then searched in the next ``AHEAD`` frames, whose truth says where the missing end is. Whole
poles are searched as well: none of their ends may move. The search was designed while looking at
streets 1004 to 1006 and at KITTI 02.
"""

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from drives import KITTI_FRAMES, SIDES, Drive, KittiDrive, StreetDrive, focal_px, view_of
from followed import mark_of
from labelling_truth import ALONG_M, ALONG_PX

from semviz_annotation.assist.image_search import PropagatedMark, ReferenceView
from semviz_annotation.assist.marked_image import Mark, MarkedImage
from semviz_annotation.assist.propagation import search_views
from semviz_annotation.labels.views import PosedView
from semviz_annotation.mapping.placement.triangulation import (
    Triangulated,
    TriangulationFailure,
    triangulate,
)
from semviz_core.base.classes import DEFAULT_CLASSES, POLE
from semviz_core.base.frame import Side
from semviz_core.simulation.street import Street

AHEAD = (1, 2, 4)
FARTHEST_M = 40.0
STEP = 3
WAYS = {"lower half": (0, 0.5), "upper half": (1, 0.5), "whole": (0, 0.0)}
"""The end that is missing, and how much of the pole."""
Tally = dict[tuple[str, str], Counter[str]]


class HalfPoles:
    """The poles of a drive, by half."""

    def __init__(self, drive: Drive) -> None:
        self.drive = drive
        self._image = lru_cache(maxsize=12)(self._opened)

    def _opened(self, frame: int, side: Side) -> MarkedImage:
        view = view_of(self.drive.source, frame, side)
        return MarkedImage.of(view, self.drive.source.image(frame, side))

    def outcomes(self, frames: range) -> Iterator[tuple[str, str, list[str]]]:
        """The way, the end, and what each of the next frames offers for one pole."""
        for frame in frames[::STEP]:
            depths = self.drive.depths_m(frame)
            seen = {side: self.drive.seen(frame, side) for side in SIDES}
            for pole in sorted(seen["left"].keys() & seen["right"].keys()):
                marks = {side: mark_of(seen[side][pole]) for side in SIDES}
                if seen["left"][pole][2] != POLE or not 4.0 < depths[pole] < FARTHEST_M:
                    continue
                nearer = [frame + ahead for ahead in AHEAD if frame + ahead in frames]
                for way, (which, share) in WAYS.items():
                    for end in (which,) if share else (0, 1):
                        if not all(seen[side][pole][3][end] for side in SIDES):
                            continue
                        offered = self._offered(frame, pole, marks, nearer, (end, share))
                        if offered:
                            yield way, ("peak", "bottom")[end], offered

    def _offered(
        self,
        frame: int,
        pole: int,
        marks: dict[Side, Mark],
        nearer: list[int],
        cut: tuple[int, float],
    ) -> list[str]:
        end, share = cut
        halves = {side: shortened(mark, end, share) for side, mark in marks.items()}
        views = [view_of(self.drive.source, frame, side) for side in SIDES]
        place = triangulate(views, [halves[side].at(0) for side in SIDES])
        if isinstance(place, TriangulationFailure):
            return []
        return [
            said
            for target in nearer
            for said in self._said(frame, target, pole, halves, place, end, is_cut=share > 0.0)
        ]

    def _said(
        self,
        frame: int,
        target: int,
        pole: int,
        halves: dict[Side, Mark],
        place: Triangulated,
        end: int,
        is_cut: bool,
    ) -> Iterator[str]:
        depth = self.drive.depths_m(target)[pole]
        truth = {side: self.drive.seen(target, side).get(pole) for side in SIDES}
        if depth < 2.0 or not all(each is not None and each[3][end] for each in truth.values()):
            return
        references = [
            ReferenceView(self._image(target, side), self._image(frame, side), halves[side])
            for side in SIDES
        ]
        found = search_views(references, place, DEFAULT_CLASSES[POLE])
        for side, mark in zip(SIDES, found, strict=True):
            each = truth[side]
            if mark is None or each is None:
                continue
            view = self._image(target, side).view
            yield said(
                mark, np.array(each[end]), expected(place, view, end), view, depth, end, is_cut
            )


def shortened(mark: Mark, end: int, share: float) -> Mark:
    """The mark without ``share`` of it at an end."""
    ends = mark.ends_px.copy()
    ends[end] += share * (ends[1 - end] - ends[end])
    return replace(mark, anchor_px=(ends[0, 0], ends[0, 1]), end_px=(ends[1, 0], ends[1, 1]))


def expected(place: Triangulated, view: PosedView, end: int) -> np.ndarray:
    """Where the end of the labelled part is in a view."""
    assert place.end_m is not None
    return view.project(np.array([place.anchor_m, place.end_m]))[end]


def said(
    mark: PropagatedMark,
    true: np.ndarray,
    labelled: np.ndarray,
    view: PosedView,
    depth_m: float,
    end: int,
    is_cut: bool,
) -> str:
    """Whether the end that is proposed is the true one, the labelled one, or neither."""
    near = max(ALONG_PX, ALONG_M * focal_px(view.camera) / depth_m)
    off = np.linalg.norm(mark.mark.ends_px[end] - [true, labelled], axis=1)
    if not (mark.mark.anchor_known, mark.mark.end_known)[end]:
        return "hidden"
    if is_cut and off[1] <= near < off[0]:
        return "half"
    return "whole" if off[0] <= near else "wrong"


def tallied(tally: Tally, drive: Drive, frames: range) -> None:
    for way, end, offered in HalfPoles(drive).outcomes(frames):
        row = tally.setdefault((way, end), Counter())
        row.update(offered)
        row["poles"] += 1
        row["offered"] += "whole" in offered


def print_table(name: str, tally: Tally) -> None:
    print(f"\n{name}\n| labelled | end | poles | marks | whole | half | hidden | wrong | offered |")
    print("|---|---|--:|--:|--:|--:|--:|--:|--:|")
    for (way, end), row in sorted(tally.items()):
        marks = sum(row[each] for each in ("whole", "half", "hidden", "wrong"))
        shares = (f"{row[each] / marks:.0%}" for each in ("whole", "half", "hidden", "wrong"))
        offered = f"{row['offered'] / row['poles']:.0%}"
        print(f"| {way} | {end} | {row['poles']} | {marks} | {' | '.join(shares)} | {offered} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="*", default=[1004, 1005, 1006])
    parser.add_argument("--kitti", type=Path, help="folder of KITTI odometry")
    arguments = parser.parse_args()
    streets: Tally = {}
    for seed in arguments.seeds:
        tallied(streets, StreetDrive(Street(seed)), range(12))
    if streets:
        print_table("streets", streets)
    if arguments.kitti is not None:
        real: Tally = {}
        tallied(real, KittiDrive.of(arguments.kitti), KITTI_FRAMES)
        print_table("KITTI 02", real)


if __name__ == "__main__":
    main()
