"""The map as a teacher: elements are labels where something shows that they are visible."""

from pathlib import Path

import numpy as np
import pytest
from support.street_labels import careful, label_street

from semviz.research.mapped_elements import MOST_BETWEEN, bridged, mapped_sides
from semviz.research.workspace_data import workspace_images
from semviz.workspace.workspace import TRUTH, Workspace
from semviz_annotation.label_formats.import_plan import ImportLabels
from semviz_annotation.mapping.quality.label_links import observe
from semviz_core.common.errors import SemvizError

FRAMES = 6
FIRST, LAST = 1, 4
"""Only these frames are labelled."""


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    workspace = Workspace.create_street(tmp_path_factory.mktemp("drive") / "town", 7, range(FRAMES))
    labels = label_street(careful(workspace.street, 1e-6, 0), range(FRAMES), FRAMES).labels
    rows = [row for row in labels.observations.values() if row.frame_index in (FIRST, LAST)]
    seen = {row.element_id for row in rows}
    elements = tuple(element for element in labels.elements.values() if element.id in seen)
    with workspace.open_labels() as store:
        store.apply(ImportLabels(elements, tuple(rows)), "tester")
    return workspace


def test_elements_are_taught_between_images_that_show_them(drive: Workspace) -> None:
    """Frames between two labelled ones have labels where the street truly is, others have none."""
    sides = [side for side in mapped_sides(drive, TRUTH) if side.side == "left"]
    assert [side.frame_index for side in sides] == list(range(FIRST, LAST + 1))
    street = drive.street
    for side in sides:
        assert not side.is_complete
        labels, _ = street.labels(side.frame_index, "left")
        for row in range(len(side.elements)):
            apart = np.linalg.norm(labels.anchor_px - side.elements.anchor_px[row], axis=1)
            assert apart.min() < 4.0 or not side.elements.anchor_known[row]
    between = next(side for side in sides if side.frame_index == FIRST + 1)
    assert 3 <= len(between.elements) <= len(observe(drive.read_labels(), FIRST, "left")[0])


def test_hidden_elements_are_ignored_and_not_taught(drive: Workspace) -> None:
    """What is in view but never seen is in doubt: neither a label nor background."""
    first = mapped_sides(drive, TRUTH)[0]
    labelled = observe(drive.read_labels(), FIRST, "left")[0]
    assert len(first.elements) <= len(labelled)
    image = first.read()
    assert image.ignored is not None
    assert image.ignored.mean() > 0.5  # all but the surroundings of labels
    for left, top, right, bottom in first.doubtful_px:
        at = image.ignored[round((top + bottom) / 2), round((left + right) / 2)]
        beside = np.abs(labelled.anchor_px[:, 0] - (left + right) / 2).min() < 20.0
        assert at or beside


@pytest.mark.parametrize(
    ("gap", "is_taught"), [(2 * MOST_BETWEEN, True), (2 * MOST_BETWEEN + 1, False)]
)
def test_a_long_gap_is_not_bridged(gap: int, is_taught: bool) -> None:
    """What is seen, unseen and seen again: visible between if that is not for long."""
    agreed = np.zeros((gap + 4, 1), bool)
    agreed[[1, gap + 1]] = True
    visible = bridged(agreed)[:, 0]
    assert visible[2 : gap + 1].any() == is_taught
    assert not visible[0]
    assert not visible[gap + 2 :].any()


def test_training_takes_the_map(drive: Workspace) -> None:
    def sides_of(workspace: Workspace, frames: range | None) -> list:  # type: ignore[type-arg]
        return mapped_sides(workspace, TRUTH, frames)

    images = workspace_images([drive], None, sides_of)
    assert images.describe()["labels"] > images.count
    assert {side.frame_index for side in images.kept_back} == {LAST}


def test_without_any_evidence_nothing_is_taught(tmp_path: Path) -> None:
    workspace = Workspace.create_street(tmp_path / "town", 7, range(2))
    with pytest.raises(SemvizError, match=r"no label or detection agrees .* run 'semviz detect"):
        mapped_sides(workspace, TRUTH)
