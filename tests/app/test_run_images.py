"""Images are in a run's file, or named there, or left out; what names them finds them."""

import runpy
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import Call, call

from semviz.runs.images import (
    check_images_available,
    frame_image,
    missing_image_reason,
    with_images,
)
from semviz.runs.reader import load_run
from semviz.runs.run import Images, Run
from semviz.runs.writer import RunWriter, repair
from semviz.workspace.workspace import TRUTH, Workspace
from semviz_core.base.frame import Side
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.kitti import KittiSequence
from semviz_core.simulation.street import Street

made_up: dict[str, Any] = runpy.run_path(str(Path(__file__).parents[2] / "bench" / "recording.py"))
MAP = made_up["make_map"](length_m=20.0)
GREY: dict[Side, int] = {"left": 60, "right": 180}
SIDES: tuple[Side, ...] = ("left", "right")


@pytest.fixture
def source(tmp_path: Path) -> KittiSequence:
    """Two stereo frames, each camera's images of one grey."""
    folder = tmp_path / "data" / "kitti" / "sequences" / "07"
    for camera, side in ((2, SIDES[0]), (3, SIDES[1])):
        (folder / f"image_{camera}").mkdir(parents=True)
        for index in range(2):
            image = np.full((40, 120, 3), GREY[side] + index, np.uint8)
            assert cv2.imwrite(str(folder / f"image_{camera}" / f"{index:06d}.png"), image)
    (folder / "calib.txt").write_text(
        "P2: 100 0 60 0 0 100 20 0 0 0 1 0\nP3: 100 0 60 -50 0 100 20 0 0 0 1 0\n"
    )
    (folder / "times.txt").write_text("0.0\n0.1\n")
    return KittiSequence(tmp_path / "data" / "kitti", "07")


def recorded(source: KittiSequence, images: Images, path: Path) -> Run:
    path.parent.mkdir(parents=True, exist_ok=True)
    with RunWriter(path, made_up["make_info"]("a run"), MAP) as writer:
        for record in made_up["make_records"](MAP, 2, None):
            writer.write(with_images(record, source, images, path.parent))
    return load_run(path)


def grey(run: Run, path: Path, position: int, side: Side) -> int | None:
    """Of an image, as a browser would decode it; None where there is none."""
    data = frame_image(run, path, position, side)
    if data is None:
        return None
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return int(np.median(image))


@pytest.mark.parametrize(
    ("images", "sides"),
    [("embedded", {"left"}), ("both", {"left", "right"}), ("reference", {"left", "right"}),
     ("none", set[str]())],
)  # fmt: skip
def test_what_was_asked_for_is_found_again(
    tmp_path: Path, source: KittiSequence, images: Images, sides: set[str]
) -> None:
    path = tmp_path / "town" / "runs" / "run.rrd"
    run = recorded(source, images, path)
    for position in range(2):
        for side in SIDES:
            expected = GREY[side] + position if side in sides else None
            assert grey(run, path, position, side) == expected
            if expected is None:
                assert "without images" in missing_image_reason(run, path, position, side)


def test_named_images_move_with_the_run_and_say_where_they_were(
    tmp_path: Path, source: KittiSequence
) -> None:
    path = tmp_path / "data" / "runs" / "run.rrd"
    run = recorded(source, "reference", path)
    assert run.frames[0].image is None
    assert run.frames[0].image_file == "../kitti/sequences/07/image_2/000000.png"
    moved = (tmp_path / "data").rename(tmp_path / "elsewhere") / "runs" / "run.rrd"
    assert grey(load_run(moved), moved, 1, "right") == GREY["right"] + 1
    gone = moved.parents[1] / "kitti" / "sequences" / "07" / "image_3" / "000001.png"
    gone.unlink()
    assert frame_image(run, moved, 1, "right") is None
    why = missing_image_reason(run, moved, 1, "right")
    assert why == f"{gone}: the run references this image, but it does not exist any more."


def test_a_repaired_copy_names_the_same_images(tmp_path: Path, source: KittiSequence) -> None:
    path, copy = tmp_path / "data" / "runs" / "run.rrd", tmp_path / "copy.rrd"
    recorded(source, "reference", path)
    repair(path, copy)
    assert grey(load_run(copy), copy, 0, "left") == GREY["left"]


def test_a_run_hands_out_nothing_but_images(tmp_path: Path, source: KittiSequence) -> None:
    """A foreign run may name any file of ours."""
    path = tmp_path / "run.rrd"
    run = recorded(source, "reference", path)
    secret = Path(source.image_path(0, "left"))
    secret.write_text("secret")
    assert frame_image(run, path, 0, "left") is None
    assert "cannot be read" in missing_image_reason(run, path, 0, "left")


def test_images_that_a_source_does_not_have_are_refused(source: KittiSequence) -> None:
    with pytest.raises(SemvizError, match="simulated street has no image files"):
        check_images_available(Street(1), "reference")
    root = source.image_path(0, "left").parents[3]
    with pytest.raises(SemvizError, match="the sequence has one camera"):
        check_images_available(KittiSequence(root, "07", (2,)), "both")


def test_the_command_records_both_cameras(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run: Call = partial(call, capsys)
    street, path = tmp_path / "street", tmp_path / "run.rrd"
    run("new", street, "--simulate", 3, "--frames", "0:2")
    localize = ("localize", street, "--map", TRUTH, "--out", path, "--images")
    status, _, errors = run(*localize, "reference")
    assert (status, errors.count("\n")) == (2, 1)
    assert not path.exists()
    assert run(*localize, "both")[0] == 0
    written = load_run(path)
    assert written.info.images == "both"
    source = Workspace.open(street).source
    for side in SIDES:
        data = frame_image(written, path, 1, side)
        assert data is not None
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert decoded is not None
        off = np.abs(decoded[:, :, ::-1].astype(int) - source.image(1, side))
        assert off.mean() < 6, side
