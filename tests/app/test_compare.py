"""``semviz compare``: what is fixed and broken, what differs, and gates that cannot be fooled."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from command_line import Call, call
from hypothesis import given
from hypothesis import strategies as st
from small_runs import FRAMES, ambiguous, off_by, saved, small_run, spoiled, unanswered
from small_runs import without_truth as untold

from semviz.runs.comparison import compare_runs
from semviz.runs.differences import map_changes, setups
from semviz.runs.metrics import MAX_LENGTH, parse_condition, summarize_run, trend
from semviz.runs.run import Run
from semviz.runs.table_metrics import metrics_of
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame
from semviz_core.common.errors import SemvizError


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Call:
    """Exit status, output and error output of ``semviz compare``."""
    return partial(call, capsys, "compare")


def spoiled_pair() -> tuple[Run, Run]:
    """In the other run 12 is fixed; 14, 16 and 18 are broken; 10 and 20 are the same."""
    base = spoiled(small_run(), {12: unanswered, 20: unanswered})
    other = {14: off_by(1.2), 16: ambiguous, 18: unanswered, 20: off_by(3.0)}
    return base, spoiled(small_run(), other)


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("runs")
    base, other = spoiled_pair()
    return saved(base, folder / "base.rrd"), saved(other, folder / "other.rrd")


def test_fixed_broken_and_same_are_told_apart() -> None:
    comparison = compare_runs(*spoiled_pair())
    assert [frame.index for frame in comparison.of("fixed")] == [12]
    assert [frame.index for frame in comparison.of("broken")] == [14, 16, 18]
    assert [frame.index for frame in comparison.of("same")] == [10, 20]
    broken = comparison.of("broken")[0].errors
    assert broken[0] is not None
    assert broken[1] is not None
    assert broken[0].distance_m < 0.2
    assert broken[1].distance_m == pytest.approx(1.2)


def test_a_run_is_the_same_as_itself_and_the_other_way_round_swaps() -> None:
    base, other = spoiled_pair()
    itself = compare_runs(base, base)
    assert len(itself.of("same")) == len(FRAMES)
    assert not itself.differences
    assert itself.base == itself.other
    there, back = compare_runs(base, other), compare_runs(other, base)
    assert [frame.index for frame in there.of("fixed")] == [
        frame.index for frame in back.of("broken")
    ]
    assert (there.base, there.other) == (back.other, back.base)


def test_without_truth_the_status_decides_and_that_is_said() -> None:
    base, other = (untold(run) for run in spoiled_pair())
    comparison = compare_runs(base, other)
    assert [frame.index for frame in comparison.of("broken")] == [16, 18]
    assert [frame.index for frame in comparison.of("fixed")] == [12, 20]
    assert comparison.notes == ("6 of 6 frames have no true pose: compared by status alone",)
    assert comparison.other["median_rte_m"] is None
    one_side = compare_runs(base, spoiled_pair()[1])
    assert [frame.index for frame in one_side.of("fixed")] == [12, 20]


def test_metrics_are_those_of_evaluate_over_the_frames_in_both() -> None:
    base, other = spoiled_pair()
    fewer = replace(other, frames=other.frames[:4])
    comparison = compare_runs(base, fewer)
    summary = summarize_run(replace(base, frames=base.frames[:4]))
    assert comparison.base["median_rte_m"] == pytest.approx(summary.accuracy.rte_m.q2, rel=1e-9)
    assert comparison.base["q3_rre_deg"] == pytest.approx(summary.accuracy.rre_deg.q3, rel=1e-9)
    assert comparison.base["share_below_1m"] == summary.accuracy.share_below_1m == 0.75
    assert comparison.base["coverage"] == 0.75
    assert comparison.other["share_sure_and_wrong"] == 0.25
    assert comparison.other["frames"] == 4.0
    assert comparison.only_base == (18, 20)
    assert comparison.notes == ("2 frames are only in the base, and left out",)
    turned = compare_runs(fewer, base)
    assert (turned.base, turned.other) == (comparison.other, comparison.base)
    assert turned.notes == ("2 frames are only in the other run, and left out",)


def test_settings_and_maps_that_differ_are_told() -> None:
    base = small_run()
    moved = base.semantic_map.elements.anchor_m.copy()
    moved[0, 0] += 0.5
    elements = replace(base.semantic_map.elements, anchor_m=moved)
    info = replace(base.info, method="direct", options={"noise": "paper"})
    other = replace(base, info=info, semantic_map=replace(base.semantic_map, elements=elements))
    comparison = compare_runs(base, other)
    told = {
        difference.what: (difference.base, difference.other)
        for difference in comparison.differences
    }
    assert told.keys() == {"method", "map", "noise"}
    assert told["method"] == ("search", "direct")
    assert comparison.maps is not None
    assert len(comparison.maps.moved) == 1


def test_map_changes_come_with_the_frames_that_saw_them() -> None:
    base = spoiled(small_run(), {12: unanswered})
    other = spoiled(small_run(), {14: off_by(1.2), 16: ambiguous})
    elements = base.semantic_map.elements
    seen = [set(frame.element_id.tolist()) for frame in base.frames]  # of frames 10, 12, 14, ...
    row = next(at for at, id in enumerate(elements.id.tolist()) if id in seen[1] & seen[2])
    anchor, end = elements.anchor_m.copy(), elements.end_m.copy()
    anchor[row, 0] += 0.5
    end[row, 0] += 0.5
    unseen = int(elements.id[~np.isin(elements.id, np.array([*set().union(*seen)]))][0])
    kept = replace(elements, anchor_m=anchor, end_m=end)[elements.id != unseen]
    other = replace(other, semantic_map=replace(other.semantic_map, elements=kept))
    moved, removed = map_changes(compare_runs(base, other), base, other)
    assert (moved.kind, moved.base_ids, moved.other_ids) == (
        "moved",
        *[(int(elements.id[row]),)] * 2,
    )
    assert moved.moved_m == pytest.approx(0.5)
    assert 14 in moved.broken
    assert moved.fixed == (12,)
    assert (removed.kind, removed.base_ids, removed.other_ids) == ("removed", (unseen,), ())
    assert (removed.broken, removed.fixed) == ((), ())
    assert map_changes(compare_runs(base, base), base, base) == ()


def test_what_runs_were_made_with_side_by_side() -> None:
    base = small_run()
    assert all(setup.base == setup.other for setup in setups(base, base))
    first = replace(base.frames[0], image=b"one")
    pictured = replace(base, frames=(first, *base.frames[1:]))
    info = replace(base.info, method="direct", options={"noise": "paper"}, map_name="newer")
    elements = base.semantic_map.elements[:-1]
    fewer = replace(base.semantic_map, elements=elements, operation=9)
    again = replace(pictured.frames[0], image=b"two")
    other = replace(base, info=info, semantic_map=fewer, frames=(again, *base.frames[1:]))
    told = {setup.what: setup[1:] for setup in setups(pictured, other) if setup.base != setup.other}
    assert told == {
        "Map": ("street", "newer"),
        "Labels": ("none", "operation 9"),
        "Method": ("search", "direct"),
        "noise": ("-", "paper"),
        "Images": ("1 frame", "1 frame, 1 different"),
    }


@pytest.mark.parametrize(
    ("name", "base", "other", "expected"),
    [
        ("median_rte_m", 0.1, 0.2, "worse"),
        ("median_rte_m", 0.2, 0.1, "better"),
        ("coverage", 0.5, 0.4, "worse"),
        ("share_below_1m", 0.5, 0.6, "better"),
        ("share_ambiguous", 0.1, 0.2, "same"),
        ("p95_time_ms", 8.0, 8.0, "same"),
        ("median_rte_m", None, 0.1, "same"),
    ],
)
def test_better_and_worse(name: str, base: float | None, other: float, expected: str) -> None:
    assert trend(name, base, other) == expected


def test_json_is_as_promised(command: Call, pair: tuple[Path, Path]) -> None:
    status, output, errors = command(*pair, "--json", "--fail-if", "broken > 2")
    told = json.loads(output)
    assert (status, errors) == (1, "")
    assert (told["base"], told["other"]) == tuple(map(str, pair))
    assert (told["fixed"], told["broken"], told["same"]) == ([12], [14, 16, 18], 2)
    assert told["failed"] == ["broken > 2"]
    assert told["metrics"]["coverage"]["base"] == pytest.approx(4 / 6)
    assert told["metrics"].keys() == metrics_of(small_run()).keys()
    assert told["diagnoses"]["healthy"] == {"base": 4, "other": 2}
    assert [frame["frame"] for frame in told["each"]] == list(FRAMES)
    named = [frame["base"]["diagnosis"] for frame in told["each"]]
    assert named.count("healthy") == told["diagnoses"]["healthy"]["base"]
    apart = [frame["apart_m"] for frame in told["each"] if frame["apart_m"] is not None]
    assert told["apart_m"] == {"median": np.median(apart), "max": max(apart)}
    assert max(apart) > 1.0


@pytest.mark.parametrize(
    ("condition", "status"),
    [
        ("median_rte_m > 1.05*base", 1),
        ("median_rte_m > 1000*base", 0),
        ("broken > 2", 1),
        ("diagnosed_healthy < base", 1),
        ("diagnosed_time_offset > 0", 0),
        ("broken > 3", 0),
        ("max_apart_m > 1", 1),
        ("median_apart_m > 100", 0),
        ("coverage < base", 0),  # four of six in both
        ("coverage <= base", 1),
        ("0.1 < coverage < 0.5", 0),
        ("-(share_cannot - 1) * 6 / 2 >= 2.5", 1),
        ("fixed != 1", 0),
        ("missing == 0", 1),
    ],
)
def test_gates(command: Call, pair: tuple[Path, Path], condition: str, status: int) -> None:
    ended, output, errors = command(*pair, "--fail-if", condition)
    assert (ended, errors) == (status, "")
    assert (f"\nfailed: {condition} (" in output) == bool(status)


def test_several_gates_and_each_that_fails_is_told(command: Call, pair: tuple[Path, Path]) -> None:
    gates = ("--fail-if", "broken > 2", "--fail-if", "fixed > 5", "--fail-if", "same < 6")
    status, output, _ = command(*pair, *gates)
    assert status == 1
    assert output.splitlines()[-2:] == [
        "failed: broken > 2 (broken 3)",
        "failed: same < 6 (same 2)",
    ]


@pytest.mark.parametrize(
    ("condition", "said"),
    [
        ("median_rte > base", "no 'median_rte' in the other run; choose from frames, mean_rte_m"),
        ("broken > base", "no 'broken' in the base run"),
        ("q1_rte_m + q3_rte_m > base", "use exactly one metric with it, not 2"),
        ("base > 1", "use exactly one metric with it, not 0"),
        ("coverage > 1/0", "cannot be computed (float division by zero)"),
        ("coverage > " + "9" * 180, ""),
        ("coverage", "write a comparison"),
        ("coverage > (broken > 1)", "write a comparison"),
        ("__import__('os').getcwd() > 1", "write a comparison"),
        ("coverage.real > 1", "write a comparison"),
        ("coverage > True", "write a comparison"),
        ("coverage ** 9 > 1", "write a comparison"),
        ("coverage > 1 or coverage < 2", "write a comparison"),
        ("coverage is 1", "write a comparison"),
        ("((((((", "write a comparison"),
        ("", "write a comparison"),
        ("coverage > 1" + " + 1" * 99, "write a comparison"),
    ],
)
def test_what_is_no_gate_is_refused_in_one_line(
    command: Call, pair: tuple[Path, Path], condition: str, said: str
) -> None:
    status, output, errors = command(*pair, "--fail-if", condition)
    if not said:  # a large number is only a number
        assert status == 0
        return
    assert (status, output) == (2, "")
    assert errors.startswith("semviz: --fail-if '")
    assert errors.count("\n") == 1
    assert said in errors


def test_a_gate_does_not_pass_because_nothing_is_known(command: Call, tmp_path: Path) -> None:
    nothing = spoiled(small_run(), dict.fromkeys(FRAMES, unanswered))
    paths = saved(small_run(), tmp_path / "a.rrd"), saved(nothing, tmp_path / "b.rrd")
    status, _, errors = command(*paths, "--fail-if", "median_rte_m > 1.05*base")
    assert status == 2
    assert "median_rte_m of the other run is unknown" in errors


def test_an_interrupted_run_is_noted_and_never_gated(command: Call, tmp_path: Path) -> None:
    cut = replace(small_run(), frames=small_run().frames[:3], complete=False)
    paths = saved(small_run(), tmp_path / "a.rrd"), saved(cut, tmp_path / "b.rrd")
    status, output, _ = command(*paths)
    assert status == 0
    assert "other run: This run was interrupted after frame 14; 3 frames are readable." in output
    status, output, errors = command(*paths, "--fail-if", "broken > 0")
    assert (status, output) == (2, "")
    assert "b.rrd: --fail-if needs a complete run" in errors


def test_runs_that_cannot_be_compared_are_refused() -> None:
    run = small_run()
    elsewhere = replace(run.semantic_map, frame=MapFrame("kitti-02"))
    with pytest.raises(SemvizError, match="the runs are of 'street-7' and of 'kitti-02'"):
        compare_runs(run, replace(run, semantic_map=elsewhere))
    halves = replace(run, frames=run.frames[:3]), replace(run, frames=run.frames[3:])
    with pytest.raises(SemvizError, match="no frame in common: 3 from 10 to 14; 3 from 16 to 20"):
        compare_runs(*halves)
    with pytest.raises(SemvizError, match="no frame in common: 6 from 10 to 20; no frames"):
        compare_runs(run, replace(run, frames=()))
    with pytest.raises(SemvizError, match=r"9\.0 m apart .*: the runs are of two drives"):
        compare_runs(run, shifted(run, 9.0))
    assert compare_runs(run, shifted(run, 0.2)).notes == (
        "the true poses of the runs differ, by up to 0.200 m",
    )


def shifted(run: Run, metres: float) -> Run:
    """With other true poses."""
    frames = []
    for frame in run.frames:
        truth = frame.frame.T_map_camera
        assert truth is not None
        there = Pose(truth.rotation, truth.translation + np.array([metres, 0.0, 0.0]))
        frames.append(replace(frame, frame=replace(frame.frame, T_map_camera=there)))
    return replace(run, frames=tuple(frames))


NUMBERS = st.one_of(
    st.integers(0, 1000).map(str), st.floats(0.0, 1e6, allow_subnormal=False).map(repr)
)
SUMS = st.recursive(
    st.one_of(NUMBERS, st.just("coverage")),
    lambda parts: st.one_of(
        st.tuples(parts, st.sampled_from("+-*/"), parts).map(lambda words: f"({''.join(words)})"),
        parts.map(lambda text: f"-{text}"),
    ),
    max_leaves=8,
)


@given(SUMS, st.sampled_from(["<", "<=", ">", ">=", "==", "!="]), SUMS)
def test_conditions_mean_what_python_means(left: str, sign: str, right: str) -> None:
    text = f"{left} {sign} {right}"
    if len(text) > MAX_LENGTH:
        return
    try:
        expected = eval(text, {"coverage": 0.5})
    except ArithmeticError:
        expected = None
    try:
        found = parse_condition(text).holds({}, {"coverage": 0.5})
    except SemvizError:
        found = None
    assert found is expected


@given(st.one_of(st.text(max_size=300), st.text("()+-*/<>=.19eabs _'[]\\\n\0", max_size=300)))
def test_no_text_is_more_than_refused(text: str) -> None:
    said = ""
    try:
        parse_condition(text).holds(METRICS, METRICS)
    except SemvizError as error:
        said = str(error)
    assert "\n" not in said


METRICS: dict[str, float | None] = {"a": 1.0, "s": None}
