"""``semviz localize --rig``: what belongs together of a drive's cameras, and what does not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import call
from labelled_street import label_street

from semviz.runs.reader import load_run
from semviz.workspace.drive.rig_views import OtherCamera, rig_views
from semviz.workspace.workspace import TRUTH, Workspace
from semviz_core.base.camera import Camera
from semviz_core.base.elements import Elements2D
from semviz_core.base.frame import Frame, Odometry
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.localization.camera_views import STANDING

FRAMES = 6
CAMERA = Camera(640, 480, np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]))


def one_seen(frame: Frame) -> tuple[Elements2D, IntArray]:
    return Elements2D.from_ends([[1.0, 2.0]], [[1.0, 9.0]], [0]), np.zeros(1, dtype=np.int64)


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    folder = tmp_path_factory.mktemp("streets") / "street"
    workspace = Workspace.create_street(folder, 5, range(FRAMES))
    label_street(workspace, workspace.street, range(FRAMES))
    return workspace


def test_both_images_of_a_stereo_pair_give_one_pose(
    street: Workspace, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, words in {"alone": (), "pair": ("--rig",)}.items():
        run = tmp_path / f"{name}.rrd"
        options = ("--map", TRUTH, "--observations", "labels", "--out", run, "--images", "none")
        assert call(capsys, "localize", street.path, *options, *words)[0] == 0
    alone, pair = (load_run(tmp_path / f"{name}.rrd").frames for name in ("alone", "pair"))
    both = 0
    for one, two in zip(alone, pair, strict=True):
        left, found = one.localization, two.localization
        np.testing.assert_array_equal(left.observed.anchor_px, found.observed.anchor_px)
        if left.status == found.status == "ok":
            both += 1
            assert left.covariance is not None
            assert found.covariance is not None
            assert found.reason.startswith("2 cameras: ")
            assert np.trace(found.covariance[:3, :3]) < np.trace(left.covariance[:3, :3])
    assert both > 1


def test_an_image_too_far_in_time_is_left_out() -> None:
    frames = tuple(Frame(10 + k, 0.5 * k + 0.03) for k in range(3))
    other = OtherCamera(CAMERA, Pose.identity(), frames, one_seen)

    def late_s(time_s: float, moves: bool = True) -> float | None:
        view = other.view_at(Frame(0, time_s), STANDING if moves else None, lambda stated: stated)
        return None if view is None else float(np.asarray(view.time_s)[0, 0])

    assert late_s(0.5) == pytest.approx(0.03)
    assert late_s(0.6) == pytest.approx(-0.07)
    assert late_s(0.75) is None
    assert late_s(9.0) is None
    assert late_s(0.5, moves=False) is None
    assert late_s(0.5295, moves=False) == pytest.approx(0.0005)


def test_motion_is_that_of_the_step_before_or_else_after(street: Workspace) -> None:
    frames = street.source.frames

    def odometry_of(before: Frame, now: Frame) -> Odometry | None:
        if now.index == 4:
            return None
        return Odometry(Pose(np.eye(3), [0.0, 0.0, -0.1 * now.index]), 1e-4 * np.eye(6))

    rig = rig_views(street.source, frames, lambda side="left": one_seen, odometry_of)
    step_s = frames[1].time_s - frames[0].time_s
    ahead = {index: rig.motion_of[index].velocity_mps[2] * step_s for index in rig.motion_of}
    assert ahead == pytest.approx({0: 0.1, 1: 0.1, 2: 0.2, 3: 0.3, 4: 0.5, 5: 0.5})


def test_one_camera_is_no_rig(street: Workspace) -> None:
    class OneCamera:
        rig = replace(street.source.rig, right=None, T_right_left=None)

    with pytest.raises(SemvizError, match="the drive has one camera; leave out --rig"):
        rig_views(OneCamera(), (), lambda: one_seen, lambda *_: None)  # type: ignore[arg-type]
