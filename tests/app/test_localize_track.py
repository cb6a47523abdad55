"""``semviz localize --track``: the demo's street followed, recorded, measured, shown."""

import io
import json
from contextlib import redirect_stdout
from typing import TYPE_CHECKING

import numpy as np
import pytest

from semviz.cli import main
from semviz.demo_street import SECTIONS, SEED, SPACING_M
from semviz.follow import Follower
from semviz.inspector.server import Inspector
from semviz.inspector.views import frame_view, run_view
from semviz.recording.reader import load_run
from semviz.recording.run import Run
from semviz.web.door import Door
from semviz.why import true_pairs
from semviz.workspace import TRUTH, Workspace
from semviz_core.elements import Elements2D
from semviz_core.evaluation.metrics import pose_error
from semviz_core.frame import Frame, Prior
from semviz_core.localization import Localization
from semviz_core.localize import Localizer
from semviz_core.pose import Pose
from semviz_core.sequence.odometry import Odometry
from semviz_core.sequence.tracker import Track
from semviz_core.sources.street.street import Street

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


def nees(one: Localization, T_camera_map: Pose) -> float:
    assert one.T_camera_map is not None
    assert one.covariance is not None
    error = (one.T_camera_map @ T_camera_map.inverse()).log()
    return float(error @ np.linalg.solve(one.covariance, error))


def test_it_starts_then_follows_and_is_as_good_as_it_says(run: Run) -> None:
    assert run.complete
    assert len(run.frames) == FRAMES
    assert run.info.method == "track"
    assert run.info.options["track"] is True
    statuses = [one.status for one in run.localizations]
    first = statuses.index("ok")
    assert 0 < first < 10
    assert set(statuses[:first]) == {"cannot"}
    assert set(statuses[first:]) == {"ok"}
    assert all(one.reason.startswith("Starting: ") for one in run.localizations[:first])
    truths = [one.frame.T_map_camera for one in run.frames]
    followed = [
        (one, truth.inverse())
        for one, truth in zip(run.localizations[first:], truths[first:], strict=True)
        if truth is not None
    ]
    assert max(pose_error(one.T_camera_map, truth)[0] for one, truth in followed) < 0.3
    assert 3.0 < np.mean([nees(one, truth) for one, truth in followed]) < 12.0


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
        status: sum(one.status == status for one in run.localizations)
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
    json.dumps(run_view("track", run), allow_nan=False)
    views = [frame_view(run, position) for position in range(FRAMES)]
    json.dumps(views, allow_nan=False)
    titles = [view["why"]["title"] for view in views]
    assert titles[0] == "Starting or lost"
    assert titles[-1] == "Healthy"


@pytest.mark.browser
def test_the_page_shows_frames_before_and_after_the_start(
    workspace: Workspace, run: Run, page: "Page"
) -> None:
    with Door(Inspector([workspace.run_path("track")])).running() as url:
        for frame, status in ((0, "Cannot"), (FRAMES - 1, "OK")):
            page.goto(f"{url}?frame={frame}")
            page.wait_for_selector(f"#status:has-text('{status}')", timeout=60_000)
            assert run.localizations[frame].reason in page.inner_text("#why-body")
        page.goto("about:blank")  # the page closes before the door does


class Lost:
    """A tracker that knows nothing any more."""

    odometry: Odometry | None = None

    def step(self, observed: Elements2D, odometry: Odometry | None, prior: Prior) -> Track:
        self.odometry = odometry
        return Track("lost", "The position is gone.", None, None, np.full(len(observed), -1))


def test_a_lost_camera_has_no_pose_and_odometry_begins_with_the_second_frame() -> None:
    street = Street(SEED)
    follower = Follower(street.rig.left, street.truth_map, Localizer(), crop_m=50.0, seed=0)
    lost = follower._tracker = Lost()  # type: ignore[assignment]
    before, now = street.frames[0], street.frames[1]
    assert before.T_map_camera is not None
    assert now.T_map_camera is not None

    found = localized(follower, street, before)
    assert (found.status, found.reason) == ("cannot", "Lost: the position is gone.")
    assert found.method == "track"
    assert found.T_camera_map is None
    assert found.refinement is None
    assert lost.odometry is None

    localized(follower, street, now)
    assert lost.odometry is not None
    step = now.T_map_camera.inverse() @ before.T_map_camera
    off = (lost.odometry.T_now_before @ step.inverse()).log()
    assert 0.0 < off @ np.linalg.solve(lost.odometry.covariance, off) < 30.0


def localized(follower: Follower, street: Street, frame: Frame) -> Localization:
    observed, _ = street.labels(frame.index, "left")
    assert frame.T_map_camera is not None
    return follower.localize(frame, observed, Prior(frame.T_map_camera.translation))
