"""One flipped bit in a run never gives another pose, covariance or image in silence."""

import gzip
import random
import runpy
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from command_line import Call, call
from equality import assert_same

from semviz.runs.metrics import check_complete
from semviz.runs.reader import load_run
from semviz.runs.run import Run
from semviz.runs.writer import RunWriter, repair
from semviz_core.common.errors import SemvizError

made_up: dict[str, Any] = runpy.run_path(str(Path(__file__).parents[2] / "bench" / "recording.py"))
MAP = made_up["make_map"](length_m=60.0)
INFO = made_up["make_info"]("a run")
FRAMES = 5
IMAGE = b"\xff\xd8" + bytes(range(256)) * 8
FLIPS = 600
VERSION_2 = Path(__file__).parent / "data" / "run-version-2.rrd.gz"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("runs") / "run.rrd"
    with RunWriter(path, INFO, MAP) as writer:
        for record in made_up["make_records"](MAP, FRAMES, IMAGE):
            writer.write(record)
    return path.read_bytes()


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory, whole: bytes) -> Run:
    path = tmp_path_factory.mktemp("runs") / "run.rrd"
    path.write_bytes(whole)
    run = load_run(path)
    assert (run.checked, run.damaged, run.lost, run.note) == (True, (), 0, "")
    return run


def flipped(content: bytes, place: int, bit: int) -> bytes:
    return content[:place] + bytes([content[place] ^ 1 << bit]) + content[place + 1 :]


def outcome(path: Path, sound: Run) -> str:
    """What a damaged file gives: the same run, some of its frames and a note, or an error."""
    try:
        run = load_run(path)
    except SemvizError as error:
        return "refused" if str(error).startswith(f"{path}: ") else f"unclear: {error}"
    by_number = {record.frame.index: record for record in sound.frames}
    assert_same(run.frames, tuple(by_number[record.frame.index] for record in run.frames))
    assert_same((run.info, run.semantic_map), (sound.info, sound.semantic_map))
    if len(run.frames) == len(sound.frames) and run.complete:
        return "harmless"
    assert run.note, "frames are missing in silence"
    assert len(run.frames) >= len(sound.frames) - 1, "the rest is not readable"
    return "noted"


def test_a_flipped_bit_is_noticed_or_harmless(tmp_path: Path, whole: bytes, sound: Run) -> None:
    path, rng = tmp_path / "run.rrd", random.Random(1)
    outcomes: Counter[str] = Counter()
    for _ in range(FLIPS):
        path.write_bytes(flipped(whole, rng.randrange(len(whole)), rng.randrange(8)))
        outcomes[outcome(path, sound)] += 1
    assert outcomes.keys() == {"harmless", "noted", "refused"}


def test_each_byte_of_a_frame_s_message_may_be_damaged(
    tmp_path: Path, whole: bytes, sound: Run
) -> None:
    """Heads of messages too: a length that names another size hides no later frame."""
    path = tmp_path / "run.rrd"
    messages = [start for start in range(len(whole)) if whole.startswith(b"\2" + bytes(7), start)]
    for start in messages[-8:]:
        for place in range(start, start + 24):
            path.write_bytes(flipped(whole, place, place % 8))
            assert outcome(path, sound) in ("harmless", "noted", "refused")


def damaged_frame(whole: bytes, sound: Run, path: Path) -> Run:
    """Damage a frame in the middle, found by trying; return the run read back."""
    for place in range(len(whole) // 3, len(whole), 999):
        path.write_bytes(flipped(whole, place, 3))
        if outcome(path, sound) == "noted" and load_run(path).damaged:
            return load_run(path)
    raise AssertionError("no frame was damaged")


def test_repair_keeps_the_other_frames_and_still_counts_the_damaged_one(
    tmp_path: Path, whole: bytes, sound: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    run: Call = partial(call, capsys)
    path, copy = tmp_path / "run.rrd", tmp_path / "copy.rrd"
    found = damaged_frame(whole, sound, path)
    (number,) = found.damaged
    status, output, _ = run("evaluate", path)
    assert status == 0
    assert f"1 frame is damaged and left out (frame {number})" in output
    assert "semviz repair" in output
    with pytest.raises(SemvizError, match="needs a complete run"):
        check_complete(found, str(path))
    repair(path, copy)
    again = load_run(copy)
    assert_same(again.frames, found.frames)
    assert (again.complete, again.lost, again.damaged) == (True, 1, ())
    assert "1 frame is damaged" in again.note


def test_a_frame_lost_from_an_interrupted_run_is_counted(
    tmp_path: Path, whole: bytes, sound: Run
) -> None:
    path = tmp_path / "run.rrd"
    found = damaged_frame(whole, sound, path)
    content = path.read_bytes()
    path.write_bytes(content[: content.rindex(b"\2" + bytes(7))])  # before the row of the end
    cut = load_run(path)
    assert (cut.complete, cut.lost, cut.damaged) == (False, 1, found.damaged)
    assert "interrupted" in cut.note
    assert "damaged" in cut.note


def test_a_run_without_checksums_opens_unchecked_and_repair_adds_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run: Call = partial(call, capsys)
    path = tmp_path / "run.rrd"
    path.write_bytes(gzip.decompress(VERSION_2.read_bytes()))
    before = load_run(path)
    assert (before.checked, before.note) == (False, "")
    assert run("repair", path)[1] == (
        f"{path}: 2 frames, complete; they had no checksums, so damage would not have been found\n"
    )
    after = load_run(path)
    assert after.checked
    assert_same(after.frames, before.frames)
