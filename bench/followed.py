"""Marks followed from frame to frame as people work, with the truth, for bench/assist.py.

What is sure is accepted unseen, so that an offset of the first drawing goes on. What is weak is
looked at: accepted if it is right, else drawn again. A drawing is a click with ``CLICK_PX``,
snapped where its preview looks right.
"""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from assist_cases import POSE_M, POSE_RAD, Answer, shaken
from drives import SIDES, Drive, StreetDrive, view_of
from labelling_truth import ALONG_M, ALONG_PX, RIGHT_PX, error_px

from semviz_annotation.assist import element_search
from semviz_annotation.assist.expected_position import not_sure_if_cut
from semviz_annotation.assist.image_search import PropagatedMark, ReferenceView
from semviz_annotation.assist.marked_image import SURE, Mark, MarkedImage, ProposedMark
from semviz_annotation.assist.propagation import search_views
from semviz_annotation.assist.score import (
    LabelledView,
    Track,
    apparent_size,
    growth,
    look_again,
    score_of,
    view_to_follow,
    views_beside,
)
from semviz_annotation.assist.snap import snap
from semviz_annotation.labels.views import PosedView
from semviz_annotation.mapping.placement.triangulation import (
    Triangulated,
    TriangulationFailure,
    triangulate,
)
from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.base.frame import Side
from semviz_core.base.pose import Pose

CLICK_PX = 1.0
LOOKED_PX = 0.4
"""Of a mark that is drawn again under the loupe."""
FAR_M = 60.0


@dataclass(frozen=True, eq=False)
class Label:
    """A label that the script made."""

    frame: int
    side: Side
    image: MarkedImage
    mark: Mark


class Follower:
    """Labels a drive from frame to frame and yields every proposal with its error."""

    def __init__(self, drive: Drive, name: str, seed: int) -> None:
        self.drive = drive
        self.name = name
        self.rng = np.random.default_rng(seed)
        self.labels: dict[int, list[Label]] = defaultdict(list)
        self._image = lru_cache(maxsize=80)(self._opened)
        self._off = lru_cache(maxsize=None)(self._pose_error)

    def run(self, frames: range) -> Iterator[Answer]:
        for frame in frames:
            seen = {side: self.drive.seen(frame, side) for side in SIDES}
            made: list[tuple[int, Label]] = []
            for element in sorted(seen["left"].keys() | seen["right"].keys()):
                class_id = next(seen[s][element][2] for s in SIDES if element in seen[s])
                truth = {
                    side: mark_of(seen[side][element]) for side in SIDES if element in seen[side]
                }
                proposed: dict[Side, ProposedMark] = {}
                for side, answer, proposal in self._proposals(frame, element, class_id, truth):
                    if proposal is not None:
                        proposed[side] = proposal
                    if answer is not None:
                        yield answer
                for side, true in truth.items():
                    mark = self._labelled(frame, side, true, proposed.get(side), class_id)
                    made.append((element, Label(frame, side, self._image(frame, side), mark)))
            for element, label in made:
                self.labels[element].append(label)

    def _labelled(
        self, frame: int, side: Side, true: Mark, proposed: ProposedMark | None, class_id: int
    ) -> Mark:
        if proposed is not None and (proposed.sure or off_px(proposed.mark, true) <= RIGHT_PX):
            return proposed.mark
        clicked = shaken(true, self.rng, CLICK_PX)
        snapped = snap(self._image(frame, side), clicked, DEFAULT_CLASSES[class_id])
        for mark in ([snapped.mark] if snapped else []) + [clicked]:
            if off_px(mark, true) <= RIGHT_PX:
                return mark
        return shaken(true, self.rng, LOOKED_PX)

    def _proposals(
        self, frame: int, element: int, class_id: int, truth: dict[Side, Mark]
    ) -> Iterator[tuple[Side, Answer | None, ProposedMark | None]]:
        rows = self.labels[element]
        place = position(rows)
        if place is None:
            return
        views = {side: self._image(frame, side) for side in SIDES}
        depth = float(views["left"].view.depth_m(place.anchor_m[None])[0])
        if not 0.5 < depth < FAR_M:
            return
        references, track = self._track(frame, place, rows, views)
        kind = DEFAULT_CLASSES[class_id]
        with_both = both_candidates(references, place, kind, track)
        for side, candidates in zip(SIDES, with_both, strict=True):
            if not candidates:
                continue
            best = max(candidates, key=lambda each: score_of(each, track, place))
            score = score_of(best, track, place)
            reference = references[SIDES.index(side)]
            proposal = not_sure_if_cut(
                ProposedMark(best.mark, score),
                place,
                views[side].view,
                (reference.source, reference.marked),
                kind,
            )
            assert proposal is not None
            yield side, None, proposal
            if side not in truth or proposal.score < score:
                continue
            for each in candidates:
                error = off_px(each.mark, truth[side])
                yield (
                    side,
                    Answer(
                        each.what, kind.name, depth, each.evidence, error,
                        best=each is best, way=self.name, growth=track.growth, score=score,
                        ends_right=ends_right(each.mark, truth[side], depth, views[side].view),
                        element=element,
                    ),
                    None,
                )  # fmt: skip

    def _track(
        self, frame: int, place: Triangulated, rows: list[Label], views: dict[Side, MarkedImage]
    ) -> tuple[list[ReferenceView], Track]:
        """As the page chooses them."""
        sizes = np.array([apparent_size(place, row.image.view) for row in rows])
        moments = np.abs(np.array([row.frame for row in rows]) - frame)
        followed = []
        for side in SIDES:
            other = np.array([row.side != side for row in rows])
            now = apparent_size(place, views[side].view)
            followed.append(view_to_follow(sizes, moments, other, now))
        references = [
            ReferenceView(views[side], rows[row].image, rows[row].mark)
            for side, row in zip(SIDES, followed, strict=True)
        ]
        beside = tuple(
            LabelledView(rows[row].image, rows[row].mark) for row in views_beside(moments, followed)
        )
        now = max(apparent_size(place, view.view) for view in views.values())
        return references, Track(beside, growth(sizes, now, look_again(place)))

    def _opened(self, frame: int, side: Side) -> MarkedImage:
        source = self.drive.source
        view = view_of(source, frame, side)
        if isinstance(self.drive, StreetDrive):  # its poses are exact
            view = PosedView(view.camera, self._off(frame) @ view.T_camera_map)
            return MarkedImage.of(view, source.image(frame, side), "centroid")
        return MarkedImage.of(view, source.image(frame, side))

    def _pose_error(self, frame: int) -> Pose:
        rng = np.random.default_rng(frame)
        return Pose.exp(np.r_[rng.normal(0, POSE_M, 3), rng.normal(0, POSE_RAD, 3)])


def both_candidates(
    references: list[ReferenceView], place: Triangulated, kind: object, track: Track
) -> list[list[PropagatedMark]]:
    """What is followed and, of signs, what the outline says, for each image."""
    outlined: dict[int, PropagatedMark] = {}
    chosen = element_search.outlined

    def noted(followed, row, views, outlines, image):  # type: ignore[no-untyped-def]
        found = chosen(followed, row, views, outlines, image)
        if found is not None:
            outlined[id(image)] = found

    element_search.outlined = noted  # type: ignore[assignment]
    try:
        marks = search_views(references, place, kind, track=track)  # type: ignore[arg-type]
    finally:
        element_search.outlined = chosen
    return [
        [mark for mark in (found, outlined.get(id(reference.target))) if mark is not None]
        for found, reference in zip(marks, references, strict=True)
    ]


def position(rows: list[Label]) -> Triangulated | None:
    if len(rows) < 2:
        return None
    found = triangulate([row.image.view for row in rows], [row.mark.at(0) for row in rows])
    return None if isinstance(found, TriangulationFailure) else found


def mark_of(seen: tuple[np.ndarray, np.ndarray, int, tuple[bool, bool]]) -> Mark:
    anchor, end, _, known = seen
    bottom = (float(end[0]), float(end[1])) if np.isfinite(end).all() else None
    return Mark((float(anchor[0]), float(anchor[1])), bottom, *known)


def off_px(mark: Mark, truth: Mark) -> float:
    """Of a sign's middle, or across a pole; see ``labelling_truth.error_px``."""
    end = truth.end_px or (np.nan, np.nan)
    return error_px((mark.anchor_px, mark.end_px), (np.array(truth.anchor_px), np.array(end)))


def ends_right(mark: Mark, truth: Mark, depth_m: float, view: PosedView) -> bool:
    if mark.end_px is None or truth.end_px is None:
        return True
    known = np.array([mark.anchor_known, mark.end_known])
    known &= [truth.anchor_known, truth.end_known]
    gaps = np.linalg.norm(mark.ends_px - truth.ends_px, axis=1)
    return bool((gaps[known] <= max(ALONG_PX, ALONG_M * view.camera.K[0, 0] / depth_m)).all())


__all__ = ["SURE", "Follower"]
