"""A new user's first minute: ``semviz serve`` makes the demo and shows why frames fail."""

import io
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image
from serving import at, serving

from semviz.runs.reader import load_run
from semviz.runs.run import Run
from semviz.workspace.demo import FAR_OFF_FRAMES, MAP, MOVED_IN_FRAMES, RUN
from semviz.workspace.workspace import TRUTH, Workspace
from semviz_core.base.map_file import load_map
from semviz_core.metrics.pose_errors import pose_error

if TYPE_CHECKING:
    from playwright.sync_api import Page

TOO_FEW_FRAMES = range(38, 44)
ROW_FRAMES = range(96, 106)


@pytest.fixture(scope="module")
def address(environment: dict[str, str]) -> Iterator[str]:
    """Of ``semviz serve`` with nothing given, once it says that it listens."""
    with serving([sys.executable, "-m", "semviz.cli", "serve"], environment) as address:
        yield address


@pytest.fixture(scope="module")
def workspace(address: str, environment: dict[str, str]) -> Workspace:
    (folder,) = Path(environment["XDG_CACHE_HOME"]).glob("semviz/demo-*")
    return Workspace.open(folder)


@pytest.fixture(scope="module")
def run(workspace: Workspace) -> Run:
    return load_run(workspace.run_path(RUN))


def reasons(run: Run, frames: range, status: str) -> list[str]:
    chosen = [frame.localization for frame in run.frames if frame.frame.index in frames]
    return [result.reason for result in chosen if result.status == status]


def further_off_than_said(workspace: Workspace) -> list[int]:
    """Ids of the elements that the map has a metre and three sigma from where they stand."""
    truth, shown = (load_map(workspace.map_path(name)).elements for name in (TRUTH, MAP))
    stands_m = truth.anchor_m[np.searchsorted(truth.id, shown.id)]
    shift_m = np.linalg.norm((shown.anchor_m - stands_m)[:, :2], axis=1)
    sigma_m = np.sqrt(shown.covariance_m2[:, [0, 1], [0, 1]].sum(axis=1))
    return shown.id[(shift_m > 1.0) & (shift_m > 3.0 * sigma_m)].tolist()


def errors_m(run: Run) -> dict[int, float]:
    """Of the frames answered ``ok``."""
    return {
        frame.frame.index: pose_error(found.T_camera_map, truth.inverse())[0]
        for frame, found in zip(run.frames, run.localizations, strict=True)
        if found.status == "ok"
        and found.T_camera_map is not None
        and (truth := frame.frame.T_map_camera) is not None
    }


@pytest.mark.timeout(400)
def test_frames_fail_for_the_reasons_that_were_planted(workspace: Workspace, run: Run) -> None:
    assert run.complete
    too_few = reasons(run, TOO_FEW_FRAMES, "cannot")
    assert len(too_few) >= 4
    assert all("needed" in reason for reason in too_few)
    assert len(reasons(run, FAR_OFF_FRAMES, "ok")) == 0
    ambiguous = reasons(run, ROW_FRAMES, "ambiguous")
    assert len(ambiguous) >= 7
    assert all("poses fit" in reason for reason in ambiguous)
    (moved,) = further_off_than_said(workspace)
    errors = errors_m(run)
    hurt = [
        frame.frame.index
        for frame in run.frames
        if moved in frame.element_id
        and len(frame.element_id) >= 4
        and errors.get(frame.frame.index, np.inf) > 1.0
    ]
    assert set(hurt) & set(MOVED_IN_FRAMES)


def test_most_frames_are_right_and_none_is_sure_and_wrong(run: Run) -> None:
    errors = errors_m(run)
    assert len(errors) > len(run.frames) / 2
    assert np.median(list(errors.values())) < 0.1
    assert max(errors.values()) < 0.5


@pytest.mark.browser
@pytest.mark.timeout(400)
def test_the_page_shows_what_the_run_holds(address: str, run: Run, page: "Page") -> None:
    page.goto(at(address, f"?frame={ROW_FRAMES[0]}"))
    page.wait_for_selector("#frame-list li", timeout=60_000)
    page.wait_for_selector("#why-body:has-text('poses fit')", timeout=60_000)
    (record,) = [frame for frame in run.frames if frame.frame.index == ROW_FRAMES[0]]
    assert page.inner_text("#status") == "Ambiguous"
    assert record.localization.reason in page.inner_text("#why-body")
    assert f"All {len(run.frames)}" in page.inner_text("#filters").replace("\n", " ")
    assert record.localization.T_camera_map is not None
    assert record.frame.T_map_camera is not None
    rte_m, _ = pose_error(record.localization.T_camera_map, record.frame.T_map_camera.inverse())
    assert f"{rte_m:.2f} m" in page.inner_text("#numbers")
    hopeless = next(frame for frame in run.frames if frame.localization.status == "cannot")
    page.goto(at(address, f"?frame={hopeless.frame.index}"))
    page.wait_for_selector("#status:has-text('Cannot')", timeout=60_000)
    assert hopeless.localization.reason in page.inner_text("#why-body")
    assert page.locator("#scene").is_visible()
    canvas = io.BytesIO(page.locator("#image-canvas").screenshot())
    assert np.asarray(Image.open(canvas).convert("RGB")).std() > 20
