"""Images that detectors learn from: what people labelled, and where they said there is nothing."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from support.street_labels import careful, label_street

from semviz.research.workspace_data import WorkspaceImages, workspace_images
from semviz.workspace.workspace import Workspace
from semviz_annotation.label_formats.import_plan import ImportLabels
from semviz_annotation.labels.edits import DecideElements, Dismiss, ReviewFrame
from semviz_annotation.labels.labels import Dismissal, proposal_id
from semviz_annotation.labels.rows import review_decision
from semviz_core.common.errors import SemvizError

FRAMES = 6
REVIEWED, IN_WORK, EMPTY, UNLABELLED, LEFT_ONLY = range(5)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """All frames labelled and reviewed but for four; one element lacks its right view in one."""
    folder = tmp_path_factory.mktemp("labelled") / "town"
    workspace = Workspace.create_street(folder, 7, range(FRAMES))
    labels = label_street(careful(workspace.street, 1e-6, 0), range(FRAMES), FRAMES).labels
    missing = labels.in_frame(REVIEWED, "right")[0]
    rows = [
        row
        for row in labels.observations.values()
        if row.frame_index not in (EMPTY, UNLABELLED) and row != missing
        if (row.frame_index, row.side) != (LEFT_ONLY, "right")
    ]
    seen = {row.element_id for row in rows}
    elements = tuple(element for element in labels.elements.values() if element.id in seen)
    with workspace.open_labels() as store:
        store.apply(ImportLabels(elements, tuple(rows)), "tester")
        for index in (REVIEWED, LEFT_ONLY, FRAMES - 1):
            store.apply(ReviewFrame(index, "reviewed"), "tester")
        store.apply(ReviewFrame(EMPTY, "reviewed, empty"), "tester")
    return workspace


def images_of(workspace: Workspace) -> WorkspaceImages:
    return workspace_images([workspace])


def test_frames_come_in_order_and_the_last_ones_are_kept_back(workspace: Workspace) -> None:
    images = images_of(workspace)
    order = [(row.frame_index, row.side) for row in (*images.training, *images.kept_back)]
    both = [(index, side) for index in (0, 1, 2, 4, 5) for side in ("left", "right")]
    assert order == [image for image in both if image != (LEFT_ONLY, "right")]
    assert {image.frame_index for image in images.kept_back} == {FRAMES - 1}
    first = workspace_images([workspace], range(0, 2))
    assert {image.frame_index for image in (*first.training, *first.kept_back)} == {0, 1}
    assert pickle.loads(pickle.dumps(first)).describe() == first.describe()
    assert first.describe()["content"] != images.describe()["content"]


def test_a_reviewed_empty_frame_is_all_background(workspace: Workspace) -> None:
    number = 2 * EMPTY
    image = images_of(workspace).image(number)
    assert len(image.elements) == 0
    np.testing.assert_array_equal(image.image, workspace.source.image(EMPTY, "left"))
    assert image.ignored is None


def test_only_the_surroundings_of_labels_count_where_nobody_reviewed(
    workspace: Workspace,
) -> None:
    image = images_of(workspace).image(2 * IN_WORK)
    assert image.ignored is not None
    columns, rows = image.elements.anchor_px.round().astype(int).T
    assert not image.ignored[rows, columns].any()
    assert image.ignored.mean() > 0.5


def test_what_is_mapped_and_neither_labelled_nor_turned_down_is_left_open(
    workspace: Workspace,
) -> None:
    right = 2 * REVIEWED + 1
    before = images_of(workspace).training[right]
    assert before.is_complete
    assert len(before.doubtful_px)
    labels = workspace.read_labels()
    left, there = (labels.in_frame(REVIEWED, side) for side in ("left", "right"))
    missing = sorted({row.element_id for row in left} - {row.element_id for row in there})
    with workspace.open_labels() as store:
        for element_id in missing:
            down = proposal_id(element_id, REVIEWED, "right")
            row = Dismissal(down, REVIEWED, "right", "absent", element_id)
            store.apply(Dismiss((row,)), "tester")
    after = images_of(workspace).training[right]
    assert len(after.doubtful_px) < len(before.doubtful_px)


def test_what_is_left_out_of_maps_is_neither_landmark_nor_background(workspace: Workspace) -> None:
    left = 2 * REVIEWED
    before = images_of(workspace)
    row = workspace.read_labels().in_frame(REVIEWED, "left")[0]
    with workspace.open_labels() as store:
        decision = DecideElements((review_decision(row.element_id, "leave out"),))
        store.apply(decision, "tester")
        after = images_of(workspace)
        store.undo("tester")
    elements = after.training[left].elements
    assert len(elements) == len(before.training[left].elements) - 1
    assert row.anchor_px not in [tuple(anchor) for anchor in elements.anchor_px.tolist()]
    u, v = (round(value) for value in row.anchor_px)
    assert before.image(left).ignored is None or not before.image(left).ignored[v, u]
    assert after.image(left).ignored[v, u]


def test_too_little_is_said(tmp_path: Path) -> None:
    bare = Workspace.create_street(tmp_path / "bare", 7, range(3))
    with pytest.raises(SemvizError, match="0 frames are labelled or reviewed, training needs 2"):
        workspace_images([bare])
    with pytest.raises(SemvizError, match="of frames 0:2"):
        workspace_images([bare], range(0, 2))
