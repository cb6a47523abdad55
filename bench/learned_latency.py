"""How long the paper's matcher takes on one core, in NumPy and in torch, and how long the methods
take on frames of such sizes.

    OMP_NUM_THREADS=1 python bench/learned_latency.py

Weights are as before training, which changes no time of the network. Each runtime runs in a process
of its own; its memory is what that grew by from before the import to after the last frame. Times
are those of the processor, so that a busy machine counts little.
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from time import process_time

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.camera import Camera
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.evaluation.problems import CAMERA
from semviz_core.frame import Prior
from semviz_core.localize import Localizer
from semviz_core.pose import Pose
from semviz_core.solving.matched import localize_matches

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

    from semviz_core.learning.paper_task import make_task
    from semviz_core.learning.weights import Weights

    torch.manual_seed(0)
    task = make_task("paper", None)
    tensors = {name: value.numpy() for name, value in task.network.state_dict().items()}
    path = folder / "paper.safetensors"
    Weights("paper", task.options, tensors).save(path)
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
            + "".join(f"{one:12.2f}" for one in told["ms"])
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
    from semviz_core.learning.networks.graph_numpy import graph_features
    from semviz_core.learning.weights import read_weights

    tensors = read_weights(weights).tensors
    return lambda seen, mapped: [
        graph_features(tensors, "seen", one.astype(np.float32), 4) for one in (seen, mapped)
    ]


def _in_torch(weights: Path) -> Run:
    import torch

    from semviz_core.learning.models import MODELS
    from semviz_core.learning.networks.streams import GraphMatcher

    torch.set_num_threads(1)
    stream = GraphMatcher(MODELS["paper"], 4).eval().seen

    def run(seen: FloatArray, mapped: FloatArray) -> None:
        with torch.inference_mode():
            for one in (seen, mapped):
                stream(torch.from_numpy(one[None]).float(), torch.ones(1, len(one)).bool())

    return run


def _print_methods(weights: Path) -> None:
    print("\na whole frame, ms (best of 30)")
    for m, n in SIZES:
        frame = _frame(m, n)
        for method in METHODS:
            localizer = Localizer(method, weights=weights if method == "paper" else None)
            found = localizer.localize(*frame)
            total = _best_ms(lambda one=localizer, frame=frame: one.localize(*frame))
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
    pixels = [CAMERA.project(T_camera_map.apply(one[:m])) for one in (top, ground)]
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
