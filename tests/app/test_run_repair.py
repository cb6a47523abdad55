"""A run that broke off, anywhere, is read up to there, and written anew as a whole file."""

import random
import runpy
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from command_line import Call, call, call_on_a_full_disk
from equality import assert_same

from semviz.runs.reader import load_run
from semviz.runs.run import FrameRecord
from semviz.runs.writer import RunWriter, repair
from semviz.workspace.workspace import TRUTH
from semviz_core.common.errors import SemvizError

made_up: dict[str, Any] = runpy.run_path(str(Path(__file__).parents[2] / "bench" / "recording.py"))
MAP = made_up["make_map"](length_m=60.0)
FRAMES = 12
CUTS = 50
WAIT_S = 120.0


@pytest.fixture(scope="module")
def written() -> list[FrameRecord]:
    return list(made_up["make_records"](MAP, FRAMES, made_up["make_jpeg"]()))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, written: list[FrameRecord]) -> bytes:
    path = tmp_path_factory.mktemp("runs") / "run.rrd"
    with RunWriter(path, made_up["make_info"]("a run"), MAP) as writer:
        for record in written:
            writer.write(record)
    return path.read_bytes()


def test_cut_anywhere_the_whole_frames_are_read(
    tmp_path: Path, whole: bytes, written: list[FrameRecord]
) -> None:
    path = tmp_path / "cut.rrd"
    frames_by_place = []
    for place in sorted(random.Random(1).sample(range(100, len(whole)), CUTS)):
        path.write_bytes(whole[:place])
        try:
            run = load_run(path)
        except SemvizError:  # its head, which holds the map, is not whole
            frames_by_place.append(-1)
            continue
        assert_same(run.frames, tuple(written[: len(run.frames)]))
        assert run.complete <= (len(run.frames) == FRAMES)
        frames_by_place.append(len(run.frames))
    assert frames_by_place == sorted(frames_by_place)
    size = len(whole) / FRAMES
    late = [k for k in frames_by_place if k >= FRAMES // 2]
    assert len(late) > CUTS // 3, f"frames of about {size:.0f} bytes are lost"


def test_a_repaired_run_is_whole_and_still_interrupted(
    tmp_path: Path,
    whole: bytes,
    written: list[FrameRecord],
    capsys: pytest.CaptureFixture[str],
) -> None:
    run: Call = partial(call, capsys)
    path = tmp_path / "cut.rrd"
    path.write_bytes(whole[: int(0.7 * len(whole))])
    status, output, _ = run("repair", path)
    assert status == 0
    repaired = load_run(path)
    kept = len(repaired.frames)
    assert FRAMES // 2 <= kept < FRAMES
    assert output == f"{path}: {repaired.note}\n"
    assert f"{kept} frames are readable" in repaired.note
    assert_same(repaired.frames, tuple(written[:kept]))
    verify = [sys.executable, "-m", "rerun_cli", "rrd", "verify", str(path)]
    assert subprocess.run(verify, capture_output=True, check=False).returncode == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cut.rrd"]


@pytest.mark.skipif(sys.platform == "win32", reason="limits the size of files as POSIX does")
@pytest.mark.parametrize("share", [0.5, 0.0])
def test_on_a_full_disk_repair_changes_nothing(tmp_path: Path, whole: bytes, share: float) -> None:
    """Whether it fills up between two frames, or is full before the first."""
    path = tmp_path / "cut.rrd"
    path.write_bytes(whole[: int(0.7 * len(whole))])
    before = path.read_bytes()
    done = call_on_a_full_disk(int(share * len(before)), "repair", path)
    assert done.returncode == 2
    assert done.stderr.startswith(f"semviz: {path}: cannot be written"), done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
    assert path.read_bytes() == before
    assert [each.name for each in tmp_path.iterdir()] == ["cut.rrd"]


def test_a_whole_run_stays_whole(tmp_path: Path, whole: bytes, written: list[FrameRecord]) -> None:
    path, copy = tmp_path / "run.rrd", tmp_path / "copy.rrd"
    path.write_bytes(whole)
    repair(path, copy)
    assert path.read_bytes() == whole
    run = load_run(copy)
    assert run.complete
    assert_same(run.frames, tuple(written))


def without_times(records: Sequence[FrameRecord]) -> tuple[FrameRecord, ...]:
    """All that two runs of the same frames have in common."""
    return tuple(
        replace(record, localization=replace(record.localization, time_ms={})) for record in records
    )


def await_frames(path: Path, count: int) -> int:
    """How many frames of a run that is being written can be read, once they are ``count``."""
    size, seen, until = 0, 0, time.monotonic() + WAIT_S
    while seen < count and time.monotonic() < until:
        grown = path.stat().st_size if path.is_file() else 0
        if grown == size:
            time.sleep(0.01)
            continue
        size = grown
        with suppress(SemvizError):  # while its head is not written
            seen = len(load_run(path).frames)
    return seen


def test_a_run_killed_while_localizing_keeps_its_frames(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """At some moment after its third frame."""
    run: Call = partial(call, capsys)
    street, whole = tmp_path / "street", tmp_path / "whole.rrd"
    run("new", street, "--simulate", 3, "--frames", "0:400")
    localize = ("localize", street, "--map", TRUTH, "--images", "none", "--out")
    process = subprocess.Popen(
        [sys.executable, "-m", "semviz.cli", *map(str, localize), tmp_path / "killed.rrd"]
    )
    path = tmp_path / "killed.partial.rrd"
    seen = await_frames(path, 3)
    time.sleep(random.Random(2).uniform(0.0, 0.2))
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL, "it was over before it was killed"
    killed = load_run(path)
    kept = len(killed.frames)
    assert (killed.complete, kept >= seen >= 3) == (False, True)
    run(*localize, whole, "--frames", f"0:{kept}")
    assert_same(without_times(killed.frames), without_times(load_run(whole).frames))
    assert run("evaluate", path)[0] == 0
    assert run("repair", path)[0] == 0
    assert len(load_run(path).frames) == kept
