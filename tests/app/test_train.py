"""semviz train and semviz weights: trained, gone on with, and kept with a card."""

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
import torch
from command_line import Call, call
from safetensors.torch import load_file

from semviz_core.research.training.trainer import CHECKPOINT, HISTORY

TINY = ("--batch", 4, "--held-out", 4, "--workers", 0)


@pytest.fixture
def train(capsys: pytest.CaptureFixture[str]) -> Call:
    """Exit status, output and error output of ``semviz train``."""
    return partial(call, capsys, "train")


def test_the_same_command_goes_on_as_if_it_had_not_stopped(train: Call, tmp_path: Path) -> None:
    """With the paper's own task, to where its pose loss counts too."""
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert train("paper", "--out", whole, "--samples", 12, *TINY)[0] == 0
    for _ in range(9):  # each goes on for one step
        status, output, _ = train(
            "paper", "--out", parts, "--samples", 12, "--stop-after-s", 0, *TINY
        )
        assert status == 0
        if "finished" in output:
            break
        assert "next: the same command goes on" in output
    file, other = load_file(whole / CHECKPOINT), load_file(parts / CHECKPOINT)
    assert file.keys() == other.keys()
    assert all(torch.equal(file[name], other[name]) for name in file)
    assert (whole / HISTORY).read_text() == (parts / HISTORY).read_text()
    assert (parts / "losses.png").read_bytes().startswith(b"\x89PNG")


def test_weights_have_a_card(
    train: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    training, folder = tmp_path / "training", tmp_path / "weights"
    train("bpnpnet", "--out", training, "--samples", 8, "--seed", 3, *TINY)
    status, output, _ = call(capsys, "weights", training, "--out", folder)
    assert status == 0
    weights, card = (
        folder / "bpnpnet.safetensors",
        json.loads((folder / "bpnpnet.json").read_text()),
    )
    assert f"{weights}: 2." in output
    assert card["sha256"] == hashlib.sha256(weights.read_bytes()).hexdigest()
    assert (card["task"], card["seed"], card["samples"], card["steps"]) == ("bpnpnet", 3, 8, 2)
    assert card["options"]["classes"][0] == "pole"
    assert card["options"]["data"]["roads"] == "simulated"
    assert card["held_out"]["items"] == 4
    assert card["parameters"] == sum(value.numel() for value in load_file(weights).values())
    assert card["wall_s"] == pytest.approx(sum(card["machines"].values()))
    assert str(tmp_path) not in json.dumps(card)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_everybody_saves_first(number: signal.Signals, tmp_path: Path) -> None:
    """Ctrl-C in a terminal, and whoever ends a service, reach the workers too."""
    out = tmp_path / "training"
    command = [Path(sys.executable).with_name("semviz"), "train", "paper", "--out", out]
    child = subprocess.Popen(
        [*command, "--samples", "4000", "--batch", "4", "--held-out", "4"],
        start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    deadline = time.monotonic() + 120.0
    while not (out / HISTORY).is_file() or not (out / HISTORY).stat().st_size:
        assert child.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    os.killpg(child.pid, number)
    output, errors = child.communicate(timeout=60)
    assert child.returncode == 130
    assert "interrupted after" in output
    assert "Traceback" not in errors
    assert (out / CHECKPOINT).is_file()


def test_weights_of_no_training(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, _, errors = call(capsys, "weights", tmp_path, "--out", tmp_path)
    assert status == 2
    assert "no training; 'semviz train' makes one" in errors


def test_another_model_in_the_same_folder_is_refused(train: Call, tmp_path: Path) -> None:
    assert train("paper", "--out", tmp_path, "--samples", 4, *TINY)[0] == 0
    before = (tmp_path / CHECKPOINT).read_bytes()
    status, _, errors = train("bpnpnet", "--out", tmp_path, "--samples", 4, *TINY)
    assert status == 2
    assert "of another training (task was paper, is bpnpnet;" in errors
    assert errors.count("\n") == 1
    assert (tmp_path / CHECKPOINT).read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("resnet",), "nothing called resnet can be trained; there are paper, "),
        (("paper", "--batch", "0"), "--batch 0: give 1 to 1000"),
        (("paper", "--kitti-poses", "poses"), "give both"),
        (("paper", "--suite", "paper-20m", "--workspace", "w"), "give one of them"),
        (("deepi2p-pixels", "--suite", "paper-20m"), "trains on its own streets"),
    ],
)
def test_what_makes_no_sense_is_one_line(
    train: Call, tmp_path: Path, arguments: tuple[str, ...], line: str
) -> None:
    status, output, errors = train(*arguments, "--out", tmp_path / "out")
    assert (status, output) == (2, "")
    assert line in errors
    assert errors.count("\n") == 1
    assert not (tmp_path / "out").exists()
