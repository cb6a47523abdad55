"""Errors of poses and what they add up to."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.localization import Localization, Status
from semviz_core.base.pose import Pose
from semviz_core.common.errors import SemvizError
from semviz_core.metrics.pose_errors import pose_error, summarize
from semviz_core.research.evaluation.problems import CAMERA

NUMBERS = st.floats(-2.0, 2.0)
POSES = st.builds(Pose.exp, st.lists(NUMBERS, min_size=6, max_size=6).map(np.array))


@given(pose=POSES, move=st.lists(NUMBERS, min_size=3, max_size=3), angle=st.floats(0.0, 3.0))
def test_errors_are_camera_distance_and_angle(pose: Pose, move: list[float], angle: float) -> None:
    away = Pose(np.eye(3), np.array(move))
    turn = Pose.from_rotvec([0.0, angle, 0.0], np.zeros(3))  # about the camera's own centre
    rte, rre = pose_error(turn @ pose @ away, pose)
    assert rte == pytest.approx(np.linalg.norm(move), abs=1e-9)
    assert rre == pytest.approx(np.rad2deg(angle), abs=1e-4)
    assert pose_error(pose, turn @ pose @ away) == pytest.approx((rte, rre), abs=1e-6)


def result(status: Status, error_m: float, time_ms: float = 10.0) -> Localization:
    pose = None if status == "cannot" else Pose(np.eye(3), np.array([error_m, 0.0, 0.0]))
    empty = np.zeros((0, 2))
    return Localization(
        "search", CAMERA, Prior(np.zeros(3)),
        Elements2D.from_ends(empty, empty, []),
        Elements3D.from_ends([], np.zeros((0, 3)), np.zeros((0, 3)), []),
        status, "because", pose, None, time_ms={"search": time_ms},
    )  # fmt: skip


TRUE = Pose.identity()


def test_summary_counts_every_frame_with_truth() -> None:
    results = [result("ok", 0.1), result("ok", 0.3), result("ambiguous", 5.0), result("cannot", 0)]
    summary = summarize(results, [TRUE] * 4)
    values = summary.as_json()

    assert values["frames"] == 4
    assert values["status"] == {"ok": 2, "ambiguous": 1, "cannot": 1}
    assert values["rte_m"]["q2"] == pytest.approx(0.3)  # of the three with a pose
    assert values["rte_m"]["mean"] == pytest.approx(1.8)
    assert values["share_below_1m"] == pytest.approx(0.5)  # of all four
    assert values["share_below_1deg"] == pytest.approx(0.75)
    assert values["by_status"]["ok"]["share_below_1m"] == 1.0
    assert values["time_ms"] == {"median": 10.0, "p95": 10.0}
    assert json.loads(json.dumps(values)) == values


def test_frames_without_truth_have_no_error() -> None:
    summary = summarize([result("ok", 0.2), result("ok", 0.4)], [TRUE, None])
    assert summary.accuracy.rte_m.q2 == pytest.approx(0.2)
    assert summary.accuracy.share_below_1m == 1.0
    assert summarize([result("ok", 0.2)], [None]).accuracy.share_below_1m is None


def test_a_run_without_poses_shows_no_numbers_for_errors() -> None:
    summary = summarize([result("cannot", 0.0)], [TRUE])
    assert summary.accuracy.rte_m.mean is None
    assert summary.accuracy.share_below_1m == 0.0
    assert "-" in summary.as_text()
    assert "0.000" not in summary.as_text().splitlines()[1]


def test_empty_run() -> None:
    values = summarize([], []).as_json()
    assert values["frames"] == 0
    assert values["time_ms"] == {"median": None, "p95": None}


def test_rows_for_tables() -> None:
    rows = summarize([result("ok", 0.2)], [TRUE]).rows()
    assert [row["status"] for row in rows] == ["all", "ok", "ambiguous", "cannot"]
    assert rows[1]["rte_m_q2"] == pytest.approx(0.2)


def test_truths_must_match_results() -> None:
    with pytest.raises(SemvizError, match="not as many true poses"):
        summarize([result("ok", 0.1)], [])
