"""Fuzz every reader of files: whatever a file holds, only a SemvizError may come out.

    pip install '.[fuzz]'
    python bench/fuzz.py --minutes 10                 # every reader
    python bench/fuzz.py cvat run-values --minutes 1 --grown grown     # again: goes on

Inputs grow from ``bench/corpus``, guided by coverage (atheris, libFuzzer): half of them by changes
that leave them JSON or XML, half by changes of bytes. Without atheris, the corpus is changed
without that guidance, and a line says so. A reader's first input that raises anything else, takes
more than 30 s or more than 2 GB is kept in the current folder, and the exit status is 1. Minutes
are those of the process on a core, so that they mean the same on a busy machine.
"""

import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import tests_support  # noqa: F401
import tyro
from mutations import mutated

NAMES = (
    "cvat", "labelme", "coco", "proposals", "proposals-parquet", "geojson", "lanelet2",
    "opendrive", "csv", "map", "run", "run-opened", "run-values", "poses", "calibration", "image",
    "settings", "model", "weights", "backdrop", "card", "motions", "detector-calibration",
    "segmentation", "mask", "pole-map", "camera-toml", "camera-yaml", "camera-text",
    "drive-poses", "drive-records", "drive-times", "colmap", "nerfstudio", "drive-file", "boxes",
    "box-file", "recording", "bag", "measured", "pose-choices", "map-decisions", "matches",
)  # fmt: skip
WORDS = (
    "polyline", "points", "box", "track", "image", "outside", "occluded", "group_id", "element",
    "anchor_known", "end_known", "true", "false", "null", "NaN", "1e999", "-Infinity", "0.5;1,2",
    "keypoints", "bbox", "track_id", "attributes", "shape_type", "linestrip", "rectangle", "flags",
    "<!DOCTYPE a [<!ENTITY b 'c'>]>", "&b;", "<![CDATA[", "encoding='utf-16'", "\\\\ud800", "[[[[",
    "pole", "rounded sign", "left/000001.png", "image_3/000002.png", "Feature", "Point",
    "coordinates", "LineString", "geometry", "paramPoly3", "spiral", "signalReference", "P2:",
    "cam0:", "T_BS:", "T_cam_imu", "T_cn_cnm1", "resolution: [", "distortion_model: equidistant",
    "!!opencv-matrix", "data: [", "projection_matrix", "rectification_matrix", "0x", "*a", "&a ",
    "T_right_left = ", "T_body_left = ", "[right]", "model = ", "file_path",
    "transform_matrix", "camera_model", "OPENCV_FISHEYE", "FULL_OPENCV", "SIMPLE_RADIAL",
    "transforms", "#timestamp", "{name", "**/", "..", "#c0c080", "[[rates]]", "[scores.pole]",
    "1e308", "-1e-320", "poleparams.npy", "'descr': '|O'", "(999999999,",
)  # fmt: skip
INSTRUMENTED = [
    "semviz_annotation.label_formats", "semviz_annotation.map_formats", "semviz_annotation.labels",
    "semviz_annotation.mapping.backdrop", "semviz_core.base", "semviz_core.common.limits",
    "semviz_core.datasets", "semviz.runs.codec",
    "semviz_core.detection.model_config", "semviz.runs.reader",
    "semviz.workspace.settings", "semviz.workspace.poses.pose_choices",
    "semviz.workspace.drive.drive_file", "semviz.workspace.maps.map_decisions",
    "semviz.workspace.checked_file",
    "semviz.workspace.localization.foreign_results", "semviz_core.research.evaluation",
    "semviz_core.research.training.annotated_images",
    "semviz_core.pose_checks.image_motions", "yaml", "rosbags",
]  # fmt: skip
LIMIT_S, LIMIT_MB, MOST_BYTES = 30, 2048, 8192


@dataclass(frozen=True)
class Options:
    readers: tyro.conf.Positional[tuple[str, ...]] = ()
    """Readers; default: all."""
    minutes: float = 10.0
    """For each reader, of its process on a core."""
    seed: int = 1
    grown: Path | None = None
    """A folder that keeps the inputs that reached new code; a later call goes on from them."""
    alone: bool = False
    """Fuzz one reader in this process."""
    unguided: int = 0
    """Only so many inputs of each reader, without guidance by coverage, all in this process."""


def main(options: Options) -> int:
    unknown = [name for name in options.readers if name not in NAMES]
    if unknown:
        print(f"no reader {unknown[0]!r}; there are {', '.join(NAMES)}", file=sys.stderr)
        return 2
    if options.alone:
        return fuzz(options.readers[0], 60.0 * options.minutes, options.seed, options.grown)
    if options.unguided:
        return _unguided(options)
    if find_spec("atheris") is None:
        print("atheris is not installed: the corpus is changed without guidance by coverage")
    results = [_in_process(name, options) for name in options.readers or NAMES]
    return int(any(results))


def _unguided(options: Options) -> int:
    """Fuzz the readers in this process; an error ends it."""
    for name in options.readers or NAMES:
        with tempfile.TemporaryDirectory() as folder:
            corpus, attack = _corpus(name, Path(folder, "corpus")), _attack(name, Path(folder))
            _without_guidance(corpus, attack, options.seed, lambda count: count < options.unguided)
    return 0


def _in_process(name: str, options: Options) -> int:
    """Fuzz one reader in a process of its own; print a line of a table."""
    command = [sys.executable, __file__, name, "--alone"]
    if options.grown is not None:
        command += ["--grown", str(options.grown)]
    done = subprocess.run(
        [*command, "--minutes", str(options.minutes), "--seed", str(options.seed)],
        capture_output=True,
        text=True,
        errors="replace",
    )
    count = re.findall(r"^(?:Done|stat::number_of_executed_units:) +(\d+)", done.stderr, re.M)
    cover = re.findall(r"cov: (\d+)", done.stderr)
    covered = f"{cover[-1]:>6} edges" if cover else "no coverage"
    verdict = "nothing else raised" if not done.returncode else f"FAILED ({done.returncode})"
    print(f"{name:<18} {count[-1] if count else '?':>9} inputs  {covered}  {verdict}", flush=True)
    if done.returncode:
        print(done.stdout[-2500:], done.stderr[-2500:])
    return done.returncode


def fuzz(name: str, seconds: float, seed: int, grown: Path | None = None) -> int:
    """Fuzz one reader in this process, for so long. atheris ends the process."""
    with tempfile.TemporaryDirectory() as folder_name:
        folder = Path(folder_name)
        kept = folder / "corpus" if grown is None else grown / name
        if find_spec("atheris") is None:
            corpus, attack = _corpus(name, kept), _attack(name, folder)
            stop = time.process_time() + seconds
            return _without_guidance(corpus, attack, seed, lambda _: time.process_time() < stop)
        import atheris

        with atheris.instrument_imports(include=INSTRUMENTED, exclude=_compiled_modules()):
            corpus, attack = _corpus(name, kept), _attack(name, folder)  # both import semviz
        words = folder / "words"
        quoted = (word.replace("\\", "\\\\").replace('"', '\\"') for word in WORDS)
        words.write_text("".join(f'"{word}"\n' for word in quoted))
        most = max(MOST_BYTES, *(2 * path.stat().st_size for path in corpus.iterdir()))
        limits = [f"-max_len={most}", f"-timeout={LIMIT_S}", f"-rss_limit_mb={LIMIT_MB}"]
        choice = [f"-seed={seed}", f"-dict={words}"]
        failed = f"-artifact_prefix={Path.cwd() / name}-"
        arguments = [sys.argv[0], *choice, *limits, failed, "-print_final_stats=1", str(corpus)]

        def mutate(data: bytes, most_bytes: int, number: int) -> bytes:
            rng = random.Random(number)
            if rng.random() < 0.5:
                return bytes(atheris.Mutate(data, most_bytes))
            return mutated(data, rng)[:most_bytes]

        stop = time.process_time() + seconds

        def attack_in_time(data: bytes) -> None:
            if time.process_time() > stop:
                os.kill(os.getpid(), signal.SIGUSR1)  # libFuzzer ends after this input
            attack(data)

        atheris.Setup(arguments, attack_in_time, custom_mutator=mutate)
        atheris.Fuzz()
    return 0


def _compiled_modules() -> list[str]:
    """Return the modules that numba compiles: it cannot compile what atheris changed."""
    roots = (Path(__file__).parents[1] / layer for layer in ("core", "annotation"))
    files = ((root, path) for root in roots for path in root.rglob("*.py"))
    return [
        ".".join(path.relative_to(root).with_suffix("").parts)
        for root, path in files
        if "semviz_core.common.jit" in (text := path.read_text()) or "common import jit" in text
    ]


def _corpus(name: str, corpus: Path) -> Path:
    """Return the folder with the seeds of a reader, which may be added to."""
    corpus.mkdir(parents=True, exist_ok=True)
    for path in (Path(__file__).parent / "corpus" / name).glob("*"):
        (corpus / path.name).write_bytes(path.read_bytes())
    if name in ("run", "run-opened", "recording", "bag"):
        from fuzz_corpus import write_bags, write_recordings, write_run

        if name in ("run", "run-opened"):
            write_run(corpus / "small.rrd")
        else:
            {"recording": write_recordings, "bag": write_bags}[name](corpus)
    return corpus


def _attack(name: str, folder: Path) -> Callable[[bytes], None]:
    """Return a function that has ``data`` read, and raises unless that ends as it may."""
    from fuzz_readers import READERS

    from semviz_core.common.errors import SemvizError

    reader = READERS[name]
    path = folder / reader.file

    def attack(data: bytes) -> None:
        path.write_bytes(data)
        try:
            reader.read(path)
        except SemvizError as error:
            line = str(error)
            line.encode()  # what the terminal does
            assert "\n" not in line, line
            assert len(line) < 2000, line

    return attack


def _most_memory_kb() -> int:
    """Return the peak of this program; getrusage keeps that of the process that started it."""
    found = re.search(r"VmHWM:\s*(\d+)", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1])


def _without_guidance(
    corpus: Path, attack: Callable[[bytes], None], seed: int, goes_on: Callable[[int], bool]
) -> int:
    """Change the corpus as long as ``goes_on`` says of the number of inputs."""
    rng, seeds = random.Random(seed), [path.read_bytes() for path in sorted(corpus.iterdir())]
    count = 0
    while goes_on(count):
        data = mutated(rng.choice(seeds), rng)
        started = time.monotonic()
        try:
            attack(data)
            assert time.monotonic() - started < LIMIT_S, "too slow"
            assert _most_memory_kb() < LIMIT_MB * 1024, "too large"
        except BaseException:
            Path(f"crash-{count}").write_bytes(data)
            raise
        count += 1
    print(f"Done {count} inputs", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options)))
