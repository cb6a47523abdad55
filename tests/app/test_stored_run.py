"""Runs whose frames stay in their file: the same frames come back, and few are held."""

import random
import runpy
import shutil
import time
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
from equality import assert_same
from small_runs import saved, small_run

from semviz.inspector.context import EmbeddedAnnotators, RunLibrary
from semviz.inspector.messages import GetStoryRequest, GoToPositionRequest, OpenRunRequest
from semviz.inspector.server import InspectorSession
from semviz.inspector.views import FrameEvent, RunEvent
from semviz.reports.run_plots import RunReport
from semviz.reports.run_report import comparison_tables
from semviz.runs import stored_run
from semviz.runs.comparison import compare_runs
from semviz.runs.frame_table import frame_table
from semviz.runs.metrics import summarize_run
from semviz.runs.reader import load_run
from semviz.runs.run import FrameRecord, Run
from semviz.runs.stored_run import open_run
from semviz.runs.table_metrics import found_diagnoses
from semviz.runs.tables import frame_rows
from semviz.runs.writer import RunWriter
from semviz.web.protocol import Event, Request
from semviz.web.viser_servers import ViserServers
from semviz.workspace.maps.passes import pass_of
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


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The positions of the frames that were read from files, in order."""
    positions: list[int] = []
    of_file = stored_run.StoredFrames.read

    def noted(frames: stored_run.StoredFrames, position: int) -> Any:
        positions.append(position)
        return of_file(frames, position)

    monkeypatch.setattr(stored_run.StoredFrames, "read", noted)
    return positions


def assert_same_run(opened: Run, whole: Run) -> None:
    assert_same(replace(opened, frames=tuple(opened.frames)), whole)
    assert_same(frame_table(opened), frame_table(whole))


@pytest.mark.usefixtures("unread")
def test_a_run_opens_by_its_table_and_its_frames_come_when_needed(
    path: Path, read: list[int]
) -> None:
    opened = open_run(path)
    assert len(frame_table(opened)) == FRAMES
    assert not read
    assert opened.frames[7] is opened.frames[7]
    assert read == [7]
    assert_same_run(opened, load_run(path))


def test_a_run_is_evaluated_with_one_frame_after_the_other(
    path: Path, read: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stored_run, "HELD", 3)
    opened, whole = open_run(path), load_run(path)
    assert summarize_run(opened) == summarize_run(whole)
    assert found_diagnoses(opened) == found_diagnoses(whole)
    assert read == list(range(FRAMES)), "each once: nothing that needs them all at a time"
    assert frame_rows(opened) == frame_rows(whole)


def test_compare_report_and_passes_read_each_frame_once(
    path: Path, read: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stored_run, "HELD", 3)
    opened = open_run(path, checks_frames=True)
    assert compare_runs(opened, opened).as_dict()["same"] == FRAMES
    assert read == list(range(FRAMES)), "compare: what was read and checked at opening"
    read.clear()
    reported = RunReport.of("run", path, open_run(path))
    assert comparison_tables([reported])
    assert len(reported.outcomes) == FRAMES
    assert read == list(range(FRAMES)), "report: before faults and pictures"
    read.clear()
    one = pass_of("run", open_run(path), MAP.frame)
    assert read == list(range(FRAMES))
    assert not any(len(result.submap) for result in one.localizations)


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


@pytest.mark.parametrize("cut", [*range(1, 60, 7), 5000, 60000])
def test_a_file_whose_end_is_cut_off_opens_with_its_whole_frames(
    path: Path, tmp_path: Path, cut: int
) -> None:
    content = path.read_bytes()
    cut_off = tmp_path / "cut.rrd"
    cut_off.write_bytes(content[:-cut])
    opened = open_run(cut_off)
    assert 0 < len(opened.frames) <= FRAMES
    assert len(opened.frames) == FRAMES or cut > 60


@pytest.mark.parametrize("size", [0, 11, 12, 43, 44, 2000])
def test_the_mere_start_of_a_file_is_refused_in_one_line(
    path: Path, tmp_path: Path, size: int
) -> None:
    start = tmp_path / "start.rrd"
    start.write_bytes(path.read_bytes()[:size])
    with pytest.raises(SemvizError):
        open_run(start)
    start.write_bytes(path.read_bytes()[:size] + b"\x02" + bytes(7) + b"\xff" * 40)
    with pytest.raises(SemvizError):
        open_run(start)


@pytest.mark.parametrize("looked_at", [True, False])
def test_the_page_leaves_out_a_frame_that_turns_out_to_be_damaged(
    tmp_path: Path, looked_at: bool
) -> None:
    """Whether it is to be shown, or read to diagnose the run."""
    run = replace(small_run(), info=replace(small_run().info, version=version("semviz")))
    file = saved(run, tmp_path / "run.rrd")
    content, number = bytearray(file.read_bytes()), run.frames[3].frame.index
    frames = open_run(file).frames
    assert isinstance(frames, stored_run.StoredFrames)
    ((start, stop),) = frames.places[3]
    content[(start + stop) // 2] ^= 8
    file.write_bytes(content)
    said, scenes = list[Event](), ViserServers()
    try:
        library = RunLibrary([file])
        session = InspectorSession("one", library, EmbeddedAnnotators(), scenes, said.append)
        session.receive(OpenRunRequest(id="1", frame=run.frames[0].frame.index))
        asked: Request = GoToPositionRequest(id="2", position=3)
        session.receive(asked if looked_at else GetStoryRequest(id="2"))
        for _ in range(600):
            if sum(isinstance(event, RunEvent) for event in said) == 2:
                break
            time.sleep(0.05)
        _, left = [event.run for event in said if isinstance(event, RunEvent)]
        assert number not in left.frames.index
        assert len(left.frames.index) == len(run.frames) - 1
        assert f"(frame {number})" in left.note
        last = [event.frame for event in said if isinstance(event, FrameEvent)][-1]
        assert last.index != number
    finally:
        scenes.close_all()
