"""Runs of the paper's method: made, read, asked again, and looked at like any other."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from command_line import call
from inspector_page import open_flat, pixels, wait_for

from semviz.inspector.server import Inspector
from semviz.runs.diagnosis import frame_diagnosis
from semviz.runs.reader import load_run
from semviz.web.gateway import Gateway
from semviz.what_if.request_changes import UseMethod
from semviz.what_if.solve import solve_with_changes
from semviz_core.base.weights import NetworkWeights
from semviz_core.research.paper.training import PaperTask
from semviz_core.research.training.simulated_samples import PAPER_DISTRIBUTION

if TYPE_CHECKING:
    from playwright.sync_api import Page

torch.set_num_threads(1)  # samples are small: more threads would wait for each other


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A street, weights as they are before training, and a run with them."""
    return tmp_path_factory.mktemp("learned")


@pytest.fixture(scope="module")
def weights(folder: Path) -> Path:
    torch.manual_seed(0)
    task = PaperTask("paper", PAPER_DISTRIBUTION)
    tensors = {name: value.numpy() for name, value in task.network.state_dict().items()}
    NetworkWeights("paper", task.options, tensors).save(folder / "paper.safetensors")
    return folder / "paper.safetensors"


@pytest.fixture
def path(folder: Path, weights: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    path = folder / "street" / "runs" / "paper.rrd"
    if not path.exists():
        street = folder / "street"
        assert call(capsys, "new", street, "--simulate", 7, "--frames", "0:14")[0] == 0
        status, out, errors = call(
            capsys, "localize", street, "--map", "truth", "--frames", "10:14",
            "--method", "paper", "--weights", weights,
        )  # fmt: skip
        assert status == 0, errors
        assert "paper.rrd: " in out
    return path


def test_a_run_says_what_it_was_made_with_and_can_be_asked_again(path: Path, weights: Path) -> None:
    run = load_run(path)
    assert run.info.method == "paper"
    assert run.info.options["weights"] == str(weights)
    for record in run.frames:
        was, now = record.localization, solve_with_changes(run, record).localization
        assert was.match is not None
        assert now.match is not None
        assert np.array_equal(was.match.probability, now.match.probability)
        assert (was.status, was.reason) == (now.status, now.reason)
    assert solve_with_changes(run, run.frames[0], [UseMethod("search")]).localization.status == "ok"


def test_its_frames_get_diagnoses(path: Path) -> None:
    run = load_run(path)
    kinds = {frame_diagnosis(run, record).kind for record in run.frames}
    assert kinds & {"wrong matches", "search miss"}, kinds


def test_a_map_must_have_the_classes_that_were_learned(
    path: Path, weights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    street = path.parents[1]
    asked = "localize", street, "--map", "truth", "--method"
    status, _, errors = call(capsys, *asked, "bpnpnet", "--weights", weights)
    assert status == 2
    assert errors.count("\n") == 1
    assert "weights of paper; give those of bpnpnet" in errors
    status, _, errors = call(capsys, *asked, "search", "--weights", weights)
    assert (status, errors.count("\n")) == (2, 1)
    assert "search uses no weights" in errors


@pytest.mark.browser
def test_the_page_shows_matrix_image_and_diagnosis(path: Path, page: "Page") -> None:
    with Gateway(Inspector([path])).running() as url:
        open_flat(page, url, "frame=11")
        wait_for(page, lambda: pixels(page, "#matrix-canvas").std() > 5.0, "the matrix")
        assert pixels(page, "#image").std() > 5.0
