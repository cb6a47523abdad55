"""semviz detect: what is found is kept, gone on with, replaced, and localized with."""

import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from region_models import Knowing, Slow

from semviz import cli
from semviz.runs.diagnosis import detection_errors
from semviz.runs.reader import load_run
from semviz.workspace.observations import identify_detections
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.proposals import Proposals, load_proposals
from semviz_core.base.classes import POLE, RECTANGULAR, ROUNDED
from semviz_core.base.elements import Elements2D
from semviz_core.common.errors import SemvizError
from semviz_core.detection import detector
from semviz_core.detection.detector import Detector, RegionModel
from semviz_core.diagnosis.fault import FALSE_POSITIVE, UNKNOWN_ID

SEED, FRAMES = 5, 3
PROPOSED = """{"format": "semviz-proposals", "version": 1, "proposals": [{"frame_index": 0,
 "side": "left", "class": "rounded sign", "anchor_px": [7.0, 8.0], "score": 0.5}]}"""


@pytest.fixture(scope="module")
def loaded(tmp_path_factory: pytest.TempPathFactory) -> Knowing:
    """It takes seconds to know its street."""
    folder = tmp_path_factory.mktemp("street") / "town"
    return Knowing(Workspace.create_street(folder, SEED, range(FRAMES)).street)


@pytest.fixture
def town(tmp_path: Path) -> Path:
    return Workspace.create_street(tmp_path / "town", SEED, range(FRAMES)).path


def use(monkeypatch: pytest.MonkeyPatch, loaded: RegionModel) -> None:
    """Any model is this one."""
    monkeypatch.setattr(detector, "load_detector", lambda *_, **__: Detector(loaded))


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as exit:
        cli.main([str(argument) for argument in arguments])
    code = exit.value.code
    assert isinstance(code, int)
    return code


def found(town: Path) -> Proposals:
    return load_proposals(town / "proposals.parquet")


def test_from_images_to_poses(
    tmp_path: Path, loaded: Knowing, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    use(monkeypatch, loaded)
    town = tmp_path / "town"
    assert run("new", town, "--simulate", SEED, "--frames", f"0:{FRAMES}") == 0
    assert run("detect", town) == 0
    said = capsys.readouterr().out
    assert f"in {2 * FRAMES} images" in said
    assert run("localize", town, "--map", "truth", "--observations", "detected") == 0
    path = town / "runs" / "search.rrd"
    assert run("evaluate", path) == 0
    recorded = load_run(path)
    assert recorded.info.observations.startswith("detected by knowing ")
    assert recorded.info.options["detector_measuring"] == "edges"
    assert len(recorded.info.options["detector_model"]) == 64
    for frame in recorded.frames:
        assert frame.localization.status == "ok"
        truth = loaded.street.labels(frame.frame.index, "left")[1]
        assert (frame.element_id == FALSE_POSITIVE).sum() == 1  # the pole in the sky
        known = frame.element_id[frame.element_id >= 0]
        findable = set(truth) - set(truth[3::7])
        assert set(known) <= findable
        assert len(known) > 0.8 * len(findable)
        failed = detection_errors(recorded, frame)
        assert len(failed.false_positives) == 1
        assert not set(failed.missed_detections) & set(known)
    assert run("localize", town, "--map", "truth", "--observations", "detected",
               "--least-score", 0.5) == 0  # fmt: skip
    assert all((frame.element_id != FALSE_POSITIVE).all() for frame in load_run(path).frames)


def test_a_killed_one_goes_on_where_it_was(town: Path, tmp_path: Path) -> None:
    """Killed with -9 at any moment: the file is whole, and no image that is in it is looked at
    again; in the end it holds what it would have held."""
    script = f"""
import sys; sys.path.insert(0, {str(Path(__file__).parents[1])!r})
from pathlib import Path
from region_models import Slow
from semviz import cli
from semviz.workspace import detect
from semviz_core.detection import detector
from semviz_core.detection.detector import Detector
detector.load_detector = lambda *_, **__: Detector(Slow(Path({str(tmp_path / "diary")!r}), 0.2))
detect.SAVE_INTERVAL_S, detect.SAVING_SHARE = 0.0, 1.0
cli.main(["detect", {str(town)!r}])
"""
    path = town / "proposals.parquet"
    child = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.DEVNULL)
    while not path.exists() and child.poll() is None:
        time.sleep(0.02)
    time.sleep(0.3)
    child.send_signal(signal.SIGKILL)
    child.wait()
    kept = found(town)
    assert kept.processed is not None
    done = kept.processed.images
    assert 0 < len(done) < 2 * FRAMES
    assert {(row.frame_index, row.side) for row in kept.rows()} == done
    diary = tmp_path / "diary"
    before = diary.read_text().splitlines()
    subprocess.run([sys.executable, "-c", script], check=True, stdout=subprocess.DEVNULL)
    looked = Counter(diary.read_text().splitlines())
    assert len(looked) == 2 * FRAMES
    assert sum(looked.values()) - len(looked) == len(before) - len(done)  # killed before saving
    assert len(found(town)) == 2 * FRAMES


def test_other_settings_replace_only_what_was_detected(
    town: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use(monkeypatch, Slow(tmp_path / "diary"))
    (tmp_path / "theirs.json").write_text(PROPOSED)
    assert run("labels", "propose", town, tmp_path / "theirs.json") == 0
    assert run("detect", town, "--sides", "left") == 0
    assert Counter(row.detector[:4] for row in found(town).rows()) == {"slow": FRAMES, "": 1}
    assert len(found(town).detections) == FRAMES
    assert run("detect", town, "--sides", "left") == 0
    assert len((tmp_path / "diary").read_text().splitlines()) == FRAMES  # nothing left to do
    assert run("detect", town, "--frames", "0:2", "--least-score", 0.9) == 0
    assert [row.detector for row in found(town).rows()] == [""]
    looked = found(town).processed
    assert looked is not None
    assert looked.images == {(frame, side) for frame in (0, 1) for side in ("left", "right")}
    assert run("labels", "propose", town, tmp_path / "theirs.json", "--replace") == 0
    assert found(town).processed is None


def test_proposals_that_no_labels_could_follow_together_are_refused(
    town: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Triangular signs of unknown height, of both definitions: also if there are no labels yet."""
    box = PROPOSED.replace("rounded", "triangular")
    (tmp_path / "box.json").write_text(box)
    centroid = box.replace('"score": 0.5', '"score": 0.5, "triangle_center": "centroid"')
    (tmp_path / "centroid.json").write_text(centroid.replace("7.0, 8.0", "90.0, 8.0"))
    assert not Workspace.open(town).labels_path.exists()
    assert run("labels", "propose", town, tmp_path / "box.json", "--replace") == 0
    assert run("labels", "propose", town, tmp_path / "centroid.json") == 2
    assert "its height is not known" in capsys.readouterr().err
    assert found(town).anchor_px.tolist() == [[7.0, 8.0]]


def test_what_is_brought_in_meanwhile_stays(
    town: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "theirs.json").write_text(PROPOSED)

    class Meanwhile(Slow):
        def find(self, image: np.ndarray, watch: object = None) -> object:  # type: ignore[override]
            run("labels", "propose", town, tmp_path / "theirs.json")
            return super().find(image)

    use(monkeypatch, Meanwhile(tmp_path / "diary"))
    assert run("detect", town, "--frames", "0:1", "--sides", "left") == 0
    assert sorted(row.detector[:4] for row in found(town).rows()) == ["", "slow"]


def test_whose_each_detection_is(town: Path, loaded: Knowing) -> None:
    """By the street: also under another class; -1 where nothing is, not where something is that
    nobody would label."""
    workspace = Workspace.open(town)
    street, frame = loaded.street, loaded.street.frames[1]
    identify = identify_detections(workspace, street.truth_map)
    elements, ids = street.labels(frame.index, "left")
    assert identify(frame, elements).tolist() == ids.tolist()
    swapped = np.where(elements.class_id == ROUNDED, RECTANGULAR, elements.class_id)
    assert identify(frame, replace(elements, class_id=swapped)).tolist() == ids.tolist()
    far = Elements2D.from_ends([[600.0, 5.0]], [[600.0, 60.0]], [POLE])
    assert identify(frame, far).tolist() == [FALSE_POSITIVE]


def test_without_street_and_labels_the_map_tells(town: Path, loaded: Knowing) -> None:
    """And says of nothing that it is not real."""
    workspace = Workspace.open(town)
    street, frame = loaded.street, loaded.street.frames[1]
    elements, ids = street.labels(frame.index, "left")
    clear = elements.end_known & elements.anchor_known
    identify = identify_detections(_without_street(workspace), street.truth_map)
    told = identify(frame, elements)
    assert (told[clear] == ids[clear]).mean() > 0.8
    assert FALSE_POSITIVE not in told
    blind = replace(frame, T_map_camera=None)
    assert set(identify(blind, elements)) == {UNKNOWN_ID}


def _without_street(workspace: Workspace) -> Workspace:
    """The same images, as if nobody had simulated them."""
    other = Workspace(workspace.path, workspace.settings)
    other.__dict__["source"] = workspace.source
    kind = workspace.settings.source.model_copy()
    other.settings = workspace.settings.model_copy(update={"source": {"was": kind}})
    return other


class Refusing:
    name = "refusing"

    def find(self, image: np.ndarray, watch: object = None) -> list[object]:
        raise SemvizError("m.onnx takes images of 640x640 only; pad them in m.toml")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("detect", "nowhere"), "nowhere: no such workspace"),
        (("detect", "TOWN", "--model", "m.doc"), "m.doc: not a model that semviz can read"),
        (("detect", "TOWN", "--model", "none.safetensors"), "none.safetensors: no such weights"),
        (("detect", "TOWN", "--frames", "90:95"), "none of these frames"),
        (("detect", "TOWN", "--least-score", "2"), "score 2: give a number from 0 to 1"),
        (("localize", "TOWN", "--map", "truth", "--observations", "detected"), "no detections yet"),
    ],
)
def test_mistakes_are_one_line(
    town: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], said: str
) -> None:
    assert run(*(town if argument == "TOWN" else argument for argument in arguments)) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not (town / "proposals.parquet").exists()
    assert not list((town / "runs").iterdir())


def test_an_image_that_the_model_refuses_is_named(
    town: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    use(monkeypatch, Refusing())
    assert run("detect", town) == 2
    assert "frame 0, left image: m.onnx takes images of 640x640" in capsys.readouterr().err


def test_frames_that_nobody_looked_at_are_not_localized(
    town: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    use(monkeypatch, Slow(tmp_path / "diary"))
    assert run("detect", town, "--frames", "0:2") == 0
    localize = ("localize", town, "--map", "truth", "--observations", "detected")
    assert run(*localize) == 2
    assert "frame 2 was not processed" in capsys.readouterr().err
    assert not list((town / "runs").iterdir())
    assert run(*localize, "--frames", "0:2") == 0
