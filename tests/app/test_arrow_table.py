"""The frames of many runs in one table are summarized as one run."""

from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from small_runs import off_by, small_run, spoiled, unanswered, without_truth

from semviz.runs.arrow_table import FrameRows, arrow_table
from semviz.runs.frame_table import frame_table
from semviz.runs.metrics import summarize_run
from semviz.runs.run import Run
from semviz.runs.table_metrics import found_diagnoses, metrics_of


def test_rows_of_two_runs_are_those_of_one(tmp_path: Path) -> None:
    whole = spoiled(small_run(), {10: unanswered, 12: off_by(3.0)})
    parts = replace(whole, frames=whole.frames[:3]), replace(whole, frames=whole.frames[3:])
    rows = stored(tmp_path, *parts)
    assert rows.figures.summary().as_text() == summarize_run(whole).as_text()
    assert rows.diagnoses == found_diagnoses(whole)
    assert rows.overconfident / len(rows) == metrics_of(whole)["share_sure_and_wrong"]
    first = rows.of_run("part0")
    assert first.figures.summary().as_text() == summarize_run(parts[0]).as_text()


def test_what_is_unknown_is_null(tmp_path: Path) -> None:
    rows = stored(tmp_path, spoiled(without_truth(small_run()), {10: unanswered}))
    table = rows.table
    assert table["rte_m"].null_count == table["true_x_m"].null_count == len(rows)
    assert table["x_m"].null_count == 1
    assert rows.figures.summary().accuracy.share_below_1m is None


def test_inliers_are_counted(tmp_path: Path) -> None:
    run = spoiled(small_run(), {10: unanswered})
    matched = stored(tmp_path, run).table["matched"].to_pylist()
    results = [record.localization.refinement for record in run.frames]
    assert matched == [0 if one is None else int(one.inlier.sum()) for one in results]


def stored(folder: Path, *runs: Run) -> FrameRows:
    """The rows of some runs, written and read."""
    tables = []
    for number, run in enumerate(runs):
        path = folder / f"{number}.parquet"
        pq.write_table(arrow_table(frame_table(run), f"part{number}"), path)
        tables.append(pq.read_table(path))
    return FrameRows(pa.concat_tables(tables).unify_dictionaries())
