"""Cases for bench/assist.py: poles and signs of simulated streets, with the truth."""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from semviz_annotation.assist.expected_position import expected_px
from semviz_annotation.assist.marked_image import Mark, MarkedImage
from semviz_annotation.assist.propagation import PropagatedMark, ReferenceView, search_views
from semviz_annotation.assist.score import probability
from semviz_annotation.assist.snap import best_snap
from semviz_annotation.assist.stereo_matching import candidates
from semviz_annotation.labels.views import PosedView, rig_view
from semviz_annotation.mapping.placement.triangulation import (
    Triangulated,
    TriangulationFailure,
    triangulate,
)
from semviz_core.base.classes import DEFAULT_CLASSES, POLE, ElementClass
from semviz_core.base.frame import Side
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.simulation.street import Street

SIDES: tuple[Side, Side] = ("left", "right")
FAR_M = 40.0
CLICK_PX = 1.4
"""Standard deviation of a click in each direction: about 2 px off."""
LABEL_PX = 0.3
POSE_M, POSE_RAD = 0.02, 0.0005
"""What the poses of frames are off by, in each direction."""


@dataclass(frozen=True, eq=False)
class Answer:
    """One answer and how far off it is; infinite where there is nothing to be found."""

    what: str
    name: str
    depth_m: float
    evidence: FloatArray
    error_px: float
    step: int = 0
    peer_px: float = np.inf
    best: bool = True
    way: str = ""
    along_px: tuple[float, ...] = ()

    @property
    def probability(self) -> float:
        return probability(self.what, self.evidence)


@dataclass(frozen=True, eq=False)
class Picture:
    """One image with what it truly shows, by id."""

    shot: MarkedImage
    marks: dict[int, Mark]
    classes: dict[int, int]
    depths: dict[int, float]


def picture(street: Street, index: int, side: Side) -> Picture:
    pose = street.frames[index].T_map_camera
    assert pose is not None
    view = rig_view(street.rig, side, pose.inverse())
    seen, ids = street.labels(index, side)
    anchors = street.truth_map.elements.anchor_m
    rows = np.searchsorted(street.truth_map.elements.id, ids)
    depths = view.depth_m(anchors[rows])
    marks = {element_id: Mark.of_element(seen, row) for row, element_id in enumerate(ids.tolist())}
    classes = dict(zip(map(int, ids), map(int, seen.class_id), strict=True))
    far = dict(zip(map(int, ids), map(float, depths), strict=True))
    return Picture(MarkedImage.of(view, street.image(index, side), "centroid"), marks, classes, far)


def shaken(mark: Mark, rng: np.random.Generator, sigma_px: float) -> Mark:
    ends = mark.ends_px + np.clip(rng.normal(0.0, sigma_px, mark.ends_px.shape), -4.0, 4.0)
    return moved(mark, ends)


def moved(mark: Mark, ends: FloatArray) -> Mark:
    points = [(float(u), float(v)) for u, v in ends]
    return replace(mark, anchor_px=points[0], end_px=points[1] if len(points) == 2 else None)


def error_px(mark: Mark, truth: Mark) -> float:
    """Furthest that a true end is from its own: across only, where either is not known."""
    ours, true = mark.ends_px, truth.ends_px
    if len(true) == 1:
        return float(np.linalg.norm(ours - true))
    along = (ours[1] - ours[0]) / np.linalg.norm(ours[1] - ours[0])
    offs = true - ours[0]
    across = np.abs(offs @ np.array([along[1], -along[0]]))
    known = np.array([mark.anchor_known, mark.end_known]) & [truth.anchor_known, truth.end_known]
    return float(np.where(known, np.linalg.norm(ours - true, axis=1), across).max())


# -- snapping


def snaps(street: Street, frames: list[int], rng: np.random.Generator) -> Iterator[Answer]:
    for index in frames:
        for side in SIDES:
            shown = picture(street, index, side)
            for element_id, mark in shown.marks.items():
                if shown.depths[element_id] < FAR_M:
                    yield from _snap(street, shown, element_id, mark, rng)
            for _ in range(8):
                yield from _snap_nowhere(shown, rng)


def _snap(
    street: Street, shown: Picture, element_id: int, mark: Mark, rng: np.random.Generator
) -> Iterator[Answer]:
    class_id = shown.classes[element_id]
    name = DEFAULT_CLASSES[class_id].name
    depth = shown.depths[element_id]
    if class_id == POLE:
        clicked = shaken(mark, rng, CLICK_PX)
    else:
        sign = next(sign for sign in street.layout.signs if sign.id == element_id)
        share = rng.uniform(-0.5, 0.5, 2)
        point = sign.middle_m + share[0] * sign.right_m + share[1] * sign.up_m
        clicked = moved(mark, shown.shot.view.project(point[None]))
    what = "snap pole" if class_id == POLE else "snap sign"
    found = best_snap(shown.shot, clicked, DEFAULT_CLASSES[class_id])
    if found is None:
        return
    now = found.snapped
    if class_id == POLE:
        across = replace(now.mark, anchor_known=False, end_known=False)
        along = mark.ends_px[1] - mark.ends_px[0]
        offs = (now.mark.ends_px - mark.ends_px) @ along / np.linalg.norm(along)
        ok = (now.anchor_snapped, now.end_snapped)
        slid = tuple(abs(float(off)) for off, is_known in zip(offs, ok, strict=True) if is_known)
        yield Answer(what, name, depth, found.evidence, error_px(across, mark), along_px=slid)
    else:
        yield Answer(what, name, depth, found.evidence, error_px(now.mark, mark))


def _snap_nowhere(shown: Picture, rng: np.random.Generator) -> Iterator[Answer]:
    """A line, or a point, where no element is: on houses, trees, hedges."""
    for class_id in (POLE, int(rng.integers(1, 4))):
        begin = np.array([rng.uniform(30, 1210), rng.uniform(40, 230)])
        ends = [begin, begin + np.array([rng.normal(0, 2), rng.uniform(25, 120)])][
            : 2 if class_id == POLE else 1
        ]
        mark = moved(Mark((0.0, 0.0), (0.0, 0.0), False, False), np.array(ends))
        near = [
            error_px(mark, truth)
            for truth in shown.marks.values()
            if len(truth.ends_px) == len(ends)
        ]
        if min(near, default=99.0) < 25.0:
            continue
        found = best_snap(shown.shot, mark, DEFAULT_CLASSES[class_id])
        if found is not None:
            what = "snap pole" if class_id == POLE else "snap sign"
            yield Answer(what, "nothing there", 0.0, found.evidence, np.inf)


# -- correspondences


def correspondences(street: Street, frames: list[int]) -> Iterator[Answer]:
    for index in frames:
        both = {side: picture(street, index, side) for side in SIDES}
        for here, there in ((both["left"], both["right"]), (both["right"], both["left"])):
            for element_id in here.marks.keys() & there.marks.keys():
                if here.depths[element_id] < FAR_M:
                    yield from _correspondence(street, here, there, element_id)


def _correspondence(
    street: Street, here: Picture, there: Picture, element_id: int
) -> Iterator[Answer]:
    class_id = here.classes[element_id]
    mark = here.marks[element_id]
    truth = moved(mark, there.shot.view.project(_points_m(street, here, element_id)))
    what = "stereo pole" if class_id == POLE else "stereo sign"
    found = candidates(here.shot, there.shot, mark, DEFAULT_CLASSES[class_id])
    order = sorted(found, key=lambda answer: -probability(what, answer.evidence))
    for k, answer in enumerate(order):
        ends = moved(mark, answer.ends_px)
        yield Answer(
            what,
            DEFAULT_CLASSES[class_id].name,
            here.depths[element_id],
            answer.evidence,
            float(np.linalg.norm(ends.ends_px - truth.ends_px, axis=1).max()),
            peer_px=_template_px(here.shot, there.shot, mark, truth) if k == 0 else np.inf,
            best=k == 0,
        )


def _points_m(street: Street, here: Picture, element_id: int) -> FloatArray:
    """(1 or 2, 3) what is marked, in space: the visible part of a pole."""
    elements = street.truth_map.elements
    row = int(np.searchsorted(elements.id, element_id))
    mark = here.marks[element_id].ends_px
    if len(mark) == 1:
        return elements.anchor_m[row][None]
    whole = np.stack([elements.anchor_m[row], elements.end_m[row]])
    depths = here.shot.view.depth_m(whole)
    ends = here.shot.view.project(whole)
    step = ends[1] - ends[0]
    share = (mark - ends[0]) @ step / (step @ step)
    share = share * depths[0] / (depths[1] + (depths[0] - depths[1]) * share)  # perspective
    return np.asarray(whole[0] + share[:, None] * (whole[1] - whole[0]))


def _template_px(here: MarkedImage, there: MarkedImage, mark: Mark, truth: Mark) -> float:
    """Error of cv2.matchTemplate on the rows of the mark, 5.5 px of context on either side."""
    ends = mark.ends_px
    low = np.floor(ends.min(axis=0) - 6).astype(int)
    high = np.ceil(ends.max(axis=0) + 6).astype(int)
    (x0, y0), (x1, y1) = np.maximum(low, 0), np.minimum(high, [1241, 376])
    window = here.image[y0:y1, x0:x1]
    rows = there.image[y0:y1]
    score = cv2.matchTemplate(rows, window, cv2.TM_CCOEFF_NORMED)[0]
    at = int(np.argmax(score))
    if 0 < at < len(score) - 1:
        a, b, c = score[at - 1 : at + 2]
        at_px = at + 0.5 * (a - c) / min(a + c - 2 * b, -1e-9)
    else:
        at_px = float(at)
    found = moved(mark, ends + np.array([at_px - x0, 0.0]))
    return float(np.linalg.norm(found.ends_px - truth.ends_px, axis=1).max())


# -- following

Seen = dict[Side, tuple[MarkedImage, Mark]]


def follows(
    street: Street, first: int, steps: list[int], rng: np.random.Generator
) -> Iterator[Answer]:
    """From one labelled pair into later frames: the map is never updated on the way."""
    both = {side: picture(street, first, side) for side in SIDES}
    mapped = {}
    for element_id in sorted(both["left"].marks.keys() & both["right"].marks.keys()):
        marks = {side: shaken(both[side].marks[element_id], rng, LABEL_PX) for side in SIDES}
        place = _place([(both[side].shot.view, marks[side]) for side in SIDES])
        if place is not None:
            mapped[element_id] = place, {side: (both[side].shot, marks[side]) for side in SIDES}
    for step in steps:
        there = _pictured(street, first + step, rng)
        yield from _followed(there, mapped, street, rng, step, ", from one pair alone")


def works(street: Street, first: int, count: int, rng: np.random.Generator) -> Iterator[Answer]:
    """From frame to frame, as people work: what each shows is labelled before the next."""
    labels: dict[int, list[tuple[PosedView, Mark]]] = defaultdict(list)
    newest: dict[int, Seen] = {}
    for step in range(count):
        there = _pictured(street, first + step, rng)
        places = {label: _place(rows) for label, rows in labels.items()}
        mapped = {
            name: (place, newest[name]) for name, place in places.items() if place is not None
        }
        yield from _followed(there, mapped, street, rng, 1, ", from frame to frame")
        seen: dict[int, Seen] = defaultdict(dict)
        for side, picture_ in there.items():
            for element_id, mark in picture_.marks.items():
                mark = shaken(mark, rng, LABEL_PX)
                labels[element_id].append((picture_.shot.view, mark))
                seen[element_id][side] = picture_.shot, mark
        newest |= seen


def _pictured(street: Street, index: int, rng: np.random.Generator) -> dict[Side, Picture]:
    """Both images of a frame, with a pose that is a little off."""
    off = Pose.exp(np.r_[rng.normal(0, POSE_M, 3), rng.normal(0, POSE_RAD, 3)])
    both = {side: picture(street, index, side) for side in SIDES}
    return {side: _turned(view, off) for side, view in both.items()}


def _turned(shown: Picture, off: Pose) -> Picture:
    """As if its camera were elsewhere."""
    view = shown.shot.view
    return replace(
        shown, shot=MarkedImage(shown.shot.image, PosedView(view.camera, off @ view.T_camera_map))
    )


def _followed(
    there: dict[Side, Picture],
    mapped: dict[int, tuple[Triangulated, Seen]],
    street: Street,
    rng: np.random.Generator,
    step: int,
    way: str,
) -> Iterator[Answer]:
    """Each element in both images, and where it is not: the camera turned by 30 to 70 px."""
    turn = rng.choice([-1.0, 1.0]) * rng.uniform(0.04, 0.1)
    aside = Pose.from_rotvec([0.0, turn, 0.0], [0.0, 0.0, 0.0])
    elsewhere = {side: _turned(view, aside) for side, view in there.items()}
    row = {int(element_id): k for k, element_id in enumerate(street.truth_map.elements.id)}
    for element_id, (place, seen) in mapped.items():
        depth = float(there["left"].shot.view.depth_m(place.anchor_m[None])[0])
        if not 3.0 < depth < FAR_M:
            continue
        kind = DEFAULT_CLASSES[int(street.truth_map.elements.class_id[row[element_id]])]
        what = "propagated pole" if place.is_line else "propagated sign"
        for answer in _found(elsewhere, place, seen, kind).values():
            yield Answer(what, "elsewhere", depth, answer.evidence, np.inf, step, way=way)
        for side, proposal in _found(there, place, seen, kind).items():
            truth = there[side].marks.get(element_id)
            error, peer = np.inf, np.inf
            if truth is not None:
                error = error_px(proposal.mark, truth)
                peer = _klt_px(_nearest(seen, side), there[side].shot, place, truth)
            yield Answer(
                what, kind.name, depth, proposal.evidence, error, step, peer_px=peer, way=way
            )


def _found(
    there: dict[Side, Picture], place: Triangulated, seen: Seen, kind: ElementClass
) -> dict[Side, PropagatedMark]:
    sights = [ReferenceView(view.shot, *_nearest(seen, side)) for side, view in there.items()]
    found = search_views(sights, place, kind)
    return {side: answer for side, answer in zip(there, found, strict=True) if answer is not None}


def _nearest(seen: Seen, side: Side) -> tuple[MarkedImage, Mark]:
    """The same camera's if it shows the element."""
    return seen[side] if side in seen else next(iter(seen.values()))


def _place(rows: list[tuple[PosedView, Mark]]) -> Triangulated | None:
    """Of careful labels."""
    if len(rows) < 2:
        return None
    found = triangulate([view for view, _ in rows], [mark.at(0) for _, mark in rows], 0.5)
    return None if isinstance(found, TriangulationFailure) else found


def _klt_px(
    seen: tuple[MarkedImage, Mark], there: MarkedImage, element: Triangulated, truth: Mark
) -> float:
    """Error of the pyramidal Lucas-Kanade tracker, started where the element is expected."""
    expected = expected_px(element, there.view)
    here, mark = seen
    if expected is None:
        return np.inf
    images = [cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY) for view in (here, there)]
    found, _, _ = cv2.calcOpticalFlowPyrLK(
        *images,
        mark.ends_px.astype(np.float32)[:, None],
        expected.astype(np.float32)[:, None].copy(),
        winSize=(21, 21),
        maxLevel=2,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return error_px(moved(mark, found[:, 0].astype(np.float64)), truth)
