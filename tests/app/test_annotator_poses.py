"""The view "Poses" of the labelling page: what is wrong, three answers, preview, undo."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from annotator_page import Served
from journeys.driver import LabelDriver
from turned_drive import TURNED, drive, labels, measured_town, wrong_poses

from semviz.annotator.drive import pose_views
from semviz.reports.pose_check import check_text
from semviz.workspace.poses.pose_review import check_poses, known_check, motions_path
from semviz.workspace.workspace import Workspace
from semviz_core.base.frame import Frame
from semviz_core.pose_checks.faults import PoseCheck

if TYPE_CHECKING:
    from playwright.sync_api import Page

__all__ = ["drive", "labels", "measured_town", "wrong_poses"]
pytestmark = pytest.mark.browser
FAULT = "Poses 5–7 are turned"
WAIT_MS = 180_000
"""Motions of 12 pairs of images take seconds, on a busy machine a minute."""


@pytest.fixture
def workspace(measured_town: Path, tmp_path: Path) -> Workspace:
    """The motions of its images are measured."""
    return Workspace.open(shutil.copytree(measured_town, tmp_path / "town"))


@pytest.fixture  # asked for before the page
def unmeasured(workspace: Workspace) -> Workspace:
    motions_path(workspace).unlink()
    return workspace


@pytest.fixture
def poses(served: Served, page: "Page") -> LabelDriver:
    driver = LabelDriver(page)
    driver.open(served.url)
    return driver


def turned_deg(frames: tuple[Frame, ...]) -> float:
    """How far frame 6 is turned against the frame before the turned ones."""
    T = {frame.index: frame.T_map_camera for frame in frames}
    before, now = T[4], T[6]
    assert before is not None
    assert now is not None
    return float(np.rad2deg(np.linalg.norm((before.inverse() @ now).log()[3:])))


def used_poses(served: Served) -> tuple[Frame, ...]:
    return tuple(served.annotator.session.frames.values())


def wait_for_title(page: "Page", title: str) -> None:
    page.wait_for_selector(f"#pose-wrong h3:has-text('{title}')", timeout=WAIT_MS)


def test_a_turned_stretch_is_measured_refined_and_undone(
    unmeasured: Workspace, poses: LabelDriver, served: Served
) -> None:
    page = poses.page
    given = turned_deg(unmeasured.given_source.frames)
    assert page.locator("#tab-mark").is_hidden()
    page.keyboard.press("F4")
    assert "view=poses" in page.url
    wait_for_title(page, FAULT)
    assert page.locator("#tab-mark").is_visible()
    sentence = page.locator("#pose-wrong .pose-text p").inner_text()
    assert "elements jump together" in sentence
    assert "That is the pose, not the labels: the camera is turned by up to 0.7" in sentence
    page.keyboard.press("Shift+F")
    page.wait_for_selector("#pose-bar:has-text('Nothing is changed.')")
    assert not unmeasured.pose_choices_path.exists()
    page.keyboard.press("Escape")
    page.wait_for_selector("#pose-bar", state="hidden")
    assert "view=poses" in page.url
    page.keyboard.press("Shift+F")
    page.keyboard.press("Control+Enter")
    page.wait_for_selector("#pose-answers b:has-text('Refined poses are used')", timeout=WAIT_MS)
    assert page.locator("#tab-mark").is_hidden()
    assert turned_deg(used_poses(served)) < given - 0.5
    page.keyboard.press("Control+z")
    page.wait_for_selector("#tab-mark:not([hidden])", timeout=WAIT_MS)
    assert turned_deg(used_poses(served)) == pytest.approx(given)
    page.keyboard.press("Control+Shift+Z")
    page.wait_for_selector("#tab-mark", state="hidden", timeout=WAIT_MS)
    assert turned_deg(used_poses(served)) < given - 0.5


@pytest.fixture  # asked for before the page
def dark(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> PoseCheck:
    """A check of a drive whose images show nothing from frame 8 to 10."""
    check = known_check(workspace)
    assert check is not None
    compared = check.comparison.compared.copy()
    compared[8:10] = False
    check = replace(check, comparison=replace(check.comparison, compared=compared))
    monkeypatch.setattr(pose_views, "known_check", lambda _: check)
    return check


def test_a_stretch_without_evidence_is_said_as_such(dark: PoseCheck, poses: LabelDriver) -> None:
    said = "too little evidence to check the poses of frames 8 to 10"
    assert dark.unchecked == ((8, 10),)
    assert said in check_text(dark, [""] * len(dark.faults))
    poses.page.keyboard.press("F4")
    poses.page.wait_for_selector(f"#pose-count:has-text('{said}')", timeout=WAIT_MS)


def test_the_address_leads_to_the_view_whose_keys_draw_nothing(
    poses: LabelDriver, served: Served, workspace: Workspace
) -> None:
    check_poses(workspace, workspace.given_source.frames, lambda what, done, of: None)
    page = poses.page
    page.goto(served.url.split("?")[0] + "?frame=6&view=poses")
    wait_for_title(page, FAULT)
    count = len(served.labels.observations)
    for key in ("Delete", "x", "Shift+Delete", "Enter", "c"):
        page.keyboard.press(key)
    page.wait_for_selector("#pose-after .status:has-text('median')")
    before, after = (
        float(page.locator(f"#pose-{name} .status").inner_text().split()[-2])
        for name in ("before", "after")
    )
    assert before > 4.0
    assert after < 1.0
    page.keyboard.press("Space")
    page.wait_for_selector("#pose-before h2:has-text('After')")
    page.keyboard.press("Shift+O")
    page.wait_for_selector("#pose-bar:has-text('labels stay and do not count')")
    page.keyboard.press("Control+Enter")
    page.wait_for_selector("#pose-answers b:has-text('These frames are left out')", timeout=WAIT_MS)
    assert all(served.annotator.session.frames[index].left_out for index in TURNED)
    assert len(served.labels.observations) == count
    page.keyboard.press("F2")
    assert "view=poses" not in page.url
    poses.settle()
    page.wait_for_selector("#left-image")


def test_a_choice_made_elsewhere_is_used_at_once(
    poses: LabelDriver, served: Served, workspace: Workspace
) -> None:
    from semviz.workspace.poses.pose_review import PoseReview, choose_poses

    check = check_poses(workspace, workspace.given_source.frames, lambda what, done, of: None)
    review = PoseReview.of(workspace, check, workspace.read_labels())
    choose_poses(review, "leave out", (5, 7, "frames"), "jon")
    poses.page.wait_for_function(
        "() => semviz.poses.stretches[0]?.chosen_by === 'jon'", timeout=WAIT_MS
    )
    assert served.annotator.session.frames[6].T_map_camera is None
    poses.page.keyboard.press("Control+z")  # it is jon's, not ours
    poses.page.wait_for_selector("#message:not([hidden])")
    assert served.annotator.session.frames[6].T_map_camera is None


def test_the_list_of_commands_leads_back_to_the_images(poses: LabelDriver) -> None:
    page = poses.page
    page.keyboard.press("F4")
    page.keyboard.press("Control+k")
    page.locator("dialog.palette input").fill("loupe")
    page.keyboard.press("Enter")
    page.wait_for_selector("#left-image")
    page.keyboard.press("Control+k")
    page.locator("dialog.palette input").fill("refine")
    page.keyboard.press("Enter")
    page.wait_for_selector("#poses")
