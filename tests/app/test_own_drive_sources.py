"""Every source of an own drive, by the command of the docs, to the first page."""

from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import call
from drive_formats import CALIBRATION, COUNT, POSES, image_name, written
from drive_layouts import (
    argoverse2,
    boreas,
    comma,
    euroc_layout,
    gnss,
    images,
    kitti_360,
    kitti_raw,
    nuscenes,
)

from semviz.annotator.session import LabelSession
from semviz.workspace.workspace import Workspace
from semviz_core.datasets.own_drive.recording import DriveFiles

OPTIONS = ("images", "right", "calibration", "poses", "times", "extrinsic", "sequence", "scale")


def with_images(write: Callable[[Path], Path]) -> Callable[[Path], DriveFiles]:
    """A folder of images beside a file of poses in one of the formats."""

    def files(root: Path) -> DriveFiles:
        root.mkdir()
        folder = images(root / "cam", [Path(image_name(index)).name for index in range(COUNT)])
        calibration = written(root / "camera.toml", CALIBRATION)
        poses = write(root)
        return DriveFiles(folder, calibration=calibration, poses=poses, metric=True)

    return files


SOURCES: dict[str, Callable[[Path], DriveFiles]] = {
    "KITTI raw": kitti_raw,
    "KITTI-360": kitti_360,
    "nuScenes": nuscenes,
    "EuRoC's layout": euroc_layout,
    "Argoverse 2": argoverse2,
    "Boreas": boreas,
    "GNSS": gnss,
    "comma2k19": comma,
} | {name: with_images(write) for name, write in POSES.items()}


@pytest.mark.parametrize("name", SOURCES)
def test_each_source_leads_to_its_first_page(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files, town = SOURCES[name](tmp_path / "drive"), tmp_path / "town"
    words: list[object] = ["new", town, "--rate", files.rate_hz]
    for option in OPTIONS:
        value = getattr(files, option)
        words += [] if value is None else [f"--{option}", value]
    words += ["--cameras", ",".join(files.cameras)] if files.cameras else []
    words += ["--metric"] if files.metric else []
    code, out, err = call(capsys, *words)
    assert code == 0, err
    assert f"next: semviz annotate {town}" in out
    session = LabelSession(Workspace.open(town), "ann")
    try:
        first = session.workspace.source.frames[0]
        assert first.T_map_camera is not None
        assert session.frame(first.index).panes["left"].frame == first.index
    finally:
        session.close()
