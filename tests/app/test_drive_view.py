"""The view "Your drive" of the labelling page: checks of the import, matches, what to do."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from annotator_page import Served, annotating
from recorded_streets import LENSES, record
from streets import street, street_workspace

from semviz.annotator.drive.drive_view import drive_pair, drive_view
from semviz.cli import main
from semviz.workspace.drive.drive_check_file import CHECKS
from semviz.workspace.workspace import Workspace
from semviz_core.base.camera import Rig
from semviz_core.base.pose import so3_exp
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.own_drive.images.image_folder import ImageFolder

if TYPE_CHECKING:
    from playwright.sync_api import Page


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """Two frames; the right camera has been pitched by 0.2 deg since its calibration."""
    folder = tmp_path_factory.mktemp("drive")
    source = street(3, 6)
    pitched = so3_exp(np.deg2rad([0.2, 0.0, 0.0]))
    recording = record(folder, source, LENSES["brown"], range(2), pitched)
    straight = record(folder / "straight", source, LENSES["brown"], range(0))
    words = (
        "new", folder / "town", "--images", recording.left, "--right", recording.right,
        "--calibration", straight.kalibr, "--poses", recording.poses,
    )  # fmt: skip
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    assert not ended.value.code
    return Workspace.open(folder / "town")


def test_what_failed_comes_first_with_the_command_that_repairs_it(town: Workspace) -> None:
    view = drive_view(town, town.source)
    assert view.title == "Your drive can be labelled. One step first."
    assert view.sentence.startswith("Rows of both images are 2.")
    assert not view.is_sound
    assert [check.name for check in view.checks if check.passed is False] == ["rows agree"]
    first, *others = view.steps
    assert first.title == "Refine the extrinsics"
    assert first.command.startswith("semviz new ")
    assert first.command.endswith("--refine-extrinsics")
    assert [step.title for step in others] == ["Have a detector look", "Label", "Build the map"]
    assert [fact.value for fact in view.facts] == ["2", "1.0 m", "2 cameras", "0.540 m"]
    assert len(view.places_m) == len(view.frames) == 2


def test_matches_show_how_far_they_are_off_their_row_or_epipolar_line(town: Workspace) -> None:
    pair = drive_pair(town.source, 0)
    assert pair.second == 0
    assert np.median([match.off_px for match in pair.matches]) == pytest.approx(2.1, abs=0.3)
    assert all(pair.edges)
    source = town.source
    assert isinstance(source, ImageFolder)
    alone = replace(source, rectified=replace(source.rectified, rig=Rig(source.rig.left)))
    last = drive_pair(alone, 1)
    assert "no next image" in last.note
    assert not last.matches
    by_poses = drive_pair(alone, 0)
    assert by_poses.second == 1
    assert np.median(np.abs([match.off_px for match in by_poses.matches])) < 0.5
    near = [  # the same corners, by rows and by poses
        (one.depth_m, other.depth_m)
        for one in pair.matches
        for other in by_poses.matches
        if np.hypot(*np.subtract(one.here, other.here)) < 0.1
        and one.depth_m is not None and other.depth_m is not None and one.depth_m < 15.0
    ]  # fmt: skip
    assert len(near) > 20
    by_rows_m, by_poses_m = np.array(near).T
    assert np.median(np.abs(by_rows_m / by_poses_m - 1.0)) < 0.2


def test_a_drive_without_checks_says_so_and_a_damaged_file_is_named(tmp_path: Path) -> None:
    workspace = street_workspace(tmp_path / "town", 7, 3)
    assert drive_view(workspace, workspace.source).sentence == "It was not checked at an import."
    (workspace.path / "checks").mkdir()
    (workspace.path / CHECKS).write_text("{}")
    with pytest.raises(SemvizError, match=r"checks\.json: damaged"):
        drive_view(workspace, workspace.source)


@pytest.fixture
def served(town: Workspace) -> Iterator[Served]:
    with annotating(town) as served:
        yield served


@pytest.mark.browser
def test_the_page_shows_the_worst_check_first(served: Served, page: "Page") -> None:
    mark = "&" if "?" in served.url else "?"
    page.goto(f"{served.url}{mark}view=drive")
    page.wait_for_selector('#drive-head h2:has-text("One step first")')
    assert "Rows agree" in page.inner_text("#drive-checks .row.chosen")
    page.wait_for_selector('#drive-about:has-text("px off their row")')
    page.keyboard.press("2")
    page.wait_for_selector('#drive-about:has-text("long edges, median bend")')
    page.keyboard.press("3")
    page.wait_for_selector('#drive-about:has-text("depth of")')
    page.click('#drive-kinds button:has-text("Rows")')
    page.wait_for_selector('#drive-about:has-text("px off their row")')
    page.keyboard.press(",")
    page.wait_for_selector('#drive-about:has-text("frame 0 left and right")')
    page.keyboard.press("j")
    page.wait_for_selector('#drive-about:has-text("frame 1 left and right")')
    page.keyboard.press("F2")
    page.wait_for_selector("#left-image canvas.marks")
    assert not page.is_visible("#drive")
    page.keyboard.press("F9")
    page.wait_for_selector("#drive-steps .drive-step")
    page.click('#drive-steps button:has-text("Start")')
    page.wait_for_selector('#tab-images[aria-current="true"]')
