"""``semviz detect choose``, and ``semviz localize`` with the calibration that it writes."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from semviz import cli
from semviz.research.mapped_elements import elements_in_view
from semviz.runs.diagnosis import detector_of
from semviz.runs.reader import load_run
from semviz.workspace.detect import DetectOptions, detect_images
from semviz.workspace.workspace import TRUTH, Workspace
from semviz_core.base.classes import POLE
from semviz_core.base.detector_model import DetectorCalibration
from semviz_core.base.elements import Elements2D, joined
from semviz_core.base.frame import Side
from semviz_core.common.arrays import ByteImage

SEED, FRAMES = 5, 12
FALSE = 3
SCORE, FALSE_SCORE = 0.3, 0.2
"""Raw scores are low, but tell right from false."""


class Planted:
    """Finds what a street's map shows near the camera, and three poles that are not there."""

    model = SimpleNamespace(name="planted")

    def __init__(self, workspace: Workspace) -> None:
        street = workspace.street
        self._answers = {
            street.image(frame.index, "left").tobytes(): self._seen(workspace, frame.index)
            for frame in street.frames
        }

    def detect(self, image: ByteImage) -> Elements2D:
        return self._answers[image.tobytes()]

    @staticmethod
    def _seen(workspace: Workspace, index: int) -> Elements2D:
        street = workspace.street
        pose = street.frames[index].T_map_camera
        assert pose is not None
        rig = workspace.source.rig
        view = elements_in_view(street.truth_map, pose, rig, "left", 30.0)
        u = np.array([40.0, 640.0, 1200.0])
        ends = np.column_stack([u, 0 * u + 2.0]), np.column_stack([u, 0 * u + 60.0])
        false = Elements2D.from_ends(*ends, [POLE] * FALSE)
        seen = replace(view.elements, score=np.full(len(view.id), SCORE))
        return joined(seen, replace(false, score=np.full(FALSE, FALSE_SCORE)))


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """A street with the detections of a model in a folder."""
    folder = tmp_path_factory.mktemp("drive")
    (folder / "model").mkdir()
    (folder / "model" / "config.json").write_text("{}")
    workspace = Workspace.create_street(folder / "town", SEED, range(FRAMES))
    images = [(frame.index, "left") for frame in workspace.source.frames]
    options = DetectOptions(str(folder / "model"))
    detect_images(workspace, Planted(workspace), options, images)  # type: ignore[arg-type]
    return workspace


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        cli.main([str(argument) for argument in arguments])
    assert isinstance(ended.value.code, int)
    return ended.value.code


def model(drive: Workspace) -> Path:
    return drive.path.parent / "model"


def chosen(drive: Workspace, *options: object) -> int:
    return run("detect", "choose", drive.path, "--model", model(drive), "--map", TRUTH, *options)


def test_a_map_calibrates_a_detector(
    drive: Workspace, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """False ones are told from right ones; the table says why; localize takes what was written,
    also what a run tells of its detector."""
    assert chosen(drive) == 0
    said = capsys.readouterr().out
    path = model(drive) / "detector.calibration.toml"
    assert f"{path}: written" in said
    (line,) = (line for line in said.splitlines() if line.endswith("<- chosen"))
    calibration = DetectorCalibration.load(path)
    assert calibration.truth == f"{FRAMES} images of town, elements of map {TRUTH}"
    assert line.split()[0] == f"{calibration.least_score:g}"
    rates = calibration.rates
    assert rates[0].false_detections == pytest.approx(FALSE, abs=0.5)
    assert calibration.detector_model(calibration.least_score).false_detections < 0.5
    assert rates[0].recall_near > 0.9 > rates[0].recall_far
    assert calibration.scores["pole"](np.array([SCORE]))[0] > 0.85
    assert calibration.scores["pole"](np.array([FALSE_SCORE]))[0] < 0.15

    out = drive.path / "runs" / "calibrated.rrd"
    localize = "localize", drive.path, "--map", TRUTH, "--observations", "detected"
    assert run(*localize, "--out", out, "--images", "none") == 0
    assert "scores and rates as on 12 images of town" in capsys.readouterr().err
    recorded = load_run(out)
    assert detector_of(recorded) == calibration.detector_model(calibration.least_score)
    assert recorded.info.options["least_score"] == calibration.least_score
    assert str(drive.path.parent) not in str(recorded.info.options)
    observed = recorded.localizations[0].observed
    assert (observed.score > 0.85).all()
    np.testing.assert_allclose(
        observed.sigma_px[observed.is_line, 0], calibration.sigma_scale.pole_across
    )
    plain = drive.path / "runs" / "plain.rrd"
    assert run(*localize, "--out", plain, "--images", "none", "--calibration", "none") == 0
    without = load_run(plain)
    assert len(without.localizations[0].observed) == len(observed) + FALSE
    assert detector_of(without) != detector_of(recorded)

    by_run, measured = tmp_path / "rates.toml", tmp_path / "measured.rrd"
    assert run("detect", "rates", plain, "--out", by_run) == 0
    rates_of_run = DetectorCalibration.load(by_run)
    assert rates_of_run.rates[0].false_detections == pytest.approx(FALSE, abs=0.5)
    assert rates_of_run.least_score == SCORE
    assert run(*localize, "--out", measured, "--images", "none", "--calibration", by_run) == 0
    again = load_run(measured)
    assert detector_of(again) == rates_of_run.detector_model(SCORE)
    assert (again.localizations[0].observed.score == SCORE).all()  # no curve: as they were


def test_a_calibration_of_another_model_is_refused(
    drive: Workspace, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other.calibration.toml"
    assert chosen(drive, "--out", other) == 0
    text = other.read_text()
    made_for = DetectorCalibration.load(other).model
    other.write_text(text.replace(made_for, "0" * 64))
    capsys.readouterr()
    localize = "localize", drive.path, "--map", TRUTH, "--observations", "detected"
    assert run(*localize, "--out", tmp_path / "run.rrd", "--calibration", other) == 2
    told = capsys.readouterr().err
    assert f"{other}: made for planted " in told
    assert told.count("\n") == 1
    assert not (tmp_path / "run.rrd").exists()
    assert run(*localize, "--calibration", tmp_path / "none.toml") == 2
    assert "no such file; 'semviz detect choose' writes it" in capsys.readouterr().err
    simulated = *localize[:-1], "simulated"
    assert run(*simulated, "--calibration", other) == 2
    assert "add --observations detected" in capsys.readouterr().err


def test_a_limit_of_false_detections_is_kept(
    drive: Workspace, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "strict.calibration.toml"
    assert chosen(drive, "--out", path, "--most-false", 100) == 0
    assert DetectorCalibration.load(path).least_score == 0.0
    assert "the lowest with at most 100 false an image" in capsys.readouterr().out
    assert chosen(drive, "--most-false", 0) == 2
    assert "--most-false 0: give a number above 0" in capsys.readouterr().err


def test_only_own_files_are_replaced(
    drive: Workspace, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "notes.toml"
    path.write_text("mine = 1\n")
    assert chosen(drive, "--out", path) == 2
    assert str(path) in capsys.readouterr().err
    assert path.read_text() == "mine = 1\n"


def test_elements_in_view_are_what_the_street_shows(drive: Workspace) -> None:
    """The projection agrees with the street's own labels, in both images; cut ends are unknown."""
    street, rig = drive.street, drive.source.rig
    camera = rig.left
    seen = 0
    sides: tuple[Side, ...] = ("left", "right")
    for side in sides:
        labels, ids = street.labels(3, side)
        pose = street.frames[3].T_map_camera
        assert pose is not None
        view = elements_in_view(street.truth_map, pose, rig, side, 60.0)
        assert camera.contains(view.elements.anchor_px).all()
        assert (view.distance_m <= 60.0).all()
        for row, id_ in enumerate(view.id):
            at = np.flatnonzero(ids == id_)
            if len(at) and labels.anchor_known[at[0]] and view.elements.anchor_known[row]:
                apart = view.elements.anchor_px[row] - labels.anchor_px[at[0]]
                assert np.linalg.norm(apart) < 0.1
                seen += 1
        line = view.elements.is_line
        last = np.where(line[:, None], view.elements.end_px, view.elements.anchor_px)
        at_edge = (last[:, 1] > camera.height - 1.5) & line
        assert not view.elements.end_known[at_edge].any()
    assert seen > 10
