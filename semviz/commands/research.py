"""The commands benchmark, train, weights and detect choose."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from semviz.commands import parsing
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from semviz.research.detector_evaluation import DetectorChoice, EvaluationImage
    from semviz.workspace.detect import DetectOptions
    from semviz.workspace.workspace import Workspace

import json
import os
import sys
from dataclasses import replace
from typing import TYPE_CHECKING

from tyro.conf import UseAppendAction

from semviz_core.common.errors import require_extra

if TYPE_CHECKING:
    from semviz_core.research.training.batch import SampleSource


@dataclass(frozen=True)
class DetectChooseCommand:
    """Calibrate a detector and choose its minimum score, on labelled frames or on a map.

    Writes what scores and sigmas mean, and the detector's rates, into one file beside the model.
    'semviz localize --observations detected' takes it from there.

    Example: 'semviz detect choose town --most-false 1'."""

    workspace: Positional[Path]
    """Folder of the workspace. Its stored detections are used if the same model made them."""
    model: Annotated[str | None, arg(metavar="MODEL", help_behavior_hint="")] = None
    """As for 'semviz detect'; default: the shipped weights."""
    measuring: Literal["edges", "paper"] = "edges"
    """Measurement within the detected regions, as for 'semviz detect'."""
    map: parsing.OptionalText = None
    """Ground truth: elements of this map at the true poses; a detection without one is false.
    Default: the labels; a detection without one is false in reviewed frames."""
    frames: parsing.OptionalText = None
    """FIRST:END[:STEP]: only these frames."""
    sides: Literal["left", "both"] = "left"
    """left: left images only; both: right ones too."""
    most_false: parsing.OptionalFloat = None
    """Choose the lowest score with at most this many false detections per image; default: the
    score that leaves the most right detections minus false ones."""
    out: parsing.OptionalPath = None
    """File to write; default: NAME.calibration.toml beside the model, or
    detector.calibration.toml in the workspace if the model is the shipped one or of the hub."""
    force: parsing.Force = False
    json: parsing.Json = False

    def run(self) -> int:
        from semviz.workspace.detect import DetectOptions, default_calibration_path
        from semviz.workspace.outputs import check_outputs, starts_with
        from semviz_core.base.detector_model import CALIBRATION_HEADER
        from semviz_core.common.limits import read_toml

        if self.most_false is not None and not self.most_false > 0.0:
            raise SemvizError(f"--most-false {self.most_false:g}: give a number above 0")
        workspace = parsing.open_workspace(self.workspace)
        path = self.out or default_calibration_path(workspace, self.model)
        ours = starts_with(CALIBRATION_HEADER.encode())
        check_outputs(path, ours, force=self.force, reads=[self.workspace], purpose="calibration")
        choice = self._choose(workspace, DetectOptions(self.model, self.measuring))
        choice.calibration.save(path)
        with parsing.text_aside(self.json):
            print(choice.as_text())
            print(
                f"{path}: written; next: semviz localize {self.workspace} --observations detected"
            )
        if self.json:
            print(json.dumps({"path": str(path), "calibration": read_toml(path)}))
        return 0

    def _choose(self, workspace: "Workspace", options: "DetectOptions") -> "DetectorChoice":
        from semviz.commands.detect import measurement
        from semviz.research.detector_evaluation import (
            calibration_images,
            choose,
            stored_detector,
            with_stored,
        )
        from semviz.workspace.detect import detection_settings, detector_name, stored_detections
        from semviz_core.detection.detector import load_detector

        stored = stored_detections(workspace, options)
        images = with_stored(self._images(workspace), stored)
        is_stored = all(image.stored is not None for image in images)
        detector = None if is_stored else load_detector(self.model, measurement(self.measuring))
        hash_ = str(detection_settings(options)["model"])
        name = stored_detector(images) if detector is None else detector_name(detector, hash_)
        return choose(
            calibration_images(detector, images),
            name,
            (hash_, self.measuring),
            self._truth(images),
            self.most_false,
        )

    def _images(self, workspace: "Workspace") -> "Sequence[EvaluationImage]":
        from semviz.research.detector_evaluation import labelled_images
        from semviz.research.mapped_elements import mapped_images
        from semviz_core.base.frame import Side
        from semviz_core.metrics.detection_calibration import REACH_M

        sides: tuple[Side, ...] = ("left", "right") if self.sides == "both" else ("left",)
        frames = parsing.parse_frames(self.frames)
        if self.map is None:
            return labelled_images(workspace, frames, sides, REACH_M)
        return mapped_images(workspace, self.map, frames, sides, REACH_M)

    def _truth(self, images: "Sequence[EvaluationImage]") -> str:
        """Return for example ``20 images of kitti02, 18 of them reviewed``."""
        what = f"{len(images)} images of {images[0].place}"
        if self.map is not None:
            return f"{what}, elements of map {self.map}"
        return f"{what}, {sum(image.is_complete for image in images)} of them reviewed"


RESULTS = "results.jsonl"
_STARTS = {
    RESULTS: b'{"semviz": "',
    "table.md": b"# Benchmark\n\nMade with ",
    "table.json": b'{\n "settings": {',
}
"""The files of a benchmark besides its plots, and how they start."""


@dataclass(frozen=True)
class BenchmarkCommand:
    """Compare methods on the same problems: error, lower bound, calibration and runtime.

    Example: 'semviz benchmark --methods search,direct --frames 100'."""

    methods: parsing.OptionalText = None
    """Comma-separated, for example search,direct; default: all available methods, or those of the
    paper's table for paper-20m, street-paper and paper. A wrong name lists the known ones."""
    noise: Literal["paper", "low", "both"] = "both"
    """Noise of the detections: the paper's table, 1 px and 0.3 deg, or both."""
    frames: int = 200
    """Number of frames per suite and noise."""
    seed: int = 1000
    """Seed of the first frame; frame i uses seed + i. Seeds below 1000 are for tuning."""
    suite: str = "frames"
    """Comma-separated, for example frames,matched; hard: all hard sets; all: everything else;
    paper-20m: the paper's table with its printed figures, on its own protocol; street-paper: the
    same on simulated streets, with pictures and scans; paper: the same on the frames of semviz. A
    wrong name lists the known ones."""
    kitti_poses: parsing.OptionalPath = None
    """Folder with KITTI poses (09.txt); default: simulated roads."""
    pole_maps: parsing.OptionalPath = None
    """Folder with pole maps (kitti_09.npz); required with --kitti-poses."""
    sequences: str = "09,10"
    """KITTI sequences, comma-separated."""
    jobs: int = 1
    """Number of processes; several slow each other down, so their times are marked."""
    out: Path = Path("benchmark")
    """Folder for results, tables and plots. The same command resumes an interrupted benchmark."""
    plots: bool = True
    """Also write plots into the folder."""
    force: parsing.Force = False
    json: bool = False
    """Print one JSON object instead of tables."""

    def run(self) -> int:
        os.environ |= parsing.ONE_THREAD

        from semviz.research.benchmark.report import (
            PAPER_SUITES,
            BenchmarkReport,
            draw_benchmark_plots,
            methods_of_table,
        )
        from semviz.research.benchmark.runner import BenchmarkPlan, complete
        from semviz.research.benchmark.suites import Roads, choose_methods, choose_suites
        from semviz_core.research.evaluation.outcomes import rows

        for number, option, minimum in (
            (self.frames, "--frames", 1), (self.seed, "--seed", 0), (self.jobs, "--jobs", 1),
        ):  # fmt: skip
            if number < minimum:
                raise SemvizError(f"{option} {number}: give {minimum} or more")
        suites = choose_suites(self.suite)
        is_paper = all(suite.name in PAPER_SUITES for suite in suites)
        of_table = ",".join(methods_of_table(suites)) if is_paper else None
        chosen = choose_methods(self.methods or of_table, suites)
        plan = BenchmarkPlan(
            suites,
            noises=("paper", "low") if self.noise == "both" else (self.noise,),
            methods=chosen.by_kind,
            seeds=range(self.seed, self.seed + self.frames),
            roads=Roads(self.kitti_poses, self.pole_maps, tuple(self.sequences.split(","))),
        )
        notes = [*chosen.notes(), *plan.notes()]
        for note in notes:
            print(f"semviz: {note}", file=sys.stderr)
        self._check_files()
        outcomes = complete(plan, self.out / RESULTS, self.jobs)
        report = BenchmarkReport(plan.settings(), tuple(notes), tuple(rows(outcomes)))
        report.write(self.out)
        if self.plots:
            draw_benchmark_plots(outcomes, report.rows, self.out)
        print(json.dumps(report.as_json()) if self.json else report.as_text())
        return 0

    def _check_files(self) -> None:
        from semviz.workspace.outputs import PNG, check_outputs, starts_with

        for name, start in _STARTS.items():
            # Results are appended to, so another file cannot be one.
            force = self.force and name != RESULTS
            check_outputs(self.out / name, starts_with(start), force=force)
        check_outputs(sorted(self.out.glob("*.png")), PNG, force=self.force)


@dataclass(frozen=True)
class TrainCommand:
    """Train a learned method.

    Run the same command again to resume. A checkpoint is written every minute, at the end, on
    ctrl-C and on SIGTERM. Several processes: torchrun --nproc-per-node 2 --no-python semviz
    train ...

    Example: 'semviz train verifier --out trained'."""

    model: Annotated[Positional[str], arg(metavar="MODEL")]
    """paper, paper-no-semantics, bpnpnet, bpnpnet-semantic, matcher, verifier, and for suite
    paper-20m matchnet, deepi2p, matchnet-semantic or deepi2p-semantic; for suite street-paper
    deepi2p-pixels."""
    out: Annotated[Path, arg(metavar="DIR")]
    """Training folder: checkpoint, losses as JSON lines and as a plot."""
    samples: parsing.OptionalInt = None
    """Total number of samples; default: as planned before, or by the model's schedule."""
    batch: int = 12
    """Samples per step, over all processes."""
    seed: int = 0
    """Seed of the initial weights and of the samples."""
    workers: int = 1
    """Processes that make samples, per training process."""
    suite: Literal["paper-20m"] | None = None
    """Train on frames like those of this suite of the benchmark; default: by the model."""
    workspace: Annotated[UseAppendAction[tuple[Path, ...]], arg(metavar="WORKSPACE")] = ()
    """Train on the labels and map of this workspace; may be repeated."""
    kitti_poses: parsing.OptionalPath = None
    """Folder with KITTI poses (00.txt); default: simulated roads."""
    pole_maps: parsing.OptionalPath = None
    """Folder with pole maps (kitti_00.npz); required with --kitti-poses."""
    precision: Literal["float32", "bf16"] = "float32"
    """bf16: half precision, on a GPU or a processor with AMX or AVX-512 BF16."""
    held_out: int = 240
    """Size of the validation set, evaluated at most 40 times per training."""
    stop_after_s: parsing.OptionalFloat = None
    """Save and stop after this many seconds."""
    force: parsing.Force = False
    json: parsing.Json = False

    def run(self) -> int:
        require_extra("semviz train", "torch", "train")
        from semviz.presentation.terminal import announce_compiling
        from semviz.research.training_run import (
            check_training_folder,
            make_training_task,
            train,
            training_summary,
        )

        check_training_folder(self.out, self.force, self.workspace)
        announce_compiling()
        task = make_training_task(self.model, self._source(), self.seed)
        with parsing.text_aside(self.json):
            status = train(task, self, self.held_out, [f"semviz weights {self.out} --out FOLDER"])
        if self.json:
            print(json.dumps(training_summary(self.out)))
        return status

    def _source(self) -> "SampleSource | None":
        """Return the task's simulated samples, on KITTI's roads if given, or labelled ones; None
        for its own."""
        from semviz.research.training_run import training_samples
        from semviz_core.research.training.simulated_samples import KittiFiles

        simulated = training_samples(self.model, self.suite)
        if simulated is None:
            if self.suite or self.workspace or self.kitti_poses or self.pole_maps:
                raise SemvizError(f"{self.model} trains on its own streets; give no other samples")
            return None
        if (self.kitti_poses is None) != (self.pole_maps is None):
            raise SemvizError("--kitti-poses and --pole-maps belong together; give both")
        if self.kitti_poses is not None and self.pole_maps is not None:
            if self.workspace:
                raise SemvizError("--workspace and --kitti-poses: give one of them")
            return replace(simulated, kitti=KittiFiles(self.kitti_poses, self.pole_maps))
        if self.workspace:
            if self.suite:
                raise SemvizError("--workspace and --suite: give one of them")
            from semviz.research.workspace_data import workspace_samples

            workspaces = [parsing.open_workspace(path) for path in self.workspace]
            return workspace_samples(workspaces, shift_m=simulated.shift_m)
        return simulated


@dataclass(frozen=True)
class WeightsCommand:
    """Export the weights of a training with a model card, for 'semviz localize --weights' and
    'semviz detect --model'.

    Example: 'semviz weights trained --out weights'."""

    training: Annotated[Positional[Path], arg(metavar="TRAINING")]
    """Folder given as --out to 'semviz train' or 'semviz detect train'."""
    out: Annotated[Path, arg(metavar="DIR")]
    """Folder for MODEL.safetensors and the model card, MODEL.json."""
    force: parsing.Force = False
    json: parsing.Json = False

    def run(self) -> int:
        require_extra("semviz weights", "torch", "train")
        from semviz.research.training_run import write_weights

        path = write_weights(self.training, self.out, force=self.force)
        size, card = path.stat().st_size, path.with_suffix(".json")
        if self.json:
            print(json.dumps({"path": str(path), "bytes": size, "card": str(card)}))
        else:
            print(f"{path}: {size / 1e6:.1f} MB, card {card}")
        return 0
