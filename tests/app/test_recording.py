"""Runs come back from their files bit for bit, whatever happened to the file."""

import runpy
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as nps

from semviz.recording import layout
from semviz.recording.codec import decode, encode
from semviz.recording.columns import Columns
from semviz.recording.reader import load_run
from semviz.recording.run import FrameRecord, Run
from semviz.recording.writer import RunWriter
from semviz_core.camera import Camera
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.errors import SemvizError
from semviz_core.frame import Frame, Prior
from semviz_core.localization import Alternative, Localization, Match, Refinement, Search
from semviz_core.pose import Pose

BENCH = Path(__file__).parents[2] / "bench" / "recording.py"
made_up: dict[str, Any] = runpy.run_path(str(BENCH))
JPEG: bytes = made_up["make_jpeg"]()
MAP = made_up["make_map"](length_m=60.0)
INFO = made_up["make_info"]("a run")


def make_records(frames: int, image: bytes | None = None) -> list[FrameRecord]:
    return list(made_up["make_records"](MAP, frames, image))


def write_run(path: Path, records: list[FrameRecord]) -> Path:
    with RunWriter(path, INFO, MAP) as writer:
        for record in records:
            writer.write(record)
    return path


def assert_same(one: Any, other: Any) -> None:
    """Equal to the last bit, types and dtypes included."""
    assert type(one) is type(other)
    if is_dataclass(one):
        for member in fields(one):
            assert_same(getattr(one, member.name), getattr(other, member.name))
    elif isinstance(one, np.ndarray):
        assert (one.dtype, one.shape) == (other.dtype, other.shape)
        assert one.tobytes() == other.tobytes()
    elif isinstance(one, tuple):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_same(a, b)
    elif isinstance(one, float):
        assert np.float64(one).tobytes() == np.float64(other).tobytes()
    elif isinstance(one, dict):
        assert list(one) == list(other)
        for key in one:
            assert_same(one[key], other[key])
    else:
        assert one == other


finite = st.floats(-1e6, 1e6)
anything = st.floats(allow_nan=True, allow_infinity=True)
counts = st.integers(0, 4)


def arrays(*shape: int, elements: st.SearchStrategy[Any] = finite, dtype: Any = np.float64) -> Any:
    return nps.arrays(dtype, shape, elements=elements)


poses = st.builds(Pose.from_rotvec, arrays(3, elements=st.floats(-3, 3)), arrays(3))
bools = st.booleans()
ids = st.integers(-(2**63), 2**63 - 1)


@st.composite
def elements_2d(draw: st.DrawFn, m: int) -> Elements2D:
    line = draw(arrays(m, elements=bools, dtype=bool))
    end = np.where(line[:, None], draw(arrays(m, 2)), np.nan)
    sigma = draw(arrays(m, 2, elements=st.floats(0.01, 50)))
    kind = draw(arrays(m, elements=st.integers(0, 3), dtype=np.int64))
    score = draw(arrays(m, elements=st.floats(0, 1)))
    known = draw(arrays(m, elements=bools, dtype=bool))
    return Elements2D(draw(arrays(m, 2)), end, kind, score, sigma, known, known & line)


@st.composite
def elements_3d(draw: st.DrawFn, n: int) -> Elements3D:
    line = draw(arrays(n, elements=bools, dtype=bool))
    end = np.where(line[:, None], draw(arrays(n, 3)), np.nan)
    number = np.array(draw(st.lists(ids, min_size=n, max_size=n, unique=True)), np.int64)
    kind = draw(arrays(n, elements=st.integers(0, 3), dtype=np.int64))
    known = draw(arrays(n, elements=bools, dtype=bool))
    covariance = draw(arrays(n, 6, 6))
    return Elements3D(number, draw(arrays(n, 3)), end, kind, covariance, known, known & line)


@st.composite
def localizations(draw: st.DrawFn) -> Localization:
    m, n, k = draw(counts), draw(counts), draw(counts)
    status = draw(st.sampled_from(["ok", "ambiguous", "cannot"]))
    k = k if m and n else 0
    pairs = np.stack(
        [
            draw(arrays(k, elements=st.integers(0, max(m - 1, 0)), dtype=np.int64)),
            draw(arrays(k, elements=st.integers(0, max(n - 1, 0)), dtype=np.int64)),
        ],
        axis=1,
    )
    match = st.builds(
        Match,
        arrays(m, n, elements=anything),
        arrays(m + 1, n + 1, elements=st.floats(0, 1)),
        st.just(pairs),
    )
    search = st.builds(
        Search, st.integers(0, 2**40), st.tuples(poses, poses), arrays(2, elements=anything)
    )
    refinement = st.builds(
        Refinement,
        st.just(pairs),
        arrays(k, 2, elements=st.floats(-50, 50) | st.just(np.nan)),
        arrays(k),
        arrays(k, elements=bools, dtype=bool),
        arrays(2, elements=anything),
    )
    prior = st.builds(
        Prior,
        arrays(3),
        horizontal_sigma_m=st.floats(0.1, 100),
        up_camera=st.none() | st.just(np.array([0.0, -1.0, 0.0])),
        heading_rad=st.none() | st.floats(-4, 4),
    )
    return Localization(
        method=draw(st.text()),
        camera=Camera(1241, 376, made_up["CAMERA"].K, draw(arrays(draw(counts)))),
        prior=draw(prior),
        observed=draw(elements_2d(m)),
        submap=draw(elements_3d(n)),
        status=status,
        reason=draw(st.text(min_size=1)),
        T_camera_map=None if status == "cannot" else draw(poses),
        covariance=draw(st.none() | arrays(6, 6)),
        match=draw(st.none() | match),
        search=draw(st.none() | search),
        refinement=draw(st.none() | refinement),
        alternatives=tuple(draw(st.lists(st.builds(Alternative, poses, anything), max_size=2))),
        time_ms=draw(st.dictionaries(st.text(min_size=1), anything, max_size=3)),
    )


@st.composite
def records(draw: st.DrawFn, index: int) -> FrameRecord:
    result = draw(localizations())
    frame = Frame(index, draw(st.floats(0, 1e6)), draw(st.none() | poses))
    element_id = draw(arrays(len(result.observed), elements=ids, dtype=np.int64))
    return FrameRecord(frame, result, element_id, draw(st.none() | st.just(JPEG)))


@given(st.integers(0, 9).flatmap(records))
@settings(max_examples=60, deadline=None)
def test_codec_gives_back_every_bit(record: FrameRecord) -> None:
    record = replace(record, image=None)
    structure, pools = encode(record)
    assert_same(decode(FrameRecord, structure, pools), record)


def test_codec_refuses_another_dtype() -> None:
    with pytest.raises(TypeError, match="float64 is expected here, not float32"):
        encode(Search(1, (), np.zeros(0, np.float32)))  # type: ignore[arg-type]


@given(st.tuples(records(3), records(4), records(8)))
@settings(
    max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_a_run_comes_back_bit_for_bit(tmp_path: Path, written: tuple[FrameRecord, ...]) -> None:
    run = load_run(write_run(tmp_path / "run.rrd", list(written)))
    assert_same(run, Run(INFO, MAP, written))


def test_a_run_of_no_frames(tmp_path: Path) -> None:
    assert_same(load_run(write_run(tmp_path / "run.rrd", [])), Run(INFO, MAP, ()))


def test_frame_numbers_go_up(tmp_path: Path) -> None:
    first, second = make_records(2)
    with RunWriter(tmp_path / "run.rrd", INFO, MAP) as writer:
        writer.write(second)
        with pytest.raises(ValueError, match="frame 0 comes after frame 1"):
            writer.write(first)


def test_rerun_verifies_the_file_and_nothing_warns(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        path = write_run(tmp_path / "run.rrd", make_records(12, JPEG))
    assert "WARN" not in capfd.readouterr().err
    verify = [sys.executable, "-m", "rerun", "rrd", "verify", str(path)]
    done = subprocess.run(verify, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "1 file verified without error" in done.stdout + done.stderr


KILLED = """
import os, runpy, signal, sys
from pathlib import Path
from semviz.recording.writer import RunWriter
made_up = runpy.run_path(sys.argv[1])
semantic_map = made_up["make_map"](length_m=60.0)
writer = RunWriter(Path(sys.argv[2]), made_up["make_info"]("a run"), semantic_map)
for record in made_up["make_records"](semantic_map, 7, made_up["make_jpeg"]()):
    writer.write(record)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_run_keeps_every_frame_written(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    done = subprocess.run([sys.executable, "-c", KILLED, str(BENCH), str(path)], check=False)
    assert done.returncode == -signal.SIGKILL
    run = load_run(path)
    assert not run.complete
    assert run.note == "This run was interrupted after frame 6; 7 frames are readable."
    assert_same(run.frames, tuple(make_records(7, JPEG)))


def test_a_run_that_raised_is_not_complete(tmp_path: Path) -> None:
    def fail() -> None:
        with RunWriter(tmp_path / "run.rrd", INFO, MAP) as writer:
            writer.write(make_records(1)[0])
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    run = load_run(tmp_path / "run.rrd")
    assert (run.complete, len(run.frames)) == (False, 1)


@pytest.mark.parametrize("share", [0.5, 0.8])
def test_of_a_cut_run_the_whole_frames_are_read(tmp_path: Path, share: float) -> None:
    written = make_records(10, JPEG)
    path = write_run(tmp_path / "run.rrd", written)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    run = load_run(path)
    assert not run.complete
    assert 10 * share - 3 < len(run.frames) < 10
    assert_same(run.frames, tuple(written[: len(run.frames)]))


def no_file(path: Path) -> None:
    pass


def text_file(path: Path) -> None:
    path.write_text("not a recording")


def stub(path: Path) -> None:
    path.write_bytes(write_run(path, make_records(1)).read_bytes()[:200])


def foreign_recording(path: Path) -> None:
    import rerun as rr

    with rr.RecordingStream("another program") as stream:
        stream.save(path)
        stream.log("hello", rr.TextLog("hello"))


def newer_run(path: Path) -> None:
    import pyarrow as pa
    import rerun as rr

    with rr.RecordingStream(layout.APPLICATION) as stream:
        stream.save(path)
        columns = Columns()
        columns.add(layout.INFO, "version", pa.array([99]))
        columns.send(stream)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (no_file, "no such run"),
        (text_file, "not an .rrd file"),
        (stub, "not a run of semviz"),
        (foreign_recording, "not a run of semviz"),
        (newer_run, "run version 99, this semviz reads up to 1"),
    ],
)
def test_bad_files_are_named_in_one_line(
    tmp_path: Path, make: Callable[[Path], None], message: str
) -> None:
    path = tmp_path / "bad.rrd"
    make(path)
    with pytest.raises(SemvizError, match=message) as caught:
        load_run(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_path_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SemvizError, match="cannot be written"):
        RunWriter(tmp_path / "file" / "run.rrd", INFO, MAP)
