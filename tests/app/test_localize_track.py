"""``semviz localize --track``: the demo's street followed, recorded, measured, shown."""

import io
import json
from contextlib import redirect_stdout
from time import sleep
from typing import TYPE_CHECKING

import numpy as np
import pytest
from serving import at

from semviz.cli import main
from semviz.inspector.server import Inspector
from semviz.inspector.views import frame_view, run_view
from semviz.runs.diagnosis import true_pairs
from semviz.runs.reader import load_run
from semviz.runs.run import Run
from semviz.web.gateway import Gateway
from semviz.workspace.demo import SECTIONS, SEED, SPACING_M
from semviz.workspace.localization.localize import (
    CROP_RADIUS_M,
    LocalizeOptions,
    localize_workspace,
)
from semviz.workspace.localization.sequence_tracker import SequenceTracker
from semviz.workspace.localization.simulated_measurements import simulated_odometry
from semviz.workspace.workspace import TRUTH, Workspace
from semviz_core.base.elements import Elements2D
from semviz_core.base.frame import Odometry, Prior
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose
from semviz_core.localization import localizer
from semviz_core.localization.localizer import Localizer
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.simulation.street import Street
from semviz_core.tracking.tracker import TrackedPose

if TYPE_CHECKING:
    from playwright.sync_api import Page

FRAMES = 40


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    folder = tmp_path_factory.mktemp("streets") / "street"
    return Workspace.create_street(folder, SEED, range(FRAMES), SPACING_M, SECTIONS)


@pytest.fixture(scope="module")
def said(workspace: Workspace) -> str:
    """What the command prints; it leaves ``track.rrd`` among the workspace's runs."""
    with redirect_stdout(io.StringIO()) as printed, pytest.raises(SystemExit) as ended:
        main(["localize", str(workspace.path), "--map", TRUTH, "--track"])
    assert ended.value.code == 0
    return printed.getvalue()


@pytest.fixture(scope="module")
def run(workspace: Workspace, said: str) -> Run:
    return load_run(workspace.run_path("track"))


def nees(localization: Localization, T_camera_map: Pose) -> float:
    assert localization.T_camera_map is not None
    assert localization.covariance is not None
    error = (localization.T_camera_map @ T_camera_map.inverse()).log()
    return float(error @ np.linalg.solve(localization.covariance, error))


def test_it_starts_then_follows_and_is_as_good_as_it_says(run: Run) -> None:
    assert run.complete
    assert len(run.frames) == FRAMES
    assert run.info.method == "track"
    assert run.info.options["track"] is True
    statuses = [localization.status for localization in run.localizations]
    first = statuses.index("ok")
    assert 0 < first < 10
    assert set(statuses[:first]) == {"cannot"}
    assert set(statuses[first:]) == {"ok"}
    assert all(
        localization.reason.startswith("Starting: ") for localization in run.localizations[:first]
    )
    truths = [frame.frame.T_map_camera for frame in run.frames]
    followed = [
        (localization, truth.inverse())
        for localization, truth in zip(run.localizations[first:], truths[first:], strict=True)
        if truth is not None
    ]
    assert max(pose_error(pose.T_camera_map, truth)[0] for pose, truth in followed) < 0.3
    assert 3.0 < np.mean([nees(result, truth) for result, truth in followed]) < 12.0


def test_pairs_are_recorded_with_their_residuals(run: Run) -> None:
    right = wrong = 0
    for record in run.frames:
        fine = record.localization.refinement
        if fine is None:
            continue
        assert len(fine.pairs) == len(fine.residual_px) == len(fine.inlier)
        true = set(map(tuple, true_pairs(record).tolist()))
        right += sum(tuple(pair) in true for pair in fine.pairs.tolist())
        wrong += sum(tuple(pair) not in true for pair in fine.pairs.tolist())
    assert right > 4 * FRAMES
    assert wrong < 0.02 * right


def test_numbers_are_printed_and_measured(
    run: Run, said: str, workspace: Workspace, capsys: pytest.CaptureFixture[str]
) -> None:
    counts = {
        status: sum(localization.status == status for localization in run.localizations)
        for status in ("ok", "ambiguous", "cannot")
    }
    path = workspace.run_path("track")
    assert f"{path}: {counts['cannot']} cannot, {counts['ok']} ok" in said
    with pytest.raises(SystemExit) as ended:
        main(["evaluate", str(path), "--json"])
    assert ended.value.code == 0
    numbers = json.loads(capsys.readouterr().out)
    assert numbers["status"] == counts
    assert numbers["share_below_1m"] == pytest.approx(counts["ok"] / FRAMES)


def test_the_inspector_has_words_for_every_frame(run: Run) -> None:
    assert len(run_view("track", run).frames.index) == FRAMES  # views refuse NaN when they are made
    views = [frame_view(run, position) for position in range(FRAMES)]
    titles = [view.card.title for view in views]
    assert titles[0] == "Starting or lost"
    assert titles[-1] == "Healthy"


@pytest.mark.browser
def test_the_page_shows_frames_before_and_after_the_start(
    workspace: Workspace, run: Run, page: "Page"
) -> None:
    with Gateway(Inspector([workspace.run_path("track")])).running() as url:
        for frame, status in ((0, "Cannot"), (FRAMES - 1, "OK")):
            page.goto(at(url, f"?frame={frame}"))
            page.wait_for_selector(f"#status:has-text('{status}')", timeout=60_000)
            assert run.localizations[frame].reason in page.inner_text("#why-body")
        page.goto("about:blank")  # the page closes before the door does


class Lost:
    """A tracker that knows nothing any more."""

    odometry: Odometry | None = None

    def step(self, observed: Elements2D, odometry: Odometry | None, prior: Prior) -> TrackedPose:
        self.odometry = odometry
        return TrackedPose("lost", "The position is gone.", None, None, np.full(len(observed), -1))


def test_a_lost_camera_has_no_pose() -> None:
    street = Street(SEED)
    follower = SequenceTracker(street.rig.left, street.truth_map, Localizer(), crop_m=50.0)
    lost = follower._tracker = Lost()  # type: ignore[assignment]
    frame = street.frames[0]
    assert frame.T_map_camera is not None
    observed, _ = street.labels(frame.index, "left")
    found = follower.localize(observed, Prior(frame.T_map_camera.translation), None)
    assert (found.status, found.reason) == ("cannot", "Lost: the position is gone.")
    assert found.method == "track"
    assert found.T_camera_map is None
    assert found.refinement is None
    assert lost.odometry is None


def test_simulated_odometry_is_the_true_motion_with_noise() -> None:
    before, now = Street(SEED).frames[:2]
    assert before.T_map_camera is not None
    assert now.T_map_camera is not None
    odometry = simulated_odometry(0)(before, now)
    assert odometry is not None
    step = now.T_map_camera.inverse() @ before.T_map_camera
    off = (odometry.T_now_before @ step.inverse()).log()
    assert 0.0 < off @ np.linalg.solve(odometry.covariance, off) < 30.0


@pytest.mark.parametrize("track", [False, True])
def test_no_frame_pays_for_compilation(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch, track: bool
) -> None:
    search, waits_s = localizer.search, [1.0]

    def search_compiled_first(*arguments: object) -> object:
        sleep(waits_s.pop() if waits_s else 0.0)
        return search(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(localizer, "search", search_compiled_first)
    crop_m = CROP_RADIUS_M["simulated"]
    options = LocalizeOptions(track=track, observations="simulated", crop_radius_m=crop_m)
    records = [*localize_workspace(workspace, TRUTH, options, range(3))]
    assert not waits_s
    assert max(sum(record.localization.time_ms.values()) for record in records) < 900.0
