"""The maps of a batch's drives become versions of the collection's map."""

from pathlib import Path

import numpy as np
import pytest
from labelled_street import label_street

from semviz.batch.batch import DriveBatch, Plan
from semviz.batch.merging import publish_merged
from semviz.batch.work import Work
from semviz.collection.collection import Collection, Drive
from semviz.commands.batch import run_command
from semviz.workspace.workspace import Workspace
from semviz_annotation.mapping.drives.corrections import PoseErrors
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.errors import SemvizError

FRAMES = range(8)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three labelled drives through one street, the last of which saw more of it."""
    root, made = tmp_path_factory.mktemp("drives"), []
    for name, frames in (("b", FRAMES), ("c", FRAMES), ("a", range(20))):
        workspace = Workspace.create_street(root / name, seed=5, frames=range(20))
        label_street(workspace, workspace.street, frames)
        made.append(root / name)
    return made


def built(collection: Collection, drives: list[Drive], name: str = "map") -> DriveBatch:
    """The batch with the maps of some drives."""
    batch = DriveBatch.begin(collection, name, Plan("map"))
    for drive in drives:
        assert not Work(collection.where, name, run_command)(drive).failure
    return batch


def publish(batch: DriveBatch) -> int:
    return publish_merged(batch, PoseErrors(), lambda what, done, of: None).map_version


def anchors(semantic_map: SemanticMap) -> dict[int, tuple[float, ...]]:
    elements = semantic_map.elements
    rows = zip(elements.id.tolist(), elements.anchor_m.tolist(), strict=True)
    return {id_: tuple(anchor) for id_, anchor in rows}


def test_a_drive_more_keeps_the_ids(tmp_path: Path, folders: list[Path]) -> None:
    collection = Collection.create(tmp_path / "city", folders[:2])
    assert publish(built(collection, list(collection.drives()))) == 1
    before = anchors(collection.tiled_map().whole())
    collection.add(folders[2:])
    batch = built(collection, list(collection.drives()))
    assert publish(batch) == 2
    after = anchors(collection.tiled_map().whole())
    assert len(after) > len(before)
    assert before.keys() < after.keys()
    off_m = [np.subtract(after[id_], anchor)[:2] for id_, anchor in before.items()]
    assert np.median(np.linalg.norm(off_m, axis=1)) < 0.2  # what was far has come near
    assert publish(batch) == 2  # again: nothing new


def test_the_map_is_the_same_in_whatever_order_drives_are_done(
    tmp_path: Path, folders: list[Path]
) -> None:
    found = []
    for name, step in (("one", 1), ("other", -1)):
        collection = Collection.create(tmp_path / name, folders)
        publish(built(collection, list(collection.drives())[::step]))
        found.append(collection.tiled_map().whole())
    assert found[0].digest == found[1].digest


def test_a_batch_without_maps_publishes_nothing(tmp_path: Path) -> None:
    Workspace.create_street(tmp_path / "bare", seed=5, frames=FRAMES)
    collection = Collection.create(tmp_path / "city", [tmp_path / "bare"])
    batch = DriveBatch.begin(collection, "map", Plan("map"))
    (bare,) = collection.drives()
    outcome = Work(collection.where, "map", run_command)(bare)
    assert outcome.failure.startswith("no element is labelled in two images")
    with pytest.raises(SemvizError, match="no map was built"):
        publish(batch)
    assert collection.store.keys("manifests/") == []
