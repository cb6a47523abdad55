"""semviz detect train: rendered streets, learned from, gone on with, kept and looked with."""

import json
import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from command_line import Call, call
from safetensors.torch import load_file

from semviz.cli import main
from semviz.commands import detect
from semviz.research.training_run import HeldOutRecall
from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.base.weights import shipped_weights
from semviz_core.detection.network import DetectorNet, HeatmapModel, load_shipped_model
from semviz_core.research.training import detector
from semviz_core.research.training.detector_images import StreetImages
from semviz_core.research.training.trainer import CHECKPOINT

TINY = ("--streets", 1, "--samples", 6, "--batch", 2)
FEW = 4
"""Held-out crops and images, where people get 64 and 200."""


@pytest.fixture(scope="module", autouse=True)
def _few_held_out() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(detect, "HELD_OUT", FEW)
        patch.setattr(detector, "TUNING_IMAGES", FEW)
        yield


@pytest.fixture
def train(capsys: pytest.CaptureFixture[str]) -> Call:
    """Exit status, output and error output of ``semviz detect train``."""
    return partial(call, capsys, "detect", "train")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training that has finished; others begin with a copy of its rendered streets."""
    out = tmp_path_factory.mktemp("training") / "whole"
    with pytest.raises(SystemExit) as ended:
        main(["detect", "train", "--out", str(out), *map(str, TINY)])
    assert not ended.value.code
    return out


def test_streets_to_weights_and_on_from_wherever_it_stopped(
    train: Call, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    parts, folder = tmp_path / "parts", tmp_path / "weights"
    status, output, errors = train("--out", whole, *TINY)
    assert status == 0, errors
    assert "finished after 6 of 6" in output
    assert len(list((whole / "streets").iterdir())) == 3  # one to learn from, two to tune on
    shutil.copytree(whole / "streets", parts / "streets")
    for _ in range(5):  # each goes on for one step
        status, output, _ = train("--out", parts, "--stop-after-s", 0, *TINY)
        assert status == 0
        if "finished" in output:
            break
    file, other = load_file(whole / CHECKPOINT), load_file(parts / CHECKPOINT)
    assert file.keys() == other.keys()
    assert all(torch.equal(file[name], other[name]) for name in file)

    assert call(capsys, "weights", whole, "--out", folder)[0] == 0
    card = json.loads((folder / "detector.json").read_text())
    assert (card["task"], card["samples"], card["options"]["data"]["streets"]) == (
        "detector", 6, 1,
    )  # fmt: skip
    weights = folder / "detector.safetensors"
    street = tmp_path / "street"
    assert call(capsys, "new", street, "--simulate", 30_000, "--frames", "0:1")[0] == 0
    assert call(capsys, "detect", street, "--model", weights)[0] == 0


def test_what_ships_has_a_card_and_begins_a_training(
    train: Call, whole: Path, tmp_path: Path
) -> None:
    shutil.copytree(whole / "streets", tmp_path / "streets")
    weights = shipped_weights("detector")
    card = json.loads(weights.with_suffix(".json").read_text())
    assert card["task"] == "detector"
    assert card["bytes"] == weights.stat().st_size < 15e6
    status, _, errors = train("--out", tmp_path, "--from", "shipped", "--stop-after-s", 0, *TINY)
    assert status == 0, errors
    state = load_file(tmp_path / CHECKPOINT)
    shipped = load_file(weights)
    name = "head.0.weight"
    moved = (state[f"network.{name}"] - shipped[name].float()).abs().max()
    assert 0.0 < moved < 0.01  # by one step
    status, _, errors = train("--out", tmp_path, "--stop-after-s", 0, *TINY)
    assert status == 2
    assert str(tmp_path) in errors


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("--streets", -1), "--streets -1: give 0 to 9000"),
        (("--streets", 0), "no training images are left"),
        (("--frames", "0:5"), "name a workspace"),
        (("--map", "main"), "--map selects from workspaces; name a workspace"),
        (("--workers", 0), "--workers 0: give 1 or more"),
        (("--from", "nowhere.safetensors", "--streets", 1), "nowhere.safetensors: no such weights"),
        (("missing-workspace",), "no such workspace"),
    ],
)
def test_what_makes_no_sense_is_one_line(
    train: Call, tmp_path: Path, arguments: tuple[object, ...], line: str
) -> None:
    status, output, errors = train(*arguments, "--out", tmp_path / "out")
    assert (status, output) == (2, "")
    assert line in errors
    assert errors.count("\n") == 1


def test_data_sets_are_learned_from(train: Call, whole: Path, tmp_path: Path) -> None:
    """Masks and boxes are measured once; the same command goes on with what is stored."""
    data = tmp_path / "data"
    (data / "masks").mkdir(parents=True)
    image = np.full((376, 500, 3), 90, np.uint8)
    mask = np.zeros((376, 500), np.uint8)
    image[100:300, 200:208], mask[100:300, 200:208] = (220, 220, 210), 1
    for name in ("a", "b"):
        cv2.imwrite(str(data / f"{name}.png"), image)
        cv2.imwrite(str(data / "masks" / f"{name}.png"), mask)
        (data / f"{name}.txt").write_text(f"0 {204 / 500} {200 / 376} {8 / 500} {200 / 376}\n")
    (data / "boxes.toml").write_text(
        'format = "yolo"\nimages = "*.png"\nboxes = "{name}.txt"\n[classes]\n0 = "pole"\n'
    )
    table = 'images = "*.png"\nmasks = "masks/{name}.png"\n[classes]\n1 = "pole"\n'
    (data / "segmentation.toml").write_text(table)
    out = tmp_path / "out"
    shutil.copytree(whole / "streets", out / "streets")  # those that it is tuned on
    sets = "--segmentation", data, "--boxes", data
    tiny = "--streets", 0, "--samples", 4, "--batch", 4
    status, output, errors = train(*sets, "--out", out, *tiny)
    assert status == 0, errors
    assert "finished after 4 of 4" in output
    made = sorted((out / "prepared").iterdir())
    assert len(made) == 4
    times = [path.stat().st_mtime_ns for path in made]
    assert train(*sets, "--out", out, *tiny)[0] == 0
    assert [path.stat().st_mtime_ns for path in made] == times
    (data / "b.png").unlink()
    status, _, errors = train("--segmentation", data, "--out", tmp_path / "new", *tiny)
    assert status == 2
    assert "1 images *.png have a mask" in errors


def planted_recall(monkeypatch: pytest.MonkeyPatch, before: float, after: float) -> None:
    """Poles on all held-out images, by the initial weights and by others."""
    names = iter(["old", "new"] * 100)

    def recall(*_: object) -> HeldOutRecall:
        return HeldOutRecall(before if next(names) == "old" else after, None)

    monkeypatch.setattr("semviz.research.training_run.HeldOutRecall.of", recall)


def test_a_training_that_forgets_is_refused(
    train: Call, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The weights are kept aside; only --allow-loss takes them back. A small loss is chance."""
    shutil.copytree(whole / "streets", tmp_path / "mine" / "streets")
    planted_recall(monkeypatch, 0.92, 0.05)
    arguments = "--out", tmp_path / "mine", "--from", "shipped", *TINY
    status, output, errors = train(*arguments)
    assert status == 2
    assert "streets" in output
    assert "92 %" in output
    (line,) = (line for line in errors.splitlines() if line.startswith("semviz: "))
    assert "on held-out streets poles fell from 92 to 5 %; the weights are kept aside in" in line
    aside = tmp_path / "mine" / "forgot.safetensors"
    assert aside.exists()
    assert not (tmp_path / "mine" / CHECKPOINT).exists()
    status, _, errors = train(*arguments)
    assert status == 2
    assert "a training that forgot; accept it with --allow-loss" in errors
    status, output, errors = train(*arguments, "--allow-loss")
    assert status == 0, errors
    assert "finished after 6 of 6" in output
    assert (tmp_path / "mine" / CHECKPOINT).exists()
    assert not aside.exists()
    planted_recall(monkeypatch, 0.92, 0.88)
    status, output, errors = train(*arguments)
    assert status == 0, errors
    assert "Held-out recall at 0.5 false an image" in output


def test_recall_on_held_out_streets_tells_trained_from_untrained_weights(whole: Path) -> None:
    images = StreetImages(whole / "streets", 0, 1)
    assert not images.missing()
    shipped = HeldOutRecall.of(load_shipped_model(), images, DEFAULT_CLASSES)
    torch.manual_seed(0)
    network = DetectorNet(len(DEFAULT_CLASSES))
    untrained = HeldOutRecall.of(HeatmapModel.of(network, DEFAULT_CLASSES), images, DEFAULT_CLASSES)
    assert shipped.pole is not None
    assert shipped.pole > 0.8
    assert untrained.pole == 0.0
    assert shipped.losses(untrained)[0].endswith(" to 0 %")
    assert not untrained.losses(shipped)
    assert not shipped.losses(shipped)
