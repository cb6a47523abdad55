"""Samples from workspaces: what people labelled, with true poses, in their maps."""

import json
import pickle
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from semviz.research.workspace_data import HELD_OUT_SHARE, WorkspaceSamples, workspace_samples
from semviz.workspace.demo import AUTHOR, demo_labels
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.edits import MoveObservation
from semviz_annotation.mapping.build import build_map
from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.base.elements import Elements3D
from semviz_core.base.map_file import save_map
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.errors import SemvizError
from semviz_core.localization.correspondences.candidate_pairs import Sample

FRAMES = 36
SLIPPED, SLIP_FRAME = 18, 6


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("training") / "town"
    workspace = Workspace.create_street(folder, 7, range(FRAMES))
    with workspace.open_labels() as store:
        store.apply(demo_labels(workspace.street, SLIPPED, SLIP_FRAME), AUTHOR)
    built, _ = build_map(workspace.read_labels(), workspace.street)
    save_map(built, workspace.map_path("main"))
    return folder


@pytest.fixture(scope="module")
def samples(made: Path) -> WorkspaceSamples:
    return workspace_samples([Workspace.open(made)], shift_m=5.0)


@pytest.fixture
def workspace(made: Path, tmp_path: Path) -> Workspace:
    return Workspace.open(shutil.copytree(made, tmp_path / "town"))


def test_true_pairs_lie_where_people_labelled_them(samples: WorkspaceSamples) -> None:
    for number in range(30):
        sample = samples.sample(number)
        assert sample.truth is not None
        seen, mapped = np.nonzero(sample.truth.pairs & sample.seen_known[:, :1])
        assert len(seen) >= 3
        ray = sample.point_m[mapped] @ sample.truth.rotation.T + sample.truth.translation
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        off_rad = np.linalg.norm(ray - sample.ray[seen], axis=1)
        assert np.median(off_rad) < 0.005  # one pole is labelled wrongly
        assert (sample.seen_class[seen] == sample.mapped_class[mapped]).all()


def test_numbers_make_other_fixes_and_the_same_number_the_same_sample(
    samples: WorkspaceSamples,
) -> None:
    there = pickle.loads(pickle.dumps(samples))
    origins = {tuple(samples.sample(number).origin_m) for number in range(20)}
    assert len(origins) == 20
    for number in (0, 7):
        for value, other in (
            (samples.sample(number), there.sample(number)),
            (samples.held_out(number), there.held_out(number)),
        ):
            np.testing.assert_array_equal(value.point_m, other.point_m)
            np.testing.assert_array_equal(value.prior, other.prior)


def test_the_last_frames_are_kept_back(samples: WorkspaceSamples) -> None:
    trained = {frame.T_map_camera for frame in samples.training}
    assert trained.isdisjoint(frame.T_map_camera for frame in samples.kept_back)
    share = len(samples.kept_back) / (len(samples.training) + len(samples.kept_back))
    assert share == pytest.approx(HELD_OUT_SHARE, abs=0.1)
    seen = {shown(samples.sample(number)) for number in range(100)}
    assert len(seen) == len(samples.training)
    assert seen.isdisjoint(shown(samples.held_out(number)) for number in range(20))


def test_several_workspaces_are_mixed(made: Path) -> None:
    mixed = workspace_samples([Workspace.open(made)] * 2)
    assert len(mixed.training) == 2 * len(workspace_samples([Workspace.open(made)]).training)
    told = json.loads(json.dumps(mixed.describe()))
    assert told["workspaces"] == ["town", "town"]
    assert told["frames"] == len(mixed.training)


def test_other_labels_are_described_otherwise(workspace: Workspace) -> None:
    before = workspace_samples([workspace]).describe()
    assert before == workspace_samples([Workspace.open(workspace.path)]).describe()
    with workspace.open_labels() as store:
        row = next(
            observation
            for observation in store.labels.observations.values()
            if observation.side == "left"
        )
        u, v = row.anchor_px
        store.apply(MoveObservation(row.id, (u, v - 1.0), row.end_px), AUTHOR)
    after = workspace_samples([workspace]).describe()
    assert {name for name, value in after.items() if value != before[name]} == {"content"}


def test_what_nothing_can_be_learned_from_is_told_in_one_line(workspace: Workspace) -> None:
    faults: list[tuple[Callable[[Workspace], None], str]] = [
        (without_poses, "have no poses to learn from"),
        (with_another_map, "holds what is labelled in 0 frames"),
        (with_other_classes, "has the classes pole, barrel; matchers are trained for pole, tri"),
        (with_nan, "NaN"),
        (without_map, "no such map"),
        (without_labels, "0 frames have 4 labels or more"),
    ]
    for spoil, expected in faults:
        copy = Workspace.open(
            shutil.copytree(workspace.path, workspace.path.parent / spoil.__name__)
        )
        spoil(copy)
        with pytest.raises(SemvizError, match=expected) as told:
            workspace_samples([copy])
        assert "\n" not in str(told.value)
        assert spoil.__name__ in str(told.value)  # the folder


def without_map(workspace: Workspace) -> None:
    workspace.map_path("main").unlink()


def without_labels(workspace: Workspace) -> None:
    workspace.labels_path.unlink()


def without_poses(workspace: Workspace) -> None:
    source = workspace.source
    frames = tuple(replace(frame, T_map_camera=None) for frame in source.frames)
    bare = SimpleNamespace(frames=frames, rig=source.rig, map_frame=source.map_frame)
    workspace.source = bare  # type: ignore[assignment]


def with_another_map(workspace: Workspace) -> None:
    """One that knows nothing of the labels."""
    save_map(replace(workspace.read_map("main"), provenance=()), workspace.map_path("main"))


def with_other_classes(workspace: Workspace) -> None:
    pole = DEFAULT_CLASSES[0]
    barrel = replace(DEFAULT_CLASSES[1], id=9, name="barrel", letter="B")
    none = Elements3D.from_ends([], [], [], [])
    other = SemanticMap(none, workspace.source.map_frame, ClassSet((pole, barrel)))
    save_map(other, workspace.map_path("main"))


def with_nan(workspace: Workspace) -> None:
    path = workspace.map_path("main")
    table = pq.read_table(path)
    rows = table.column("anchor_m").to_pylist()
    rows[0] = [float("nan")] * 3
    column = table.schema.get_field_index("anchor_m")
    field = table.schema.field(column)
    pq.write_table(table.set_column(column, field, pa.array(rows, field.type)), path)


def shown(sample: Sample) -> tuple[float, ...]:
    """What tells frames apart: where the first element is in the image."""
    return tuple(sample.ray[0])
