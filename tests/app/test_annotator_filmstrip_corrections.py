"""A mark that was corrected in the filmstrip is followed into the other images of its row."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from streets import street

from semviz.annotator.filmstrip.filmstrip_corrections import CorrectedRow
from semviz.annotator.panes import Cameras, Pane
from semviz.annotator.proposals.image_worker import Images, ImageWorker
from semviz.annotator.proposals.label_proposals import LabelledPane
from semviz_annotation.assist.marked_image import Mark
from semviz_annotation.labels.labels import LabelElement, Labels, Observation, new_id, proposal_id
from semviz_annotation.labels.rows import Dismissal
from semviz_core.base.frame import Side
from semviz_core.common.errors import SemvizError

SEED, FRAMES, KEY_FRAMES, STRIP = 7, 8, (0, 4), (1, 2, 3)
OFF_PX = np.array([3.0, 0.0])
SIDES: tuple[Side, Side] = ("left", "right")
SHOWN = street(SEED, FRAMES)
CAMERAS = Cameras(SHOWN.rig, SHOWN.frames)


@pytest.fixture(scope="module")
def worker() -> Iterator[ImageWorker]:
    images = Images(SHOWN)
    yield ImageWorker(images, CAMERAS, lambda: Labels().classes, "centroid")
    images.close()


def truth(number: int, frame: int, side: Side) -> Mark:
    seen, ids = SHOWN.labels(frame, side)
    return Mark.of_element(seen, int(np.flatnonzero(ids == number)[0]))


def moved(mark: Mark, by_px: np.ndarray) -> Mark:
    ends = [(float(u), float(v)) for u, v in mark.ends_px + by_px]
    known = mark.anchor_known, mark.end_known and mark.end_px is not None
    return Mark(ends[0], ends[1] if len(ends) == 2 else None, *known)


def labels_off(number: int) -> Labels:
    """Labels of the key frames, all off by the same."""
    seen, ids = SHOWN.labels(0, "left")
    class_id = int(seen.class_id[np.flatnonzero(ids == number)[0]])
    element = LabelElement(id=new_id(), class_id=class_id, number=1)
    marks = [
        (frame, side, moved(truth(number, frame, side), OFF_PX))
        for frame in KEY_FRAMES
        for side in SIDES
    ]
    rows = [
        Observation(
            new_id(), element.id, frame, side,
            mark.anchor_px, mark.end_px, mark.anchor_known, mark.end_known,
        )
        for frame, side, mark in marks
    ]  # fmt: skip
    return Labels.from_rows([element, *rows])


def row_of(number: int, labels: Labels, *corrected: tuple[int, Side]) -> CorrectedRow:
    marks = tuple(
        LabelledPane(Pane(frame, side), moved(truth(number, frame, side), np.zeros(2)))
        for frame, side in corrected
    )
    return CorrectedRow(next(iter(labels.elements)), marks, labels, CAMERAS)


def whole_everywhere() -> list[int]:
    """The nearest elements that all images of the test show, one of each class."""
    shown = [SHOWN.labels(frame, side) for frame in range(5) for side in SIDES]
    common = set.intersection(*(set(ids.tolist()) for _, ids in shown))
    seen, ids = shown[0]
    by_depth = sorted(enumerate(ids.tolist()), key=lambda each: -each[1])
    by_class = {int(seen.class_id[row]): n for row, n in by_depth if n in common}
    return sorted(by_class.values())


@pytest.mark.parametrize("number", whole_everywhere())
def test_one_corrected_image_is_followed_into_all_others(number: int, worker: ImageWorker) -> None:
    labels = labels_off(number)
    row = row_of(number, labels, (2, "left"))
    for frame in STRIP:
        view = row.view(frame, worker)
        assert view is not None
        assert view.marks.keys() == {"left", "right"}
        for side, found in view.marks.items():
            mark = Mark(found.anchor, found.end, found.anchor_known, found.end_known)
            assert mark.gap_px(truth(number, frame, side)) < 1.0, (frame, side)


def test_a_corrected_mark_stays_as_it_was_placed(worker: ImageWorker) -> None:
    number = whole_everywhere()[0]
    view = row_of(number, labels_off(number), (1, "left"), (1, "right")).view(1, worker)
    assert view is not None
    for side, found in view.marks.items():
        placed = truth(number, 1, side)
        assert (found.anchor, found.end, found.score) == (placed.anchor_px, placed.end_px, 1.0)


def test_what_is_labelled_or_rejected_meanwhile_is_not_proposed(worker: ImageWorker) -> None:
    number = whole_everywhere()[0]
    labels = labels_off(number)
    element_id = next(iter(labels.elements))
    rejected = [
        Dismissal(proposal_id(element_id, 3, side), 3, side, "rejected", element_id)
        for side in SIDES
    ]
    row = row_of(number, labels.with_rows([*labels.rows(), *rejected]), (2, "left"))
    assert row.view(KEY_FRAMES[1], worker) is None
    assert row.view(3, worker) is None


def test_an_element_whose_place_is_unknown_is_told() -> None:
    number = whole_everywhere()[0]
    labels = labels_off(number)
    rows = [
        row
        for row in labels.rows()
        if not isinstance(row, Observation) or (row.frame_index, row.side) == (0, "left")
    ]
    with pytest.raises(SemvizError, match="no common position"):
        row_of(number, labels.with_rows(rows), (0, "left")).check()


def test_a_mark_dragged_to_where_its_element_cannot_be_stays_there(worker: ImageWorker) -> None:
    number = whole_everywhere()[0]
    row = row_of(number, labels_off(number), (2, "left"))
    far = tuple(
        LabelledPane(each.pane, moved(each.mark, np.array([-60.0, 20.0]))) for each in row.corrected
    )
    view = replace(row, corrected=far).view(2, worker)
    assert view is not None
    assert view.marks["left"].anchor == far[0].mark.anchor_px
