"""Time and size of recording a run: python bench/recording.py [FRAMES]

Frames are made up but typical: 20 detections, a submap of some 120 elements, a 1241x376 image.
"""

import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from semviz.recording.reader import load_run
from semviz.recording.run import FrameRecord, RunInfo
from semviz.recording.writer import RunWriter
from semviz_core.camera import Camera, Rig
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.frame import Frame, Prior
from semviz_core.localization import Alternative, Localization, Match, Refinement, Search
from semviz_core.pose import Pose
from semviz_core.semantic_map import MapFrame, SemanticMap

CAMERA = Camera(1241, 376, np.array([[718.9, 0, 607.2], [0, 718.9, 185.2], [0, 0, 1]]))
LOOKING_ALONG_X = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""Rotation of T_map_camera for a camera that looks along the map's x axis."""


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


def make_jpeg() -> bytes:
    """A noisy picture that is as large as a real one: about 130 kB."""
    import cv2

    noise = np.random.default_rng(0).integers(60, 190, (94, 311, 3), dtype=np.uint8)
    image = cv2.resize(noise, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_CUBIC)
    return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes())


def main() -> None:
    frames = int(sys.argv[1]) if len(sys.argv) > 1 else 300
    semantic_map = make_map()
    print(f"{'':14}{'write':>10}{'p95':>10}{'CPU':>10}{'size':>14}{'open':>10}")
    for name, image in (("without image", None), ("with image", make_jpeg())):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "run.rrd")
            took, cpu = [], 0.0
            with RunWriter(path, make_info("bench"), semantic_map) as writer:
                for record in make_records(semantic_map, frames, image):
                    start, busy = time.perf_counter(), time.process_time()
                    writer.write(record)
                    cpu += 1e3 * (time.process_time() - busy)
                    took.append(1e3 * (time.perf_counter() - start))
            start = time.perf_counter()
            load_run(path)
            opened = time.perf_counter() - start
            kilobytes = path.stat().st_size / frames / 1e3
        median, p95 = np.percentile(took, [50, 95])
        print(
            f"{name:14}{median:7.2f} ms{p95:7.2f} ms{cpu / frames:7.2f} ms"
            f"{kilobytes:8.1f} kB/fr{opened:8.2f} s"
        )


if __name__ == "__main__":
    main()
