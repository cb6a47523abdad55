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
from finders import Knowing, Slow

from semviz import cli
from semviz.identifying import identifying
from semviz.recording.reader import load_run
from semviz.verdicts import detection_failed
from semviz.workspace import Workspace
from semviz_annotation.proposals import Proposals, load_proposals
from semviz_core.classes import POLE, RECTANGULAR, ROUNDED
from semviz_core.detection import models
from semviz_core.detection.detector import Detector, Finder
from semviz_core.elements import Elements2D
from semviz_core.errors import SemvizError
from semviz_core.explaining.told import FALSE, UNKNOWN

SEED, FRAMES = 5, 3
PROPOSED = """{"format": "semviz-proposals", "version": 1, "proposals": [{"frame_index": 0,
 "side": "left", "class": "rounded sign", "anchor_px": [7.0, 8.0], "score": 0.5}]}"""


@pytest.fixture(scope="module")
def finder(tmp_path_factory: pytest.TempPathFactory) -> Knowing:
    """It takes seconds to know its street."""
    folder = tmp_path_factory.mktemp("street") / "town"
    return Knowing(Workspace.create_street(folder, SEED, range(FRAMES)).street)


@pytest.fixture
def town(tmp_path: Path) -> Path:
    return Workspace.create_street(tmp_path / "town", SEED, range(FRAMES)).path


def use(monkeypatch: pytest.MonkeyPatch, finder: Finder) -> None:
    """Any model is this one."""
    monkeypatch.setattr(models, "load_detector", lambda *_: Detector(finder))


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as exit:
        cli.main([str(one) for one in arguments])
    code = exit.value.code
    assert isinstance(code, int)
    return code


def found(town: Path) -> Proposals:
    return load_proposals(town / "proposals.parquet")


def test_from_images_to_poses(
    tmp_path: Path, finder: Knowing, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    use(monkeypatch, finder)
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
    for one in recorded.frames:
        assert one.localization.status == "ok"
        truth = finder.street.labels(one.frame.index, "left")[1]
        assert (one.element_id == FALSE).sum() == 1  # the pole in the sky
        known = one.element_id[one.element_id >= 0]
        findable = set(truth) - set(truth[3::7])
        assert set(known) <= findable
        assert len(known) > 0.8 * len(findable)
        failed = detection_failed(recorded, one)
        assert len(failed.false) == 1
        assert not set(failed.missed) & set(known)
    assert run("localize", town, "--map", "truth", "--observations", "detected",
               "--least-score", 0.5) == 0  # fmt: skip
    assert all((one.element_id != FALSE).all() for one in load_run(path).frames)


def test_a_killed_one_goes_on_where_it_was(town: Path, tmp_path: Path) -> None:
    """Killed with -9 at any moment: the file is whole, and no image that is in it is looked at
    again; in the end it holds what it would have held."""
    script = f"""
import sys; sys.path.insert(0, {str(Path(__file__).parents[1])!r})
from pathlib import Path
from finders import Slow
from semviz import cli, detecting
from semviz_core.detection import models
from semviz_core.detection.detector import Detector
models.load_detector = lambda *_: Detector(Slow(Path({str(tmp_path / "diary")!r}), 0.2))
detecting.EVERY_S, detecting.SAVING_SHARE = 0.0, 1.0
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
    assert kept.looked is not None
    done = kept.looked.images
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
    assert len(found(town).found) == FRAMES
    assert run("detect", town, "--sides", "left") == 0
    assert len((tmp_path / "diary").read_text().splitlines()) == FRAMES  # nothing left to do
    assert run("detect", town, "--frames", "0:2", "--least-score", 0.9) == 0
    assert [row.detector for row in found(town).rows()] == [""]
    looked = found(town).looked
    assert looked is not None
    assert looked.images == {(frame, side) for frame in (0, 1) for side in ("left", "right")}
    assert run("labels", "propose", town, tmp_path / "theirs.json", "--replace") == 0
    assert found(town).looked is None


def test_what_is_brought_in_meanwhile_stays(
    town: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "theirs.json").write_text(PROPOSED)

    class Meanwhile(Slow):
        def find(self, image: np.ndarray) -> object:  # type: ignore[override]
            run("labels", "propose", town, tmp_path / "theirs.json")
            return super().find(image)

    use(monkeypatch, Meanwhile(tmp_path / "diary"))
    assert run("detect", town, "--frames", "0:1", "--sides", "left") == 0
    assert sorted(row.detector[:4] for row in found(town).rows()) == ["", "slow"]


def test_whose_each_detection_is(town: Path, finder: Knowing) -> None:
    """By the street: also under another class; -1 where nothing is, not where something is that
    nobody would label."""
    workspace = Workspace.open(town)
    street, frame = finder.street, finder.street.frames[1]
    identify = identifying(workspace, street.truth_map)
    elements, ids = street.labels(frame.index, "left")
    assert identify(frame, elements).tolist() == ids.tolist()
    swapped = np.where(elements.class_id == ROUNDED, RECTANGULAR, elements.class_id)
    assert identify(frame, replace(elements, class_id=swapped)).tolist() == ids.tolist()
    far = Elements2D.from_ends([[600.0, 5.0]], [[600.0, 60.0]], [POLE])
    assert identify(frame, far).tolist() == [FALSE]


def test_without_street_and_labels_the_map_tells(town: Path, finder: Knowing) -> None:
    """And says of nothing that it is not real."""
    workspace = Workspace.open(town)
    street, frame = finder.street, finder.street.frames[1]
    elements, ids = street.labels(frame.index, "left")
    clear = elements.end_known & elements.anchor_known
    identify = identifying(_without_street(workspace), street.truth_map)
    told = identify(frame, elements)
    assert (told[clear] == ids[clear]).mean() > 0.8
    assert FALSE not in told
    blind = replace(frame, T_map_camera=None)
    assert set(identify(blind, elements)) == {UNKNOWN}


def _without_street(workspace: Workspace) -> Workspace:
    """The same images, as if nobody had simulated them."""
    other = Workspace(workspace.path, workspace.settings)
    other.__dict__["source"] = workspace.source
    kind = workspace.settings.source.model_copy()
    other.settings = workspace.settings.model_copy(update={"source": {"was": kind}})
    return other


class Refusing:
    name = "refusing"

    def find(self, image: np.ndarray) -> list[object]:
        raise SemvizError("m.onnx takes images of 640x640 only; pad them in m.toml")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("detect", "nowhere"), "nowhere: no such workspace"),
        (("detect", "TOWN", "--model", "m.doc"), "m.doc: no model that semviz knows"),
        (("detect", "TOWN", "--model", "none.safetensors"), "none.safetensors: no such weights"),
        (("detect", "TOWN", "--frames", "90:95"), "no frames are left"),
        (("detect", "TOWN", "--least-score", "2"), "score 2: give a number from 0 to 1"),
        (("localize", "TOWN", "--map", "truth", "--observations", "detected"), "nothing is detect"),
    ],
)
def test_mistakes_are_one_line(
    town: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], said: str
) -> None:
    assert run(*(town if one == "TOWN" else one for one in arguments)) == 2
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
    assert "no detector looked at frame 2" in capsys.readouterr().err
    assert not list((town / "runs").iterdir())
    assert run(*localize, "--frames", "0:2") == 0
