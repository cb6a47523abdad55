"""Whatever a file holds or is, its reader ends with one line, soon, and in little memory.

``bench/fuzz.py`` tries many more; what it found is here.
"""

import os
import resource
import runpy
import struct
import subprocess
import sys
import time
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from map_files import small_map

from semviz.runs.codec import decode, encode
from semviz.runs.images import frame_image, missing_image_reason
from semviz.runs.run import Run
from semviz.workspace.drive.drive_file import read_drive_file
from semviz.workspace.workspace import Workspace
from semviz_annotation.label_formats.exchange import guess_format
from semviz_annotation.label_formats.reading import read_bytes
from semviz_annotation.labels.proposals import load_proposals, read_proposals
from semviz_annotation.mapping.backdrop import load_backdrop
from semviz_annotation.storage.backup import import_operations, tells_its_length
from semviz_annotation.storage.store import LabelStore
from semviz_core.base.detector_model import DetectorCalibration
from semviz_core.base.map_file import load_map, save_map
from semviz_core.base.pose import Pose
from semviz_core.base.weights import read_weights
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import decode_image, read_limited, unpacked, unpacked_columns
from semviz_core.datasets.own_drive.cameras.calibration_files import read_calibration
from semviz_core.datasets.own_drive.cameras.recorded_cameras import read_nerfstudio
from semviz_core.datasets.own_drive.poses.pose_files import read_poses
from semviz_core.datasets.trajectory import load_trajectory
from semviz_core.detection.foreign_models import OnnxSettings
from semviz_core.detection.model_config import read_settings
from semviz_core.research.evaluation.roads import kitti_road
from semviz_core.research.training import annotated_images
from semviz_core.research.training.annotated_images import MASK_TABLE, SegmentationImages

REPOSITORY = Path(__file__).parents[2]
READERS: dict[str, Callable[[Path], object]] = {
    "text": lambda path: read_limited(path, 100),
    "labels": lambda path: read_bytes(path, 100),
    "trajectory": load_trajectory,
    "map": load_map,
    "proposals": read_proposals,
    "weights": read_weights,
    "backdrop": load_backdrop,
    "model": lambda path: read_settings(path, OnnxSettings),
    "log of labels": tells_its_length,
    "labels of any format": guess_format,
    "detector calibration": DetectorCalibration.load,
    "drive": read_drive_file,
    "camera": read_calibration,
    "poses": read_poses,
    "nerfstudio": read_nerfstudio,
}
TRICKS = ("a pipe", "a device", "a folder", "a long name", "endless")


def path_of(trick: str, folder: Path) -> Path:
    path = folder / "file"
    match trick:
        case "a pipe":
            os.mkfifo(path)
        case "a device":
            return Path("/dev/zero")
        case "a folder":
            path.mkdir()
        case "a long name":
            return folder / ("x" * 3000)
        case _:
            with path.open("wb") as file:
                file.truncate(2**43)  # takes no room on the disk
    return path


@pytest.mark.parametrize("trick", TRICKS)
@pytest.mark.parametrize("reader", READERS)
@pytest.mark.timeout(20)
def test_what_is_no_ordinary_file_is_one_line(reader: str, trick: str, tmp_path: Path) -> None:
    with pytest.raises((SemvizError, OSError)) as caught:
        READERS[reader](path_of(trick, tmp_path))
    if trick != "a long name":  # the command line says what the system says
        assert isinstance(caught.value, SemvizError)
        assert len(str(caught.value).splitlines()) == 1


made_up: dict[str, Any] = runpy.run_path(str(REPOSITORY / "bench" / "recording.py"))


def run_with(**images: object) -> Run:
    semantic_map = made_up["make_map"](length_m=20.0)
    (record,) = made_up["make_records"](semantic_map, 1, None)
    return Run(made_up["make_info"]("a run"), semantic_map, (replace(record, **images),))


@pytest.mark.parametrize("trick", TRICKS)
@pytest.mark.timeout(60)
def test_a_run_that_names_a_strange_image_has_none(trick: str, tmp_path: Path) -> None:
    run, path = run_with(image_file=str(path_of(trick, tmp_path))), tmp_path / "run.rrd"
    assert frame_image(run, path, 0, "left") is None
    reason = missing_image_reason(run, path, 0, "left")
    assert "the run references this image" in reason
    assert len(reason) < 500


def png(width: int, height: int) -> bytes:
    """A PNG that states a size; its pixels are missing."""
    chunks = [
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)),
        (b"IDAT", zlib.compress(bytes(1000))),
        (b"IEND", b""),
    ]
    parts = [
        struct.pack(">I", len(content)) + kind + content
        + struct.pack(">I", zlib.crc32(kind + content))
        for kind, content in chunks
    ]  # fmt: skip
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def jpeg(width: int, height: int) -> bytes:
    data = bytearray(cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes())
    place = data.index(b"\xff\xc0")
    data[place + 5 : place + 9] = struct.pack(">HH", height, width)
    return bytes(data)


@pytest.mark.parametrize("image", [png(60_000, 60_000), png(2**31 - 1, 1), jpeg(60_000, 60_000)])
def test_an_image_that_unpacks_to_gigabytes_is_not_decoded(image: bytes, tmp_path: Path) -> None:
    with pytest.raises(SemvizError, match=r"x.*pixels are read"):
        decode_image(image, "here")
    assert frame_image(run_with(image=image), tmp_path / "run.rrd", 0, "left") is None
    assert "pixels are read" in missing_image_reason(
        run_with(image=image), tmp_path / "run.rrd", 0, "left"
    )


def test_a_png_whose_chunk_is_longer_than_the_file_reserves_nothing() -> None:
    """Found by fuzzing: OpenCV took 4 GB and 6 s for these 190 bytes."""
    image = bytearray(cv2.imencode(".png", np.zeros((40, 120, 3), np.uint8))[1].tobytes())
    place = image.index(b"IDAT")
    image[place - 4 : place] = struct.pack(">I", 0xF6000085)
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.monotonic()
    with pytest.raises(SemvizError, match="not a readable PNG"):
        decode_image(bytes(image), "here")
    assert time.monotonic() - start < 1.0
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < before + 100 * 1024


def test_a_parquet_file_of_a_few_kilobytes_does_not_unpack_to_gigabytes(tmp_path: Path) -> None:
    path = tmp_path / "bomb.parquet"
    count = 50_000_000
    table = pa.table({"id": pa.DictionaryArray.from_arrays(np.zeros(count, np.int32), ["x" * 99])})
    pq.write_table(table, path, compression="zstd")
    assert path.stat().st_size < 1_000_000
    for read in (load_map, read_proposals):
        with pytest.raises(SemvizError, match="values in a column"):
            read(path)


def test_long_texts_in_a_map_are_refused_before_they_are_repeated(tmp_path: Path) -> None:
    path = tmp_path / "map.parquet"
    save_map(small_map(), path)
    table = pq.read_table(path)
    names = pa.array([["x" * 1_000_000] * 20] * len(table), pa.list_(pa.string()))
    place = table.schema.get_field_index("label_ids")
    pq.write_table(table.set_column(place, "label_ids", names), path, compression="zstd")
    with pytest.raises(SemvizError, match="a text of more than 300 characters"):
        load_map(path)


def test_the_footer_says_what_pyarrow_says(tmp_path: Path) -> None:
    path = tmp_path / "map.parquet"
    for compression in ("zstd", "none"):
        table = pa.table({"a": np.arange(100_000), "b": [None, "text"] * 50_000})
        pq.write_table(table, path, compression=compression, row_group_size=30_000)
        assert [column.values for column in unpacked_columns(path) if column.bytes] >= [100_000] * 2
    for cut in range(0, path.stat().st_size, 997):
        broken = tmp_path / "cut.parquet"
        broken.write_bytes(path.read_bytes()[:cut])
        with pytest.raises(ValueError, match=r"."):
            unpacked_columns(broken)


def test_compressed_decisions_do_not_unpack_to_gigabytes() -> None:
    bomb = zlib.compress(bytes(50_000_000))
    assert unpacked(bomb, 50_000_000) == bytes(50_000_000)
    with pytest.raises(ValueError, match="unpacks to more than 1000000 bytes"):
        unpacked(bomb, 1_000_000)


SETTINGS = {
    "5,000 digits": "version = " + "9" * 5000,
    "nested": "a = " + "[" * 100_000,
    "a long name": "version = 1\nname = '" + "x" * 3000 + "'",
    "infinite": "version = inf",
    "no text": "\udc80",
    "keys": "[" + "a." * 100_000 + "a]",
}


@pytest.mark.parametrize("trick", SETTINGS)
@pytest.mark.timeout(30)
def test_hostile_settings_are_one_line(trick: str, tmp_path: Path) -> None:
    text = SETTINGS[trick].encode("utf-8", "surrogateescape")
    for name in ("semviz.toml", "model.toml"):
        (tmp_path / name).write_bytes(text)
    for read in (
        lambda: Workspace.open(tmp_path),
        lambda: read_settings(tmp_path / "model.toml", OnnxSettings),
    ):
        with pytest.raises(SemvizError) as caught:
            read()
        assert len(str(caught.value).splitlines()) == 1
        assert len(str(caught.value)) < 600


def test_tensors_with_a_header_of_another_kind_are_one_line(tmp_path: Path) -> None:
    from safetensors.numpy import save

    path = tmp_path / "file.safetensors"
    key = {read_weights: "semviz weights", load_backdrop: "semviz backdrop"}
    for read, name in key.items():
        for header in ("[" * 100_000, "9" * 5000, "[]", "{}", '{"format": 1, "options": 3}'):
            path.write_bytes(save({"a": np.zeros(3)}, metadata={name: header}))
            with pytest.raises(SemvizError) as caught:
                read(path)
            assert len(str(caught.value)) < 500


@pytest.mark.parametrize("shape", [["x", 2**31], [-1], [2**80], "ab", None, [True], {"a": 1}])
def test_a_run_s_array_of_an_impossible_shape_reserves_nothing(shape: object) -> None:
    """Found by fuzzing: the product of "x" and 2**31 is a text of 2 GB."""
    structure, pools = encode(Pose(np.eye(3), np.zeros(3)))
    assert isinstance(decode(Pose, structure, pools), Pose)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises((ValueError, TypeError)):
        decode(Pose, structure | {"rotation": shape}, pools)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < before + 100 * 1024


def test_a_workspace_s_proposals_may_be_no_pipe(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "proposals.parquet")
    with pytest.raises(SemvizError, match="a folder or a device"):
        load_proposals(tmp_path / "proposals.parquet")


def test_every_reader_survives_some_broken_files(tmp_path: Path) -> None:
    """The bench without guidance, some inputs for each reader."""
    bench = str(REPOSITORY / "bench" / "fuzz.py")
    command = [sys.executable, bench, "--unguided", "30"]
    names = ["calibration", "csv", "geojson", "map", "model", "opendrive", "settings", "weights"]
    names += ["camera-yaml", "drive-file"]
    done = subprocess.run([*command, *names], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("Done 30 inputs") == len(names)


def test_a_log_of_empty_lines_takes_little_memory(tmp_path: Path) -> None:
    """A line of one byte takes 34 in memory, so 200 MB would take 7 GB."""
    path = tmp_path / "log.jsonl"
    path.write_bytes(b"\n" * 200_000_000)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with (
        LabelStore.open(tmp_path / "labels.db") as store,
        pytest.raises(SemvizError, match="line 1: not a log"),
    ):
        import_operations(path, store)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000


def test_a_pole_map_does_not_unpack_to_gigabytes(tmp_path: Path) -> None:
    poses, path = tmp_path / "poses.txt", tmp_path / "poles.npz"
    poses.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2)
    np.savez_compressed(path, poleparams=np.zeros((10_000_000, 2)))
    assert path.stat().st_size < 1_000_000
    with pytest.raises(SemvizError, match="unpacks to far more"):
        kitti_road(poses, path, "road")
    with zipfile.ZipFile(path, "w") as archive:  # found by fuzzing: NumPy gives bytes
        archive.writestr("poleparams", b"no array")
    with pytest.raises(SemvizError, match=r"poleparams has shape \(\), expected"):
        kitti_road(poses, path, "road")


def test_a_pattern_with_line_ends_is_shown_on_one_line(tmp_path: Path) -> None:
    """Found by fuzzing."""
    (tmp_path / MASK_TABLE).write_text(
        'images = "*.p\\n"\nmasks = "{name}\\r.png"\n[classes]\n1 = "pole"\n'
    )
    with pytest.raises(SemvizError, match="0 images") as refused:
        SegmentationImages.of(tmp_path, tmp_path / "prepared")
    assert str(refused.value).isprintable()
    (tmp_path / annotated_images.BOX_TABLE).write_text(
        'format = "yolo"\nimages = "."\nboxes = "{name}.txt"\n[classes]\n0 = "pole"\n'
    )
    with pytest.raises(SemvizError, match=r"images '\.': "):
        annotated_images.BoxImages.of(tmp_path, tmp_path / "prepared")
