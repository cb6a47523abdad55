"""A sequence of one camera, from labels to a pose: what moves past it is mapped and found again."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import call

from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.edits import AddObservation
from semviz_annotation.labels.labels import new_id
from semviz_core.datasets.trajectory import T_MAP_WORLD
from semviz_core.simulation.layout import StreetOptions
from semviz_core.simulation.street import Street

FRAMES = 12
SIGMA_PX = 0.5


@pytest.fixture(scope="module")
def street() -> Street:
    return Street(3, StreetOptions(FRAMES))


@pytest.fixture
def root(tmp_path: Path, street: Street) -> Path:
    """A KITTI folder with the street's left camera; nothing is to be seen in its images."""
    folder = tmp_path / "kitti" / "sequences" / "07"
    (folder / "image_2").mkdir(parents=True)
    camera = street.rig.left
    for index in range(FRAMES):
        image = np.zeros((camera.height, camera.width, 3), np.uint8)
        assert cv2.imwrite(str(folder / "image_2" / f"{index:06d}.png"), image)
    projection = np.column_stack([camera.K, np.zeros(3)])
    (folder / "calib.txt").write_text("P2: " + " ".join(map(repr, projection.ravel().tolist())))
    (folder / "times.txt").write_text("".join(f"{frame.time_s}\n" for frame in street.frames))
    lines = []
    for frame in street.frames:
        assert frame.T_map_camera is not None
        matrix = (T_MAP_WORLD.inverse() @ frame.T_map_camera).as_matrix()[:3]
        lines.append(" ".join(map(repr, matrix.ravel().tolist())))
    (tmp_path / "kitti" / "poses").mkdir()
    (tmp_path / "kitti" / "poses" / "07.txt").write_text("\n".join(lines) + "\n")
    return tmp_path / "kitti"


def label(workspace: Workspace, street: Street) -> None:
    """What is truly to be seen, half a pixel off."""
    rng = np.random.default_rng(0)
    names: dict[int, str] = {}
    with workspace.open_labels() as store:
        for index in range(FRAMES):
            seen, ids = street.labels(index, "left")
            for row, number in enumerate(ids):
                is_new = int(number) not in names
                element_id = names.setdefault(int(number), new_id())
                anchor, end = (
                    np.clip(px + rng.normal(0.0, SIGMA_PX, 2), 0.0, (1240.0, 375.0)).tolist()
                    for px in (seen.anchor_px[row], seen.end_px[row])
                )
                added = AddObservation(
                    observation_id=new_id(),
                    element_id=element_id,
                    frame_index=index,
                    side="left",
                    anchor_px=(anchor[0], anchor[1]),
                    end_px=(end[0], end[1]) if seen.is_line[row] else None,
                    anchor_known=bool(seen.anchor_known[row]),
                    end_known=bool(seen.end_known[row]),
                    class_id=int(seen.class_id[row]) if is_new else None,
                )
                store.apply(added, "ann")


@pytest.fixture
def town(root: Path, tmp_path: Path, street: Street) -> Workspace:
    workspace = Workspace.create_kitti(tmp_path / "town", root, "07", (2,))
    label(workspace, street)
    return workspace


def test_labels_of_one_camera_become_a_map_in_which_it_is_localized(
    town: Workspace, tmp_path: Path, street: Street, capsys: pytest.CaptureFixture[str]
) -> None:
    def semviz(*arguments: object) -> str:
        code, out, _ = call(capsys, *arguments)
        assert code == 0
        return out

    assert town.source.rig.right is None
    semviz("map", "build", town.path)
    built = town.read_map("main").elements
    truth = street.truth_map.elements
    nearest = np.linalg.norm(built.anchor_m[:, None] - truth.anchor_m[None], axis=2).min(axis=1)
    sigma = np.sqrt(np.trace(built.covariance_m2[:, :3, :3], axis1=1, axis2=2))
    assert len(built) > 8
    assert (nearest < 4.0 * sigma + 0.05)[built.anchor_known].all()
    assert np.median(nearest) < 0.3

    accuracy = json.loads(semviz("map", "check", town.path, "--json"))
    assert accuracy["classes"]["pole"]["lateral_rmse_px"] < 2.0 * SIGMA_PX

    run = tmp_path / "run.rrd"
    semviz("localize", town.path, "--out", run, "--images", "none")
    numbers = json.loads(semviz("evaluate", run, "--json"))
    assert numbers["status"]["ok"] >= FRAMES - 2
    assert numbers["rte_m"]["q3"] < 0.3
    assert numbers["rre_deg"]["q3"] < 0.3


def test_the_paper_method_needs_stereo_pairs(
    town: Workspace, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = call(capsys, "map", "build", town.path, "--method", "paper")
    assert (code, out) == (2, "")
    assert err == (
        "semviz: method paper triangulates stereo pairs, and no element is labelled in both "
        "images of a frame; use method joint\n"
    )
    assert not town.map_path("main").exists()
