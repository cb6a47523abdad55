"""Latency of the paper's matcher on one core, in NumPy and in torch, and of all methods on frames
of the same sizes.

    OMP_NUM_THREADS=1 python bench/paper_latency.py

Weights are untrained, which does not change the time of the network. Each runtime has its own
process; its memory is the growth from before the import to after the last frame. Times are
processor times.
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from time import process_time

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.localization.localizer import Localizer
from semviz_core.localization.matched import localize_matches
from semviz_core.research.evaluation.problems import CAMERA

SIZES = ((10, 40), (30, 100), (100, 400))
RUNTIMES = ("NumPy", "torch")
METHODS = ("search", "direct", "paper")
REPEATED = 30
Run = Callable[[FloatArray, FloatArray], object]


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        weights = _fresh_weights(Path(name))
        _print_runtimes(weights)
        _print_methods(weights)


def _fresh_weights(folder: Path) -> Path:
    """Of the paper's model."""
    import torch

    from semviz_core.base.weights import NetworkWeights
    from semviz_core.research.paper.training import make_task

    torch.manual_seed(0)
    task = make_task("paper", None)
    tensors = {name: value.numpy() for name, value in task.network.state_dict().items()}
    path = folder / "paper.safetensors"
    NetworkWeights("paper", task.options, tensors).save(path)
    return path


def _print_runtimes(weights: Path) -> None:
    """Both streams, ms; best of REPEATED. A process of its own for each."""
    print("both streams of the network, ms (best of 30)")
    print(f"{'':14}" + "".join(f"{size!s:>12}" for size in SIZES) + f"{'import s':>12}{'MB':>8}")
    for runtime in RUNTIMES:
        command = [sys.executable, __file__, runtime, str(weights)]
        ended = subprocess.run(command, capture_output=True, text=True, check=True)
        told = json.loads(ended.stdout)
        print(
            f"{runtime:14}"
            + "".join(f"{value:12.2f}" for value in told["ms"])
            + f"{told['import_s']:12.2f}{told['mb']:8.0f}"
        )


def measure_runtime(runtime: str, weights: Path) -> None:
    """As JSON, in this process."""
    before, start = _resident_mb(), process_time()
    run = {"NumPy": _in_numpy, "torch": _in_torch}[runtime](weights)
    import_s = process_time() - start
    rng = np.random.default_rng(0)
    times = []
    for m, n in SIZES:
        frame = rng.normal(size=(m, 10)), rng.normal(size=(n, 10))
        times.append(_best_ms(lambda frame=frame: run(*frame)))
    print(json.dumps({"ms": times, "import_s": import_s, "mb": _resident_mb() - before}))


def _in_numpy(weights: Path) -> Run:
    from semviz_core.base.weights import read_weights
    from semviz_core.research.paper.matcher import graph_features

    tensors = read_weights(weights).tensors
    return lambda seen, mapped: [
        graph_features(tensors, "seen", array.astype(np.float32), 4) for array in (seen, mapped)
    ]


def _in_torch(weights: Path) -> Run:
    import torch

    from semviz_core.research.paper.matcher import MODELS
    from semviz_core.research.paper.matcher_torch import GraphMatcher

    torch.set_num_threads(1)
    stream = GraphMatcher(MODELS["paper"], 4).eval().seen

    def run(seen: FloatArray, mapped: FloatArray) -> None:
        with torch.inference_mode():
            for elements in (seen, mapped):
                stream(
                    torch.from_numpy(elements[None]).float(), torch.ones(1, len(elements)).bool()
                )

    return run


def _print_methods(weights: Path) -> None:
    print("\na whole frame, ms (best of 30)")
    for m, n in SIZES:
        frame = _frame(m, n)
        for method in METHODS:
            localizer = Localizer(method, weights=weights if method == "paper" else None)
            found = localizer.localize(*frame)
            total = _best_ms(lambda method=localizer, frame=frame: method.localize(*frame))
            print(f"{(m, n)!s:12}{method:22}{total:10.2f}  {found.status}")
        observed, submap, camera, _ = frame
        given = observed, submap, camera, np.column_stack([np.arange(m)] * 2), np.ones(m)
        total = _best_ms(lambda given=given: localize_matches(*given, method="p3p"))
        print(f"{(m, n)!s:12}{'p3p with true pairs':22}{total:10.2f}")


def _frame(m: int, n: int) -> tuple[Elements2D, Elements3D, Camera, Prior]:
    """m elements seen of n mapped ones about a camera, three quarters of them poles."""
    rng = np.random.default_rng(0)
    depth = rng.uniform(6.0, 40.0, m)
    ahead = np.column_stack([depth * rng.uniform(-0.7, 0.7, m), -depth, np.zeros(m)])
    around = rng.uniform(-50.0, 50.0, (n - m, 3))
    ground = np.concatenate([ahead, around]) * [1.0, 1.0, 0.0]
    pole = rng.random(n) < 0.75
    top = ground + np.column_stack([np.zeros((n, 2)), rng.uniform(2.0, 4.0, n)])
    class_id = np.where(pole, 0, rng.integers(1, 4, n))
    submap = Elements3D.from_ends(range(n), top, np.where(pole[:, None], ground, np.nan), class_id)
    R = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
    T_camera_map = Pose(R, -R @ [0.0, 0.0, 1.65])
    pixels = [CAMERA.project(T_camera_map.apply(point[:m])) for point in (top, ground)]
    pixels[1] = np.where(pole[:m, None], pixels[1], np.nan)
    observed = Elements2D.from_ends(*pixels, class_id[:m])
    prior = Prior(np.array([5.0, 5.0, 1.65]), up_camera=R[:, 2])
    return observed, submap, CAMERA, prior


def _best_ms(action: Callable[[], object]) -> float:
    times = []
    for _ in range(REPEATED):
        start = process_time()
        action()
        times.append((process_time() - start) * 1e3)
    return min(times)


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


if __name__ == "__main__":
    if len(sys.argv) > 1:
        measure_runtime(sys.argv[1], Path(sys.argv[2]))
    else:
        main()
