"""Cases for bench/assist.py: poles and signs of simulated streets, with the truth."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from semviz_annotation.assist.marked_image import Mark, MarkedImage
from semviz_annotation.assist.score import probability
from semviz_annotation.assist.snap import best_snap
from semviz_annotation.assist.stereo_matching import candidates
from semviz_annotation.labels.views import rig_view
from semviz_core.base.classes import DEFAULT_CLASSES, POLE
from semviz_core.base.frame import Side
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
    peer_px: float = np.inf
    best: bool = True
    way: str = ""
    along_px: tuple[float, ...] = ()
    growth: float = 1.0
    score: float = 0.0
    """Of what is proposed in the image."""
    ends_right: bool = True
    element: int = 0

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
