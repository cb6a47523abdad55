"""Time and size of recording a run, part by part.

    OMP_NUM_THREADS=1 taskset -c 0 python bench/recording.py [RUN.rrd]

Without a run, frames are synthetic and rather large: 20 detections, a submap of about 120 elements,
and one image of 1241x376. Frames are written twelve times; the fastest repetition of each frame
counts. Figures are means over the frames; CPU times are of all threads.

What checksums cost is measured by leaving out those of every other frame, in 60 pairs of runs, so
that each frame is written both ways: median and quartiles over the pairs, of CPU time. Images are
encoded within that time.
"""

import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import wraps
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from semviz.runs import rerun_plots, writer
from semviz.runs.codec import decode, row_checksum
from semviz.runs.codec import encode as encode_value
from semviz.runs.columns import Columns
from semviz.runs.images import JPEG_QUALITY
from semviz.runs.reader import load_run
from semviz.runs.run import FrameRecord, Run, RunInfo
from semviz.runs.writer import RunWriter
from semviz_core.base.camera import Camera, Rig
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Frame, Prior
from semviz_core.base.localization import Alternative, Localization, Match, Refinement, Search
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.common.arrays import ByteImage, FloatArray

CAMERA = Camera(1241, 376, np.array([[718.9, 0, 607.2], [0, 718.9, 185.2], [0, 0, 1]]))
LOOKING_ALONG_X = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""Rotation of T_map_camera for a camera that looks along the map's x axis."""
REPETITIONS = 12
PAIRS = 60


def make_info(name: str) -> RunInfo:
    rig = Rig(CAMERA, CAMERA, Pose(np.eye(3), np.array([-0.54, 0, 0])))
    return RunInfo(
        name=name,
        workspace="",
        method="search",
        seed=1,
        version="0",
        created="2026-01-01T00:00:00Z",
        rig=rig,
        map_name="made up",
        observations="a made-up detector",
        options={"prior_distance_m": [5.0, 10.0], "crop_radius_m": 50.0},
    )


def make_map(seed: int = 0, length_m: float = 400.0) -> SemanticMap:
    """Poles and signs on both sides of a straight road along x."""
    rng = np.random.default_rng(seed)
    n = int(length_m / 0.9)
    side = rng.choice([-1.0, 1.0], n)
    foot = np.stack([rng.uniform(0, length_m, n), side * rng.uniform(4.5, 12, n), np.zeros(n)], 1)
    kind = rng.choice(4, n, p=[0.55, 0.15, 0.15, 0.15])
    peak = foot + np.stack([np.zeros(n), np.zeros(n), rng.uniform(2, 7, n)], axis=1)
    end = np.where((kind == 0)[:, None], foot, np.nan)
    road = np.stack([np.linspace(0, length_m, 200), np.zeros(200), np.full(200, 1.65)], axis=1)
    elements = Elements3D.from_ends(np.arange(1, n + 1), peak, end, kind)
    return SemanticMap(elements, MapFrame("made-up"), trajectory_m=road)


def make_records(
    semantic_map: SemanticMap, frames: int, image: bytes | None, seed: int = 0
) -> Iterator[FrameRecord]:
    """A drive along the road in which every tenth frame cannot and every seventh is ambiguous."""
    rng = np.random.default_rng(seed)
    for index in range(frames):
        truth = Pose(LOOKING_ALONG_X, np.array([index * 1.0, 0.3 * np.sin(index / 5), 1.65]))
        error = Pose.exp(np.concatenate([rng.normal(0, 0.08, 3), rng.normal(0, 0.003, 3)]))
        status = "cannot" if index % 10 == 9 else "ambiguous" if index % 7 == 6 else "ok"
        result = _localization(semantic_map, truth, error @ truth.inverse(), status, rng)
        ids = result.submap.id[result.match.order[:, 1]] if result.match else np.zeros(0, int)
        yield FrameRecord(Frame(index, index / 10, truth), result, ids, image)


def _localization(
    semantic_map: SemanticMap, truth: Pose, estimate: Pose, status: str, rng: np.random.Generator
) -> Localization:
    submap = semantic_map.crop(truth.translation, 50.0)
    anchor = CAMERA.project(truth.inverse().apply(submap.anchor_m))
    end = CAMERA.project(truth.inverse().apply(submap.end_m))
    columns = np.flatnonzero(CAMERA.contains(anchor) & (CAMERA.contains(end) | ~submap.is_line))
    columns = columns[:20]
    m, n = len(columns), len(submap)
    observed = Elements2D.from_ends(
        anchor[columns] + rng.normal(0, 1, (m, 2)),
        end[columns] + rng.normal(0, 1, (m, 2)),
        submap.class_id[columns],
    )
    probability = rng.dirichlet(np.full(n + 1, 0.05), m + 1)
    probability[np.arange(m), columns] += 1.0
    pairs = np.stack([np.arange(m), columns], axis=1)
    cannot = status == "cannot"
    other = Pose.exp(np.array([2.0, 0, 1.0, 0, 0.05, 0])) @ estimate
    return Localization(
        method="search",
        camera=CAMERA,
        prior=Prior(
            truth.translation + rng.normal(0, 4, 3) * [1, 1, 0], up_camera=np.array([0, -1.0, 0])
        ),
        observed=observed,
        submap=submap,
        status=status,
        reason={
            "ok": f"{m} of {m} elements matched.",
            "ambiguous": "Two poses fit: costs 11.2 and 12.0, 1.9 m apart.",
            "cannot": "3 elements seen, 4 needed.",
        }[status],
        T_camera_map=None if cannot else estimate,
        covariance=None if cannot else np.diag([0.01, 0.01, 0.04, 1e-5, 1e-5, 1e-5]),
        match=Match(
            rng.normal(size=(m, n)), probability / probability.sum(1, keepdims=True), pairs
        ),
        search=Search(900, (estimate, other), np.array([-11.2, -12.0])),
        refinement=None
        if cannot
        else Refinement(
            pairs, rng.normal(0, 1, (m, 2)), rng.chisquare(2, m), np.ones(m, bool), np.ones(6)
        ),
        alternatives=(Alternative(other, -12.0),) if status == "ambiguous" else (),
        time_ms={"match": 1.5, "search": 22.0, "refine": 4.0},
    )


def make_image() -> ByteImage:
    """A noisy picture whose JPEG is as large as a real one's: about 130 kB."""
    import cv2

    noise = np.random.default_rng(0).integers(60, 190, (94, 311, 3), dtype=np.uint8)
    size = (CAMERA.width, CAMERA.height)
    return np.asarray(cv2.resize(noise, size, interpolation=cv2.INTER_CUBIC), np.uint8)


def encode(image: ByteImage) -> bytes:
    import cv2

    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    return cv2.imencode(".jpg", image, quality)[1].tobytes()


def make_jpeg() -> bytes:
    return encode(make_image())


class Watch:
    """Adds up the CPU time of parts of the work; a part within another counts only for itself."""

    def __init__(self) -> None:
        self.ms: dict[str, float] = {}
        self._running: list[str] = []
        self._since = 0.0

    def of(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, watched."""

        @wraps(function)
        def watched(*arguments: Any, **named: Any) -> Any:
            self._change(lambda: self._running.append(part))
            try:
                return function(*arguments, **named)
            finally:
                self._change(self._running.pop)

        return watched

    def _change(self, change: Callable[[], object]) -> None:
        now = time.process_time()
        if self._running:
            part = self._running[-1]
            self.ms[part] = self.ms.get(part, 0.0) + 1e3 * (now - self._since)
        change()
        self._since = time.process_time()


def watched_parts(watch: Watch) -> ExitStack:
    """The parts of ``RunWriter.write``, watched while the context lasts."""
    parts: Sequence[tuple[str, object, str]] = (
        ("diagnosis", rerun_plots, "diagnosis_name"),
        ("diagnosis", rerun_plots, "frame_diagnosis"),
        ("drawing", writer.RerunScene, "draw"),
        ("checksums", writer, "row_checksum"),
        ("exact numbers", writer, "_add_exact"),
        ("to rerun", Columns, "send"),
        ("to the system (flush)", RunWriter, "_flush"),
        ("rest", RunWriter, "write"),
    )
    stack = ExitStack()
    for part, owner, name in parts:
        stack.enter_context(mock.patch.object(owner, name, watch.of(part, getattr(owner, name))))
    return stack


@dataclass(frozen=True)
class Written:
    """One frame, written once."""

    wall_ms: float
    parts_ms: dict[str, float]
    """CPU time, by part."""


def anew(record: FrameRecord) -> FrameRecord:
    """The same frame without what is remembered of it: its diagnosis, its poses' inverses."""
    made = decode(FrameRecord, *encode_value(replace(record, image=None)))
    return replace(made, image=record.image)


def write_all(path: Path, run: Run) -> list[Written]:
    """The run's frames, each measured."""
    watch, measured = Watch(), []
    with RunWriter(path, run.info, run.semantic_map) as writing, watched_parts(watch):
        for frame in run.frames:
            new = anew(frame)
            watch.ms = {}
            start = time.perf_counter()
            writing.write(new)
            measured.append(Written(1e3 * (time.perf_counter() - start), watch.ms))
    return measured


def measure(run: Run) -> None:
    """Write the run again and again, and print what it took."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "run.rrd")
        repetitions = [write_all(path, run) for _ in range(REPETITIONS)]
        start = time.perf_counter()
        load_run(path)
        opened_s = time.perf_counter() - start
        kilobytes = path.stat().st_size / len(run.frames) / 1e3
    frames = list(zip(*repetitions, strict=True))
    least = [min(same, key=lambda sample: sample.wall_ms) for same in frames]
    for part in sorted({part for sample in least for part in sample.parts_ms}):
        print(
            f"  {part:24}"
            f"{np.mean([sample.parts_ms.get(part, 0.0) for sample in least]):6.2f} ms CPU"
        )
    wall_ms = [sample.wall_ms for sample in least]
    median, p95 = np.percentile(wall_ms, [50, 95])
    print(f"  {'all':24}{np.mean(wall_ms):6.2f} ms; median {median:.2f} ms, p95 {p95:.2f} ms")
    usual_ms = np.median([sample.wall_ms for same in frames for sample in same])
    print(f"  with whatever else the machine did: median {usual_ms:.2f} ms")
    print(f"  {kilobytes:.1f} kB a frame; {len(run.frames)} frames open in {opened_s:.2f} s")


def no_checksum(*row: object) -> int:
    """In place of ``row_checksum``."""
    return 0


def frames_cpu_s(path: Path, run: Run, first: int) -> FloatArray:
    """CPU time of all threads for all frames (2,): every other one, from ``first`` on, without its
    checksum; then the rest."""
    frames, took_s = [anew(frame) for frame in run.frames], np.zeros(2)
    picture = make_image()
    with RunWriter(path, run.info, run.semantic_map) as writing:
        for number, frame in enumerate(frames, first):
            has_checksum = number % 2
            function = row_checksum if has_checksum else no_checksum
            with mock.patch.object(writer, "row_checksum", function):
                start = time.process_time()
                image = None if frame.image is None else encode(picture)
                writing.write(replace(frame, image=image))
                took_s[has_checksum] += time.process_time() - start
    return took_s


def measure_checksums(run: Run) -> None:
    """Print by how much checksums raise the CPU time of recording."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "run.rrd")
        frames_cpu_s(path, run, 0)  # imports, caches
        pairs_s = [frames_cpu_s(path, run, 0) + frames_cpu_s(path, run, 1) for _ in range(PAIRS)]
    without_s, with_s = np.array(pairs_s).T
    cost = 100.0 * (with_s / without_s - 1.0)
    again = np.random.default_rng(0).choice(cost, (4000, PAIRS))
    low, high = np.percentile(np.median(again, axis=1), [2.5, 97.5])
    quartiles = np.percentile(cost, [25, 50, 75])
    print(
        f"  checksums cost {quartiles[1]:.1f} % of CPU time (95 %: {low:.1f} to {high:.1f};", end=""
    )
    print(f" quartiles {quartiles[0]:.1f} and {quartiles[2]:.1f}; {PAIRS} pairs)")


def encode_images(count: int = 50) -> None:
    """JPEG encoding by itself, which recording needs for embedded images."""
    took_ms = []
    image = make_image()
    for _ in range(count):
        start = time.perf_counter()
        encode(image)
        took_ms.append(1e3 * (time.perf_counter() - start))
    print(f"JPEG encoding, the least of {count}: {min(took_ms):.2f} ms")


def main() -> None:
    if sys.argv[1:]:
        run = load_run(sys.argv[1])
    else:
        semantic_map = make_map()
        frames = tuple(make_records(semantic_map, 60, make_jpeg()))
        run = Run(make_info("bench"), semantic_map, frames)
    encode_images()
    for title, image in (("without images", None), ("with the left image", make_jpeg())):
        frames = tuple(replace(frame, image=image, image_right=None) for frame in run.frames)
        print(f"{title}, a frame:")
        measure(replace(run, frames=frames))
        measure_checksums(replace(run, frames=frames))


if __name__ == "__main__":
    main()
