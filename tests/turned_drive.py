"""A rendered drive in KITTI's folders, and poses of which three frames are turned."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from streets import street
from support.planted_pose_faults import moved
from support.street_labels import careful, label_street

from semviz.cli import main
from semviz.workspace.workspace import Workspace
from semviz_annotation.label_formats.import_plan import ImportLabels
from semviz_annotation.labels.labels import Labels
from semviz_core.base.frame import Frame, Side
from semviz_core.base.pose import Pose, so3_exp
from semviz_core.datasets.trajectory import T_MAP_WORLD, save_trajectory

SEED, COUNT = 7, 12
SIDES: tuple[tuple[Side, int], ...] = (("left", 2), ("right", 3))
TURNED = range(5, 8)


def poses_text(frames: tuple[Frame, ...]) -> str:
    lines = []
    for frame in frames:
        assert frame.T_map_camera is not None
        matrix = (T_MAP_WORLD.inverse() @ frame.T_map_camera).as_matrix()[:3]
        lines.append(" ".join(map(repr, matrix.ravel().tolist())))
    return "\n".join(lines)


@pytest.fixture(scope="session")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated drive in KITTI's folders; its left camera is camera 2, as is its camera 0."""
    root = tmp_path_factory.mktemp("drive")
    folder, source = root / "sequences" / "02", street(SEED, COUNT)
    for side, camera in SIDES:
        (folder / f"image_{camera}").mkdir(parents=True)
        for frame in source.frames:
            image = source.image(frame.index, side)[:, :, ::-1]
            cv2.imwrite(str(folder / f"image_{camera}" / f"{frame.index:06d}.png"), image)
    left = np.column_stack([source.rig.left.K, np.zeros(3)])
    right = left.copy()
    right[0, 3] = -source.rig.left.K[0, 0] * source.rig.baseline_m
    rows = [left, left, left, right]
    text = [
        f"P{camera}: " + " ".join(map(repr, P.ravel().tolist())) for camera, P in enumerate(rows)
    ]
    (folder / "calib.txt").write_text("\n".join(text))
    (folder / "times.txt").write_text("\n".join(f"{frame.time_s:.3f}" for frame in source.frames))
    (root / "poses").mkdir()
    (root / "poses" / "02.txt").write_text(poses_text(source.frames))
    return root


@pytest.fixture(scope="session")
def wrong_poses(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames 5 to 7 turned by 0.7 deg."""
    turn = Pose(so3_exp(np.deg2rad([0.0, 0.7, 0.0])), np.zeros(3))
    frames = moved(
        street(SEED, COUNT).frames, lambda row, pose: pose @ turn if row in TURNED else pose
    )
    path = tmp_path_factory.mktemp("poses") / "wrong.tum"
    save_trajectory(frames, path, "tum")
    return path


@pytest.fixture(scope="session")
def labels() -> Labels:
    source = street(SEED, COUNT)
    drawn = label_street(careful(source, 0.3, seed=1), range(COUNT), memory=COUNT).labels
    camera = source.rig.left
    inside = [
        row
        for row in drawn.observations.values()
        if camera.contains(np.array([row.anchor_px, row.end_px or row.anchor_px])).all()
    ]
    seen = {row.element_id for row in inside}
    return Labels.from_rows([*(drawn.element(row) for row in seen), *inside])


def store_labels(workspace: Workspace, labels: Labels) -> None:
    with workspace.open_labels() as store:
        rows = tuple(labels.elements.values()), tuple(labels.observations.values())
        store.apply(ImportLabels(*rows), "ann")


@pytest.fixture(scope="session")
def measured_town(
    drive: Path, wrong_poses: Path, labels: Labels, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A workspace whose frames 5 to 7 are turned, with labels, and the motions of its images."""
    folder = tmp_path_factory.mktemp("measured") / "town"
    words = ("new", folder, "--kitti", drive, "--poses", wrong_poses, "--check-poses")
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    assert not ended.value.code
    store_labels(Workspace.open(folder), labels)
    return folder
