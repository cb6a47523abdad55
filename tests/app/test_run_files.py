"""Runs come back from their files bit for bit, whatever happened to the file."""

import gzip
import runpy
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from equality import assert_same
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from semviz.runs import codec, rerun_plots, rerun_scene
from semviz.runs import run as layout
from semviz.runs.codec import decode, encode
from semviz.runs.columns import Columns
from semviz.runs.diagnosis import STARTING_OR_LOST
from semviz.runs.reader import load_run
from semviz.runs.run import FrameRecord, Run
from semviz.runs.writer import RunWriter
from semviz_core.base.camera import Camera
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Frame, Prior
from semviz_core.base.localization import Alternative, Localization, Match, Refinement, Search
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import Decision, SemanticMap
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.diagnosis.fault import FaultKind

BENCH = Path(__file__).parents[2] / "bench" / "recording.py"
VERSION_2 = Path(__file__).parent / "data" / "run-version-2.rrd.gz"
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


def odd(rng: np.random.Generator, *shape: int) -> FloatArray:
    """Numbers of which every second is one that files lose easily."""
    values = rng.normal(size=shape) * 10.0 ** rng.integers(-300, 300, shape)
    rare = np.array([np.nan, -np.nan, np.inf, -np.inf, -0.0, 5e-324, 0.1 + 0.2])
    return np.where(rng.random(shape) < 0.5, rng.choice(rare, shape), values)


scalars = st.floats(allow_nan=False) | st.just(float("nan"))  # JSON does not keep the sign of a NaN


names = st.lists(st.text(max_size=9), max_size=3).map(tuple)
decisions = st.builds(
    Decision,
    kind=st.sampled_from(["merge", "apart", "split", "leave out"]),
    label_ids=names,
    numbers=st.lists(st.integers(1, 2**31), max_size=3).map(tuple),
    by=st.sampled_from(["machine", "human"]),
    reason=st.text(),
    evidence=st.dictionaries(st.text(max_size=9), scalars, max_size=3),
    observation_ids=names,
)


def some_pose(rng: np.random.Generator) -> Pose:
    return Pose.from_rotvec(rng.normal(size=3), rng.normal(size=3) * 100)


def some_elements(rng: np.random.Generator, m: int, n: int) -> tuple[Elements2D, Elements3D]:
    line, mapped_line = rng.random(m) < 0.5, rng.random(n) < 0.5
    seen, mapped = rng.random(m) < 0.5, rng.random(n) < 0.5
    end = np.where(line[:, None], rng.normal(size=(m, 2)) * 400, np.nan)
    mapped_end = np.where(mapped_line[:, None], rng.normal(size=(n, 3)) * 40, np.nan)
    kinds, ids = rng.integers(0, 4, m), rng.choice(2**62, n, replace=False)
    anchor, mapped_anchor = rng.normal(size=(m, 2)) * 400, rng.normal(size=(n, 3)) * 40
    observed = Elements2D(
        anchor, end, kinds, rng.random(m), rng.random((m, 2)) + 0.1, seen, seen & line
    )
    covariance, mapped_kinds = rng.random((n, 6, 6)), rng.integers(0, 4, n)
    submap = Elements3D(
        ids, mapped_anchor, mapped_end, mapped_kinds, covariance, mapped, mapped & mapped_line
    )
    return observed, submap


def some_search(rng: np.random.Generator, poses: tuple[Pose, ...], m: int) -> Search:
    tried, passed = rng.integers(2**50, size=2).tolist()
    score, mapped = odd(rng, len(poses)), rng.integers(-1, 5, (len(poses), m))
    old = rng.random() < 0.3
    return Search(tried, poses, score) if old else Search(tried, poses, score, passed, mapped)


def some_refinement(rng: np.random.Generator, pairs: IntArray) -> Refinement:
    k = len(pairs)
    steps = None if rng.random() < 0.3 else odd(rng, 2, 2)
    fit = odd(rng, k, 2), odd(rng, k), rng.random(k) < 0.5
    return Refinement(pairs, *fit, cost_trace=odd(rng, 3), steps=steps)


@st.composite
def records(draw: st.DrawFn, index: int) -> FrameRecord:
    """Any frame: stages there or not, nothing seen, nothing mapped, numbers of all kinds."""
    has = lambda: draw(st.booleans())  # noqa: E731
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    m, n = draw(st.integers(0, 5)), draw(st.integers(0, 5))
    status = draw(st.sampled_from(["ok", "ambiguous", "cannot"]))
    observed, submap = some_elements(rng, m, n)
    k = draw(st.integers(0, min(m, n)))
    pairs = np.stack([rng.permutation(m)[:k], rng.permutation(n)[:k]], axis=1)
    poses = tuple(some_pose(rng) for _ in range(draw(st.integers(0, 3))))
    up = np.array([0.0, -1.0, 0.0])
    result = Localization(
        method=draw(st.text()),
        camera=Camera(1241, 376, made_up["CAMERA"].K, rng.normal(0, 0.01, 4) if has() else []),
        prior=Prior(
            rng.normal(size=3),
            up_camera=up if has() else None,
            heading_rad=float(rng.normal()) if has() else None,
            road_m=rng.normal(size=(3, 3)) * 100 if has() else None,
        ),
        observed=observed,
        submap=submap,
        status=status,
        reason=draw(st.text(min_size=1)),
        T_camera_map=None if status == "cannot" else some_pose(rng),
        covariance=odd(rng, 6, 6) if has() else None,
        match=Match(odd(rng, m, n), rng.random((m + 1, n + 1)), pairs) if has() else None,
        search=some_search(rng, poses, m) if has() else None,
        refinement=some_refinement(rng, pairs) if has() else None,
        alternatives=tuple(Alternative(pose, draw(scalars)) for pose in poses),
        time_ms=draw(st.dictionaries(st.text(min_size=1), scalars, max_size=3)),
    )
    frame = Frame(index, draw(st.floats(0, 1e6)), some_pose(rng) if has() else None)
    element_id = rng.integers(-(2**63), 2**63 - 1, m)
    return FrameRecord(frame, result, element_id, JPEG if has() else None)


@given(st.integers(0, 9).flatmap(records))
@settings(max_examples=60)
def test_codec_gives_back_every_bit(record: FrameRecord) -> None:
    record = replace(record, image=None)
    structure, pools = encode(record)
    assert_same(decode(FrameRecord, structure, pools), record)


@given(st.lists(decisions, max_size=4))
def test_codec_gives_back_what_was_decided(decided: list[Decision]) -> None:
    semantic_map = replace(MAP, decisions=tuple(decided))
    assert_same(decode(SemanticMap, *encode(semantic_map)), semantic_map)


def test_a_run_keeps_what_was_decided_when_its_map_was_built(tmp_path: Path) -> None:
    decision = Decision("merge", ("a", "b"), (3, 9), "machine", "Near.", {"distance_m": 0.1 + 0.2})
    decided = replace(
        MAP, decisions=(decision, replace(decision, kind="apart", by="human", evidence={}))
    )
    with RunWriter(tmp_path / "run.rrd", INFO, decided):
        pass
    assert_same(load_run(tmp_path / "run.rrd"), Run(INFO, decided, ()))


def test_codec_refuses_another_dtype() -> None:
    with pytest.raises(TypeError, match="float64 is expected here, not float32"):
        encode(Search(1, (), np.zeros(0, np.float32)))  # type: ignore[arg-type]


@given(st.tuples(records(3), records(4), records(8)))
@settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_run_comes_back_bit_for_bit(tmp_path: Path, written: tuple[FrameRecord, ...]) -> None:
    run = load_run(write_run(tmp_path / "run.rrd", list(written)))
    assert_same(run, Run(INFO, MAP, written))


def test_a_run_of_version_1_opens_without_the_road(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its priors said nothing of ``road_m``, which the writer is made to leave out."""
    written = make_records(2)
    kind = codec._kind

    def kind_of_version_1(hint: Any) -> tuple[str, Any]:
        name, inner = kind(hint)
        return name, tuple(
            member for member in inner if member[0] != "road_m"
        ) if hint is Prior else inner

    with monkeypatch.context() as patch:
        patch.setattr(codec, "_kind", kind_of_version_1)
        patch.setattr(layout, "FORMAT_VERSION", 1)
        path = write_run(tmp_path / "run.rrd", written)
        patch.setattr(layout, "FORMAT_VERSION", 0)
        with pytest.raises(SemvizError, match="run version 1; this semviz reads up to 0"):
            load_run(path)
    (frame, _) = load_run(path).frames
    assert frame.localization.prior.road_m is None
    assert_same(frame, written[0])


def test_a_run_that_version_2_wrote_opens(tmp_path: Path) -> None:
    """Written by semviz before it knew images of both cameras; what was drawn is left out."""
    path = tmp_path / "run.rrd"
    path.write_bytes(gzip.decompress(VERSION_2.read_bytes()))
    run = load_run(path)
    assert (run.info.name, run.info.images, run.complete) == ("version 2", "embedded", True)
    assert len(run.semantic_map) == 13
    first, second = run.frames
    assert first.image == second.image
    assert first.image is not None
    assert first.image.startswith(b"\xff\xd8")
    assert (first.image_right, first.image_file) == (None, "")
    assert [localization.status for localization in run.localizations] == ["ok", "ok"]
    pose, truth = first.localization.T_camera_map, run.truths[0]
    assert pose is not None
    assert truth is not None
    assert np.abs((pose @ truth.inverse()).log()).max() < 0.3, "numbers are read in another order"
    assert first.localization.match is not None
    assert_allclose(first.localization.match.probability.sum(axis=1), 1.0)


def test_a_run_of_no_frames(tmp_path: Path) -> None:
    assert_same(load_run(write_run(tmp_path / "run.rrd", [])), Run(INFO, MAP, ()))


def drawn_frames(path: Path, entity: str) -> list[int]:
    """Of which frames rerun is shown something in an entity."""
    from rerun.chunk import RrdReader

    chunks = RrdReader(path).stream().filter(content=[f"+ {entity}"])
    return sorted(
        frame
        for batch in (chunk.to_record_batch() for chunk in chunks)
        if "frame" in batch.schema.names
        for frame in batch["frame"].to_pylist()
    )


@pytest.mark.parametrize("frames", [1, 20, 23])
def test_every_frame_is_drawn(tmp_path: Path, frames: int) -> None:
    path = write_run(tmp_path / "run.rrd", make_records(frames))
    for entity in (rerun_plots.DIAGNOSES, rerun_scene.HERE, f"{layout.IMAGE}/observed"):
        assert drawn_frames(path, entity) == list(range(frames)), entity


def test_every_diagnosis_has_a_color() -> None:
    assert set(rerun_plots.DIAGNOSIS_COLORS) == {*get_args(FaultKind), STARTING_OR_LOST}


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
from semviz.runs.writer import RunWriter
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
    import rerun as rr

    with rr.RecordingStream(layout.APPLICATION) as stream:
        stream.save(path)
        columns = Columns()
        columns.add(layout.INFO, "version", np.array([99]))
        columns.send(stream)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (no_file, "no such run"),
        (text_file, "not an .rrd file"),
        (stub, "not a run of semviz"),
        (foreign_recording, "not a run of semviz"),
        (newer_run, f"run version 99; this semviz reads up to {layout.FORMAT_VERSION}"),
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
