"""Packed bags are read, and unpacked only up to a limit."""

import os
import shutil
import sqlite3
from pathlib import Path

import cv2
import numpy as np
import pytest
from bags import Kind, bag, put_camera
from conftest import skip_or_fail

from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.adapters import rosbag
from semviz_core.datasets.own_drive.adapters.rosbag import read_bag
from semviz_core.datasets.own_drive.cameras.lens import OriginalCamera
from semviz_core.datasets.own_drive.recording import DriveFiles

PACKED: tuple[tuple[Kind, str], ...] = (
    ("ROS 1", "bz2"), ("ROS 1", "lz4"), ("MCAP", "storage"), ("MCAP", "message"),
    ("ROS 2", "message"), ("ROS 2", "file"),
)  # fmt: skip
K = np.array([[50.0, 0.0, 31.5], [0.0, 50.0, 23.5], [0.0, 0.0, 1.0]])


@pytest.fixture(autouse=True)
def _rosbags() -> None:
    try:
        import rosbags.highlevel  # noqa: F401
    except ImportError:
        skip_or_fail("rosbags is missing; pip install '.[ros]' brings it")


def small(folder: Path, kind: Kind, packed: str = "") -> Path:
    """A bag of one image of 9 kB."""
    image = folder / "1700000000000000000.png"
    assert cv2.imwrite(str(image), np.zeros((48, 64, 3), np.uint8))
    camera = OriginalCamera("pinhole", 64, 48, K, np.zeros(0))
    path = folder / ("bag.bag" if kind == "ROS 1" else "bag")
    with bag(path, kind, packed) as (put, types):
        put_camera(put, types, "/a", "a", [(int(image.stem), image)], camera, "bgr8")
    return path


def read(path: Path) -> None:
    read_bag(DriveFiles(path, extracted=path.parent / "extracted"))


@pytest.mark.parametrize(("kind", "packed"), PACKED)
def test_packed_bags_are_read_and_bombs_are_refused(
    tmp_path: Path, kind: Kind, packed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = small(tmp_path, kind, packed)
    read(path)
    if packed == "file":
        usage = shutil.disk_usage(tmp_path)._replace(free=rosbag.MOST_CHUNK_BYTES + 5000)
        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    else:
        monkeypatch.setattr(rosbag, "MOST_CHUNK_BYTES", 5000)
    shutil.rmtree(tmp_path / "extracted")
    with pytest.raises(SemvizError, match=r"bag.*: (a chunk )?unpacks to more than") as refusal:
        read(path)
    assert "\n" not in str(refusal.value)
    assert not (tmp_path / "extracted").exists()


def test_pipes_and_databases_of_endless_queries_are_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mcap")
    with pytest.raises(SemvizError, match="a folder or a device"):
        read(tmp_path / "pipe.mcap")
    path = small(tmp_path, "ROS 2")
    (database,) = path.glob("*.db3")
    with sqlite3.connect(database) as opened:
        opened.executescript(
            "DROP TABLE messages; CREATE VIEW messages AS WITH RECURSIVE n(i) AS"
            " (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i AS id FROM n;"
        )
    opened.close()
    with pytest.raises(SemvizError, match="a view or trigger"):
        read(path)


def test_a_schema_that_is_no_text_is_a_damaged_bag(tmp_path: Path) -> None:
    path = small(tmp_path, "ROS 2")
    (database,) = path.glob("*.db3")
    data = database.read_bytes()
    assert b"CREATE INDEX" in data
    database.write_bytes(data.replace(b"CREATE INDEX", b"CRE\xbf\xbf\xbf\xbf\xbf\xbfDEX"))
    with pytest.raises(SemvizError, match="a damaged bag") as refusal:
        read(path)
    assert "\n" not in str(refusal.value)
