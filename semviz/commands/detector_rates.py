"""The command detect rates."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from semviz.commands import parsing
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from semviz.runs.run import Run
    from semviz_core.base.detector_model import DetectorCalibration
    from semviz_core.diagnosis.detector_rates import MeasuredDetector


@dataclass(frozen=True)
class DetectRatesCommand:
    """Measure a detector on a run: false detections, recall by distance, hidden bottoms, sigmas.

    With true poses, or without: then on the frames that are sure. No label is needed.
    'semviz localize --observations detected' takes the file that is written. Example: 'semviz
    detect rates town/runs/search.rrd'."""

    run_file: Positional[Path]
    """Run (.rrd) that observed detections."""
    out: parsing.OptionalPath = None
    """File to write; default: detector.calibration.toml in the workspace of the run."""
    ignore_truth: bool = False
    """Take no true pose and no id from the run, as if they were unknown."""
    force: parsing.Force = False
    json: bool = False
    """Print one JSON object instead of lines."""

    def run(self) -> int:
        from semviz.runs.reader import load_run
        from semviz.workspace.outputs import check_outputs, starts_with
        from semviz_core.base.detector_model import CALIBRATION_HEADER

        path = self.out or _beside(self.run_file)
        ours = starts_with(CALIBRATION_HEADER.encode())
        check_outputs(path, ours, force=self.force, reads=[self.run_file], purpose="calibration")
        recorded = load_run(self.run_file)
        measured = self._measured(recorded)
        _calibration(recorded, measured, self.ignore_truth).save(path)
        if self.json:
            print(json.dumps({"file": str(path), **_as_dict(measured)}))
        else:
            print(_as_text(recorded, measured))
            print(f"{path}: written; next: semviz localize WORKSPACE --observations detected")
        return 0

    def _measured(self, run: "Run") -> "MeasuredDetector":
        from semviz.runs.diagnosis import truth_of
        from semviz.runs.run import RATES, observations_of
        from semviz_core.diagnosis.detector_rates import measure_detector

        if observations_of(run.info.observations) == "labels":
            raise SemvizError(
                f"{self.run_file}: observed labels; localize with --observations detected"
            )
        if RATES in run.info.options:
            raise SemvizError(
                f"{self.run_file}: its detections were calibrated already; localize again with "
                "--calibration none"
            )
        frames = [
            (record.localization, None if self.ignore_truth else truth_of(run, record))
            for record in run.frames
        ]
        return measure_detector(frames, run.semantic_map)


def _calibration(
    run: "Run", measured: "MeasuredDetector", ignore_truth: bool
) -> "DetectorCalibration":
    """Return what was measured as the detector's calibration; scores keep their meaning."""
    from semviz_core.base.detector_model import DetectorCalibration

    options = run.info.options
    has_truth = not ignore_truth and any(truth is not None for truth in run.truths)
    poses = "true poses" if has_truth else "its own poses that are ok"
    return DetectorCalibration(
        detector=str(options.get("detector", run.info.observations)),
        model=str(options.get("detector_model", "")),
        measuring=str(options.get("detector_measuring", "")),
        truth=f"{measured.frames} frames of run {run.info.name}, {poses}, no labels",
        least_score=measured.least_score,
        scores={},
        sigma_scale=measured.sigma_scale,
        rates=measured.rates,
    )


def _beside(run_file: Path) -> Path:
    """Return the calibration of the workspace that holds a run."""
    from semviz.workspace.detect import default_calibration_path
    from semviz.workspace.workspace import Workspace

    folder = run_file.resolve().parent.parent
    try:
        return default_calibration_path(Workspace.open(folder), None)
    except SemvizError:
        raise SemvizError(
            f"{run_file}: is not in a workspace; name the file to write with --out"
        ) from None


def _as_dict(measured: "MeasuredDetector") -> dict[str, Any]:
    return {
        "frames": measured.frames,
        "detections": measured.detections,
        "right": round(measured.right, 2),
        "least_score": measured.least_score,
        "rates": measured.model._asdict(),
        "sigma_scale": measured.sigma_scale.model_dump(),
    }


def _as_text(recorded: "Run", measured: "MeasuredDetector") -> str:
    model, scale = measured.model, measured.sigma_scale
    return (
        f"{measured.frames} of {len(recorded.frames)} frames: {measured.right:.0f} of "
        f"{measured.detections} detections are likely of a mapped element\n"
        f"false detections an image  {model.false_detections:.2f}\n"
        f"recall up to {model.near_m:g} m         {model.recall_near:.2f}\n"
        f"recall from {model.far_m:g} m          {model.recall_far:.2f}\n"
        f"hidden bottoms             {model.hidden_bottoms:.2f}\n"
        f"sigma scale                poles across {scale.pole_across:.2f}, along "
        f"{scale.pole_along:.2f}, signs {scale.sign:.2f}\n"
        f"minimum score              {measured.least_score:g}"
    )
