"""The benchmark: the same numbers however it was run, and tables that say what they claim."""

import json
import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from command_line import Call, call

import semviz_core
from semviz.research.benchmark import report, runner, suites
from semviz.research.benchmark.report import BenchmarkReport
from semviz.research.benchmark.runner import code_digest
from semviz.research.benchmark.suites import KNOWN, SUITES, choose_suites
from semviz_core.base import weights
from semviz_core.common.errors import SemvizError
from semviz_core.metrics.pose_errors import Outcome, ProblemFacts
from semviz_core.research.evaluation.methods import Method
from semviz_core.research.evaluation.outcomes import rows
from semviz_core.research.point_matching import pixel_methods

QUICK = ("--methods", "true matches,bound", "--noise", "low", "--no-plots", "--json")
KEYS = {
    "method", "noise", "stratum", "frames", "rte_m", "rre_deg", "share_below_1m",
    "share_below_1deg", "bound_ratio_median", "coverage", "confident_wrong", "time_ms",
}  # fmt: skip
TIMES = {"time_ms", "stages_ms", "first_call_ms", "timed_alone"}


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Call:
    """Exit status, output and error output of ``semviz benchmark``."""
    return partial(call, capsys, "benchmark")


def untimed(output: str) -> list[dict[str, Any]]:
    """The rows of ``--json`` but for times."""
    return [
        {name: value for name, value in row.items() if name not in TIMES}
        for row in json.loads(output)["rows"]
    ]


def test_json_table_and_plots(run: Call, tmp_path: Path) -> None:
    options = ("--frames", 6, "--methods", "search,bound", "--noise", "low", "--json")
    status, output, _ = run(*options, "--out", tmp_path)
    assert status == 0
    table = json.loads(output)
    assert all(row.keys() >= KEYS for row in table["rows"])
    assert {row["method"] for row in table["rows"]} == {"search", "bound"}
    for row in table["rows"]:
        assert row["rte_m"].keys() == {"mean", "q1", "q2", "q3"}
        assert row["time_ms"].keys() == {"median", "p95"}
    assert json.loads((tmp_path / "table.json").read_text()) == table
    assert (tmp_path / "table.md").read_text().count("| search |") > 2
    plots = {path.name for path in tmp_path.glob("*.png")}
    kinds = ("cumulative", "histogram", "bound", "recall", "time")
    assert plots == {f"frames-low-{kind}.png" for kind in kinds}


def test_suites_of_drives_and_of_matches(run: Call, tmp_path: Path) -> None:
    """Each method runs where it can; drives have no strata by true matches."""
    options = ("--methods", "tracking,p3p", "--noise", "low", "--frames", 5, "--no-plots", "--json")
    status, output, _ = run("--suite", "matched,sequence", *options, "--out", tmp_path)
    assert status == 0
    rows = [(row["suite"], row["method"], row["stratum"]) for row in json.loads(output)["rows"]]
    assert {row[:2] for row in rows} == {("matched", "p3p"), ("sequence", "tracking")}
    assert not [row for row in rows if row[0] == "sequence" and row[2].endswith("true")]


@pytest.fixture
def whole(run: Call, tmp_path: Path) -> tuple[Path, list[dict[str, Any]]]:
    """Folder and rows of an uninterrupted benchmark."""
    folder = tmp_path / "whole"
    status, output, _ = run("--frames", 8, *QUICK, "--out", folder)
    assert status == 0
    return folder, untimed(output)


def test_same_seeds_same_numbers(
    run: Call, whole: tuple[Path, list[dict[str, Any]]], tmp_path: Path
) -> None:
    assert untimed(run("--frames", 8, *QUICK, "--out", tmp_path / "again")[1]) == whole[1]
    assert (
        untimed(run("--frames", 8, "--seed", 2000, *QUICK, "--out", tmp_path / "other")[1])
        != whole[1]
    )


@pytest.mark.parametrize("share", [0.0, 0.01, 0.4, 0.77, 1.0])
def test_what_a_kill_leaves_is_gone_on_with(
    run: Call, whole: tuple[Path, list[dict[str, Any]]], tmp_path: Path, share: float
) -> None:
    """The file is cut anywhere, as a killed process leaves it."""
    content = (whole[0] / "results.jsonl").read_bytes()
    results = tmp_path / "cut" / "results.jsonl"
    results.parent.mkdir()
    results.write_bytes(content[: int(share * len(content))])
    before = content[: int(share * len(content))].splitlines(keepends=True)
    assert untimed(run("--frames", 8, *QUICK, "--out", results.parent)[1]) == whole[1]
    after = results.read_bytes().splitlines(keepends=True)
    assert len(after) == len(content.splitlines())
    kept = [line for line in before if line.endswith(b"\n")]
    assert after[: len(kept)] == kept


def test_interrupted_keeps_what_is_done(
    run: Call,
    whole: tuple[Path, list[dict[str, Any]]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls = []
    run_task = runner.run_task

    def interrupted(*arguments: Any, **named: Any) -> list[Outcome]:
        calls.append(arguments)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return run_task(*arguments, **named)

    monkeypatch.setattr(runner, "run_task", interrupted)
    assert run("--frames", 8, *QUICK, "--out", tmp_path / "cut")[0] == 130
    monkeypatch.setattr(runner, "run_task", lambda *a, **b: (calls.append(a), run_task(*a, **b))[1])
    assert untimed(run("--frames", 8, *QUICK, "--out", tmp_path / "cut")[1]) == whole[1]
    assert len(calls) == 4 + 5


def test_two_processes_change_only_times(
    run: Call, whole: tuple[Path, list[dict[str, Any]]], tmp_path: Path
) -> None:
    output = run("--frames", 8, "--jobs", 2, *QUICK, "--out", tmp_path / "two")[1]
    assert untimed(output) == whole[1]
    assert not any(row["timed_alone"] for row in json.loads(output)["rows"])
    assert "too long" in (tmp_path / "two" / "table.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--methods", "serach"), ("serach", "known: ", "search", "true matches")),
        (("--suite", "harder"), ("harder", "known: ", "frames", "matched")),
        (("--frames", "0"), ("--frames", "1 or more")),
        (("--kitti-poses", "poses"), ("--kitti-poses", "--pole-maps")),
    ],
)
def test_mistakes_cost_one_line(
    run: Call, tmp_path: Path, arguments: tuple[str, ...], words: tuple[str, ...]
) -> None:
    status, output, error_output = run(*arguments, "--out", tmp_path)
    assert (status, output, error_output.count("\n")) == (2, "", 1)
    assert all(word in error_output for word in words)
    assert not list(tmp_path.iterdir())


def test_what_cannot_run_is_left_out_and_said(
    run: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def untrained() -> Method:
        raise SemvizError("x.safetensors: no such weights")

    known = {**KNOWN, "single": {**KNOWN["single"], "untrained": untrained}}
    monkeypatch.setattr(suites, "KNOWN", known)
    options = ("--frames", 1, "--noise", "low", "--no-plots", "--json", "--out", tmp_path)
    _, output, _ = run("--methods", "untrained,bound", *options)
    (note,) = json.loads(output)["notes"]
    assert note == "untrained is left out: x.safetensors: no such weights"
    assert {row["method"] for row in json.loads(output)["rows"]} == {"bound"}
    status, _, error_output = run("--methods", "untrained", *options)
    assert (status, error_output.count("\n")) == (2, 1)
    assert "no such weights" in error_output


def test_other_settings_are_refused(run: Call, whole: tuple[Path, list[dict[str, Any]]]) -> None:
    before = (whole[0] / "results.jsonl").read_bytes()
    status, output, error_output = run("--seed", 1500, *QUICK, "--out", whole[0])
    assert (status, output, error_output.count("\n")) == (2, "", 1)
    assert "seed was 1000, is 1500" in error_output
    assert (whole[0] / "results.jsonl").read_bytes() == before


def test_every_method_and_suite_can_be_named_in_a_list() -> None:
    names = [*SUITES, *(name for named in KNOWN.values() for name in named)]
    assert not [name for name in names if "," in name]


def test_tuning_seeds_are_named_so(run: Call, tmp_path: Path) -> None:
    _, output, _ = run("--seed", 0, "--frames", 1, *QUICK, "--out", tmp_path)
    assert any("tuning" in note for note in json.loads(output)["notes"])


def test_what_is_given_without_the_prior_is_measured_without_it(run: Call, tmp_path: Path) -> None:
    """Each method's ratio is to the bound that it can reach; without the prior that is further."""
    methods = "bound,bound alone,true matches,true matches alone"
    options = ("--methods", methods, "--noise", "low", "--frames", 40, "--no-plots", "--json")
    _, output, _ = run("--suite", "matched", *options, "--out", tmp_path)
    all_frames = [row for row in json.loads(output)["rows"] if row["stratum"] == "all"]
    row = {row["method"]: row for row in all_frames}
    assert set(row) == set(methods.split(","))
    for name in row:
        assert row[name]["rms_over_bound"] == pytest.approx(1.0, abs=0.35)  # 3 sigma of 40
    for name in ("bound", "true matches"):
        assert row[f"{name} alone"]["rte_m"]["q2"] > row[name]["rte_m"]["q2"]


def test_where_noise_is_misstated_there_is_no_bound(run: Call, tmp_path: Path) -> None:
    options = ("--frames", 4, "--methods", "search,bound", "--noise", "low", "--json")
    _, output, _ = run("--suite", "noise 3 px,noise 3 px unstated", *options, "--out", tmp_path)
    rows = [row for row in json.loads(output)["rows"] if row["stratum"] == "all"]
    bounded = {(row["suite"], row["method"]): row["rms_over_bound"] is not None for row in rows}
    assert bounded == {
        ("noise 3 px", "search"): True,
        ("noise 3 px", "bound"): True,
        ("noise 3 px unstated", "search"): False,
    }
    plots = {path.stem.rpartition("-")[2] for path in tmp_path.glob("*unstated*.png")}
    assert plots == {"cumulative", "histogram", "recall", "time"}


def test_the_papers_table_stands_beside_what_was_measured(run: Call, tmp_path: Path) -> None:
    options = ("--frames", 6, "--methods", "true matches,bound", "--noise", "low", "--no-plots")
    status, output, _ = run("--suite", "paper", *options, "--out", tmp_path)
    assert status == 0
    written = (tmp_path / "table.md").read_text()
    for words in ("459 frames of KITTI 09 and 10", "simulated roads alone"):
        assert words in " ".join(output.split())
        assert words in written
    assert "| Ours | printed | 459 | 0.22 | 0.09 | 0.18 | 0.29 | 99.5% | 0.34 |" in written
    table = written.partition("the paper's table")[2].partition("##")[0]
    assert re.search(r"\| true matches \| all \| \d/\d \|", table)
    status, output, _ = run(*options[:-1], "--no-plots", "--json", "--out", tmp_path / "frames")
    same = [{**row, "suite": "paper"} for row in untimed(output)]
    assert untimed(run("--suite", "paper", *options, "--json", "--out", tmp_path)[1]) == same


def test_the_papers_own_protocol_has_networks_of_its_own(
    run: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = ("--frames", 6, "--noise", "low", "--no-plots", "--out", tmp_path / "out")
    suite = SUITES["paper-20m"]
    assert suites.make_method(suite, "paper").weights.name == "paper-20m.safetensors"
    assert suites.make_method(SUITES["paper"], "paper").weights is None
    _, output, _ = run("--suite", "paper-20m", *options, "--methods", "true matches,bound")
    text = " ".join(output.split())
    for words in ("printed figure is confirmed or refuted", "30,000 frames of this protocol"):
        assert words in text
    suites._made.cache_clear()
    monkeypatch.setattr(weights, "SHIPPED", tmp_path / "nowhere")
    _, _, error_output = run("--suite", "paper-20m", *options, "--methods", "paper,bound")
    assert "paper is left out" in error_output
    suites._made.cache_clear()


def test_each_method_stands_under_its_printed_row() -> None:
    measured = [fake("search"), *(fake(row.method) for row in report.PRINTED if row.method)]
    table = report.beside_printed(rows(measured))
    names = [cells[0] for cells in table.cells if cells[1] in ("printed", "all")]
    for printed in report.PRINTED:
        below = names[names.index(printed.name) + 1]
        assert printed.method is None or below == printed.method
    assert names[-1] == "search"
    assert len(names) == len(report.PRINTED) + len(measured)


def test_frames_without_a_pose_are_counted_beside_the_quartiles() -> None:
    nothing = {"status": "cannot", "rte_m": None, "rre_deg": None, "nees": None}
    outcomes = [fake("search"), replace(fake("search"), **nothing), fake("search")]
    table = report.beside_printed(rows(outcomes))
    (cells,) = (cell for cell in table.cells if cell[:2] == ("search", "all"))
    assert cells[2] == "2/3"
    assert cells[7] == "66.7%"


def test_printed_figures_are_whole() -> None:
    """Mean and quartiles of each, the quartiles in order; the paper's own method is best."""
    for printed in report.PRINTED:
        for words in (printed.rte_m, printed.rre_deg):
            _, *quartiles = map(float, words.split())
            assert len(quartiles) == 3
            assert quartiles == sorted(quartiles)
    means = [float(row.rte_m.split()[0]) for row in report.PRINTED]
    assert min(means) == means[-1] == 0.22


def test_the_papers_table_has_methods_that_there_are() -> None:
    methods = set(report.methods_of_table([SUITES["street-paper"]]))
    assert methods <= set(KNOWN["single"])
    assert {row.method for row in report.PRINTED if row.method} <= methods
    of_elements = set(report.methods_of_table([SUITES["paper-20m"]]))
    assert methods - of_elements == set(pixel_methods.METHODS)


def test_streets_answer_the_rows_from_pixels(run: Call, tmp_path: Path) -> None:
    options = ("--frames", 1, "--noise", "paper", "--no-plots", "--out", tmp_path / "out")
    references = "true cells,fix alone,true matches"
    _, output, _ = run("--suite", "street-paper", *options, "--methods", references)
    for words in ("ISS keypoints", "not re-implemented", "as DeepI2P measures"):
        assert words in " ".join(output.split())
    row = next(line for line in output.splitlines() if line.startswith("true cells"))
    assert " 1/1 " in row
    status, _, error_output = run(
        "--suite", "street-paper", *options, "--kitti-poses", tmp_path, "--pole-maps", tmp_path
    )
    assert status == 2
    assert "omit --kitti-poses" in error_output
    _, _, error_output = run("--suite", "frames", *options, "--methods", "true cells,bound")
    assert "true cells is left out: it needs pictures" in error_output


def test_all_suites_hold_no_problem_twice() -> None:
    assert "paper" not in {suite.name for suite in choose_suites("all")}
    assert [suite.name for suite in choose_suites("paper")] == ["paper"]
    assert {suite.name for suite in choose_suites("all,paper,street-paper")} >= set(
        report.PAPER_SUITES
    )


def test_results_of_other_weights_are_not_mixed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "weights").mkdir()
    (tmp_path / "__init__.py").touch()
    monkeypatch.setattr(semviz_core, "__file__", str(tmp_path / "__init__.py"))
    digests = {code_digest()}
    for content in (b"first", b"second"):
        (tmp_path / "weights" / "paper.safetensors").write_bytes(content)
        digests.add(code_digest())
    assert len(digests) == 3


@pytest.mark.parametrize("suite", ["frames", "paper", "paper-20m", "street-paper"])
def test_tables_fit_a_terminal(suite: str) -> None:
    longest = max((name for named in KNOWN.values() for name in named), key=len)
    text = BenchmarkReport({"seed": 1000}, (), tuple(rows([fake(longest, suite)]))).as_text()
    assert max(map(len, text.splitlines())) <= 120


def fake(method: str, suite: str = "paper") -> Outcome:
    return Outcome(
        suite=suite, method=method, noise="low", frame=0,
        facts=ProblemFacts(detections=8, true_matches=7, recall=0.7, bound_m=0.1, bound_rms_m=0.12),
        status="ok", rte_m=0.1, rre_deg=0.1, nees=1234.5, total_ms=12345.6,
    )  # fmt: skip
