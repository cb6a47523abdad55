"""Runs whose frames stay in their file: the same frames come back, and few are held."""

import random
import runpy
import shutil
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
from equality import assert_same

from semviz.runs import stored_run
from semviz.runs.frame_table import frame_table
from semviz.runs.reader import load_run
from semviz.runs.run import FrameRecord, Run
from semviz.runs.stored_run import open_run
from semviz.runs.writer import RunWriter
from semviz_core.common.errors import SemvizError

made_up: dict[str, Any] = runpy.run_path(str(Path(__file__).parents[2] / "bench" / "recording.py"))
MAP = made_up["make_map"](length_m=60.0)
INFO = replace(made_up["make_info"]("a run"), version=version("semviz"))
IMAGE = b"\xff\xd8" + bytes(range(256)) * 8
FRAMES = 25
"""More than are drawn at once, so that drawings lie between the frames."""
FLIPS = 80


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("runs") / "run.rrd"
    with RunWriter(path, INFO, MAP) as writer:
        for record in made_up["make_records"](MAP, FRAMES, IMAGE):
            writer.write(record)
    return path


@pytest.fixture
def unread(monkeypatch: pytest.MonkeyPatch) -> None:
    """The run must open by its table."""
    monkeypatch.delattr(stored_run, "_opened_by_reading")


def assert_same_run(opened: Run, whole: Run) -> None:
    assert_same(replace(opened, frames=tuple(opened.frames)), whole)
    assert_same(frame_table(opened), frame_table(whole))


@pytest.mark.usefixtures("unread")
def test_a_run_opens_by_its_table_and_its_frames_come_when_needed(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[int] = []
    of_file = stored_run.StoredFrames.read

    def noted(frames: stored_run.StoredFrames, position: int) -> Any:
        read.append(position)
        return of_file(frames, position)

    monkeypatch.setattr(stored_run.StoredFrames, "read", noted)
    opened = open_run(path)
    assert len(frame_table(opened)) == FRAMES
    assert not read
    assert opened.frames[7] is opened.frames[7]
    assert read == [7]
    assert_same_run(opened, load_run(path))


def test_only_a_few_frames_are_held(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stored_run, "HELD", 3)
    frames = open_run(path).frames
    held: list[FrameRecord] = list(frames)
    again = [frames[position] is held[position] for position in range(FRAMES - 1, -1, -1)]
    assert again[:3] == [True] * 3
    assert not any(again[3:])


@pytest.mark.usefixtures("unread")
def test_an_open_run_goes_on_with_its_own_file_when_another_replaces_it(
    path: Path, tmp_path: Path
) -> None:
    kept, other = tmp_path / "run.rrd", tmp_path / "other.rrd"
    shutil.copy(path, kept)
    opened = open_run(kept)
    with RunWriter(other, INFO, MAP) as writer:
        for record in made_up["make_records"](MAP, FRAMES, None, seed=5):
            writer.write(record)
    other.replace(kept)
    assert_same(tuple(opened.frames), load_run(path).frames)


def cut(content: bytes) -> bytes:
    """As a killed process leaves it: without the table, and within a frame."""
    return content[: int(0.9 * len(content))]


def shifted(content: bytes) -> bytes:
    """A message twice: everything after it is elsewhere."""
    first = content.index(b"\2" + bytes(7))
    end = first + 16 + int.from_bytes(content[first + 8 : first + 16], "little")
    return content[:end] + content[first:end] + content[end:]


def test_a_run_without_a_usable_table_is_read_through_with_progress(
    path: Path, tmp_path: Path
) -> None:
    for change in (cut, shifted):
        other, told = tmp_path / f"{change.__name__}.rrd", list[tuple[str, float]]()
        other.write_bytes(change(path.read_bytes()))
        opened = open_run(other, lambda step, share, told=told: told.append((step, share)))
        assert_same_run(opened, load_run(other))
        assert {step for step, _ in told} == {"looking for its frames", "reading its frames"}
        assert all(0 <= share <= 1 for _, share in told)


def test_a_run_of_another_version_is_diagnosed_anew(path: Path, tmp_path: Path) -> None:
    older = tmp_path / "older.rrd"
    whole = load_run(path)
    with RunWriter(older, replace(INFO, version="0"), MAP) as writer:
        for record in whole.frames:
            writer.write(record)
    steps = list[str]()
    opened = open_run(older, lambda step, _: steps.append(step))
    assert steps
    assert_same(tuple(opened.frames), whole.frames)


def test_a_flipped_bit_never_gives_another_frame_in_silence(tmp_path: Path) -> None:
    path = tmp_path / "short.rrd"
    with RunWriter(path, INFO, MAP) as writer:
        for record in made_up["make_records"](MAP, 5, IMAGE):
            writer.write(record)
    content, whole, rng = path.read_bytes(), load_run(path), random.Random(1)
    by_number = {record.frame.index: record for record in whole.frames}
    damaged, refused, outcomes = tmp_path / "damaged.rrd", 0, set[str]()
    for _ in range(FLIPS):
        place = rng.randrange(len(content))
        flipped = content[place] ^ 1 << rng.randrange(8)
        damaged.write_bytes(content[:place] + bytes([flipped]) + content[place + 1 :])
        try:
            opened = open_run(damaged)
        except SemvizError:
            refused += 1
            continue
        if len(opened.frames) < 5:
            assert opened.note, "frames are missing in silence"
            outcomes.add("left out")
        for position, number in enumerate(frame_table(opened).index.tolist()):
            try:
                record = opened.frames[position]
            except SemvizError as error:
                outcomes.add(str(error).removeprefix(f"{damaged}: frame {number} ")[:10])
            else:
                assert_same(record, by_number[number])
    assert refused < FLIPS / 2
    assert {"left out", "is damaged"} >= outcomes >= {"is damaged"}
