"""``semviz detect evaluate`` with detections that 'semviz detect' stored: no network runs."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from semviz.commands.detect import DetectEvaluateCommand
from semviz.research.detector_evaluation import labelled_images
from semviz.workspace.demo import demo_labels
from semviz.workspace.detect import DetectOptions, detect_images
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.edits import ReviewFrame
from semviz_core.base.elements import Elements2D
from semviz_core.common.errors import SemvizError

LOAD = "semviz_core.detection.detector.load_detector"
FRAMES = (0, 3)


class EverySecond:
    """Finds every second element of the labels, and counts how often it is asked."""

    model = SimpleNamespace(name="planted")

    def __init__(self, workspace: Workspace) -> None:
        images = labelled_images(workspace, None, ("left", "right"))
        self.truths = {image.read().tobytes(): image.truth().elements for image in images}
        self.triangle_center = workspace.read_labels().triangle_center
        self.asked = 0

    def detect(self, image: np.ndarray) -> Elements2D:
        self.asked += 1
        return self.truths[image.tobytes()][::2]


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two reviewed frames of a street, with detections of the shipped network's name."""
    workspace = Workspace.create_street(tmp_path_factory.mktemp("stored") / "town", 7, range(6))
    with workspace.open_labels() as store:
        store.apply(demo_labels(workspace.street, -1, 0), "tester")
        for index in FRAMES:
            store.apply(ReviewFrame(index, "reviewed"), "tester")
    images = [(index, "left") for index in FRAMES]
    detect_images(workspace, EverySecond(workspace), DetectOptions(), images)  # type: ignore[arg-type]
    return workspace.path


def refuse(*_: Any) -> Any:
    raise AssertionError("the network was loaded")


def told(command: DetectEvaluateCommand, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    assert replace(command, json=True).run() == 0
    return dict(json.loads(capsys.readouterr().out))


def test_stored_detections_replace_the_network(
    town: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Same model and settings: the same figures as with the network, without running it."""
    monkeypatch.setattr(LOAD, refuse)
    stored = told(DetectEvaluateCommand((town,)), capsys)
    assert stored["settings"]["detections"] == "stored by 'semviz detect'"
    assert stored["settings"]["model"].startswith("planted ")
    assert stored["figures"].pop("time_ms_median") is None
    detector = EverySecond(Workspace.open(town))
    monkeypatch.setattr(LOAD, lambda *_: detector)
    now = told(DetectEvaluateCommand((town,), measuring="paper"), capsys)
    assert detector.asked == len(FRAMES) + 1  # and once to warm up
    assert now["settings"]["detections"] == "made now"
    assert now["figures"]["classes"]["pole"]["recall"]["count"] > 0
    for name in ("pole", "rectangular sign"):
        of_now, of_stored = (some["figures"]["classes"][name]["recall"] for some in (now, stored))
        assert of_now == of_stored


def test_stored_takes_what_is_there(
    town: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """``--stored`` asks for no model; time is said to be unmeasured."""
    monkeypatch.setattr(LOAD, refuse)
    assert DetectEvaluateCommand((town,), measuring="paper", stored=True).run() == 0
    assert "not measured, the detections are stored ones" in capsys.readouterr().out


def test_images_that_were_not_processed_need_the_network(
    town: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Right images have no detections: they are not taken for images without elements."""
    monkeypatch.setattr(LOAD, refuse)
    with pytest.raises(AssertionError, match="loaded"):
        DetectEvaluateCommand((town,), sides="both").run()
    with pytest.raises(SemvizError, match="right: not processed; run 'semviz detect' again"):
        DetectEvaluateCommand((town,), sides="both", stored=True).run()


def test_without_detections_stored_is_refused(town: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(town, tmp_path / "town")
    (copy / "proposals.parquet").unlink()
    with pytest.raises(SemvizError, match="not processed; run 'semviz detect' again"):
        DetectEvaluateCommand((copy,), stored=True).run()
    with pytest.raises(SemvizError, match="--stored needs a workspace"):
        DetectEvaluateCommand(stored=True).run()
    with pytest.raises(SemvizError, match="leave out --model"):
        DetectEvaluateCommand((copy,), stored=True, model="mine.toml").run()
