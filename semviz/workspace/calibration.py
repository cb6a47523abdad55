"""Find the calibration of a workspace's detections.

``semviz detect choose`` writes it beside the model; for the shipped model and models of the hub,
into the workspace. It holds for one model and one way of measuring, so others are refused.
"""

from pathlib import Path

from semviz.workspace.detect import MODEL_FILE
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.processed_images import ProcessedImages
from semviz_annotation.labels.proposals import load_proposals
from semviz_core.base.detector_calibration import CALIBRATION_ENDING, DetectorCalibration
from semviz_core.common.errors import SemvizError

NO_CALIBRATION = "none"
"""Value of ``--calibration`` for scores and sigmas as the detector gave them."""
NAME = f"detector{CALIBRATION_ENDING}"


def default_calibration_path(workspace: Workspace, model: str | None) -> Path:
    """Return where the calibration of a model is: beside it, or else in the workspace."""
    path = None if model is None else Path(model)
    if path is None or not path.exists():
        return workspace.path / NAME
    return path / NAME if path.is_dir() else path.with_name(path.stem + CALIBRATION_ENDING)


def find_calibration(
    workspace: Workspace, given: str | None
) -> tuple[Path, DetectorCalibration] | None:
    """Return the calibration of a workspace's detections with its file: the given one, or that of
    their model.

    Raise SemvizError if it was made for another model.
    """
    processed = load_proposals(workspace.proposals_path, workspace.classes).processed
    if given == NO_CALIBRATION:
        return None
    if given is not None:
        return _checked(Path(given), processed)
    if processed is None:
        return None
    model = processed.settings.get(MODEL_FILE)
    beside = default_calibration_path(workspace, None if model is None else str(model))
    if beside.is_file():
        return _checked(beside, processed)
    own = workspace.path / NAME
    return _checked(own, processed) if own.is_file() else None


def _checked(path: Path, processed: ProcessedImages | None) -> tuple[Path, DetectorCalibration]:
    calibration = DetectorCalibration.load(path)
    detector = "unknown: they were imported" if processed is None else processed.detector
    if processed is None or not calibration.is_of(processed.settings):
        raise SemvizError(
            f"{path}: made for {calibration.detector}, measured by {calibration.measuring}, but "
            f"the detector is {detector}; run 'semviz detect choose' for it, or give "
            f"--calibration {NO_CALIBRATION}"
        )
    return path, calibration
