"""The operation log as JSON lines."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from semviz_annotation.labels.edits import (
    AddObservation,
    DecideElements,
    MoveObservation,
    ReviewFrame,
    Unlink,
)
from semviz_annotation.labels.labels import Labels, new_id
from semviz_annotation.labels.rows import different_elements, review_decision
from semviz_annotation.storage.backup import (
    export_operations,
    import_operations,
    tells_its_length,
)
from semviz_annotation.storage.store import LabelStore
from semviz_core.common.errors import SemvizError


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Seven operations of two people and a machine, with numbers that decimals cannot hold."""
    rng = np.random.default_rng(1)
    with LabelStore.open(tmp_path / "first.db") as store:
        edits = [
            AddObservation(
                new_id(),
                new_id(),
                frame,
                "left",
                tuple(map(float, rng.uniform(0, 300, 2))),
                tuple(map(float, rng.uniform(0, 300, 2))),
                class_id=0,
            )
            for frame in range(3)
        ]
        for edit in edits:
            store.apply(edit, 'Änn \u2028 "quoted"\n')
        store.apply(MoveObservation(edits[1].observation_id, (0.1 + 0.2, 1e-300)), "bea")
        store.undo("bea")
        store.redo("bea")
        store.apply(ReviewFrame(9, "reviewed, empty"), "detector", origin="machine")
        export_operations(store, tmp_path / "log.jsonl")
    return tmp_path / "log.jsonl"


def test_round_trip_is_exact(log, tmp_path):
    with (
        LabelStore.open(tmp_path / "first.db") as first,
        LabelStore.open(tmp_path / "second.db") as second,
    ):
        assert import_operations(log, second) == 7
        assert second.operations() == first.operations()
        assert second.labels == first.labels != Labels()
        assert second.labels.next_number == first.labels.next_number == 4
        export_operations(second, tmp_path / "again.jsonl")
        assert (tmp_path / "again.jsonl").read_bytes() == log.read_bytes()
        assert import_operations(log, second) == 0
        second.undo("bea")
        assert second.last_operation == 8


def test_what_is_newer_is_appended(log, tmp_path):
    lines = log.read_text().split("\n")
    early = tmp_path / "early.jsonl"
    # of a log that was exported early
    lines[0] = '{"format": "semviz-operations", "version": 4, "triangle_center": "centroid"}'
    early.write_text("\n".join(lines[:4]) + "\n")
    with LabelStore.open(tmp_path / "second.db") as second:
        assert import_operations(early, second) == 3
        assert import_operations(log, second) == 4
        with pytest.raises(SemvizError, match=r"early.jsonl, line 5: not operation 4"):
            import_operations(early, second)


def changed(line: str, **values: object) -> str:
    return json.dumps(json.loads(line) | values)


def as_version_1(log: Path) -> str:
    """The text of a log as semviz wrote it before there were hashes."""
    lines = ['{"format": "semviz-operations", "version": 1}']
    for line in log.read_text(encoding="utf-8").split("\n")[1:-1]:
        values = json.loads(line)
        del values["hash"], values["text"]
        lines.append(json.dumps(values, separators=(",", ":")))
    return "\n".join([*lines, ""])


def test_a_log_of_version_1_gives_the_same_store(log, tmp_path):
    old = tmp_path / "old.jsonl"
    old.write_text(as_version_1(log), encoding="utf-8")
    with LabelStore.open(tmp_path / "old.db") as store:
        assert import_operations(old, store) == 7
        assert import_operations(log, store) == 0
        export_operations(store, tmp_path / "new.jsonl")
    again, first = ((tmp_path / name).read_text().split("\n") for name in ("new.jsonl", log.name))
    assert again[1:] == first[1:]
    assert '"version": 7, "triangle_center": "box"' in again[0]


def test_review_decisions_are_in_the_log_too(tmp_path):
    first, second = (
        AddObservation(new_id(), new_id(), frame, "left", (1.0, 2.0), (3.0, 40.0), class_id=0)
        for frame in range(2)
    )
    more = replace(first, observation_id=new_id(), frame_index=3, class_id=None)
    log = tmp_path / "log.jsonl"
    with LabelStore.open(tmp_path / "first.db") as store:
        for edit in (
            first, second, more,
            DecideElements((
                different_elements(first.element_id, second.element_id),
                review_decision(second.element_id, "keep"),
            )),
            Unlink((more.observation_id,), new_id()),
        ):  # fmt: skip
            store.apply(edit, "ann")
        store.undo("ann")
        export_operations(store, log)
        with LabelStore.open(tmp_path / "second.db") as other:
            assert import_operations(log, other) == 6
            assert other.labels == store.labels
            assert len(other.labels.review_decisions) == 2
            assert len(store.redo("ann").changes) == 3
    log.write_text(as_version_1(log).replace('"verdict":"apart"', '"verdict":"keep"'))
    with LabelStore.open(tmp_path / "third.db") as other:
        with pytest.raises(SemvizError, match=r"line 5: operation 4: only a decision .apart. is"):
            import_operations(log, other)
        assert other.labels == Labels()


@pytest.mark.parametrize("line", range(2, 9))
def test_an_altered_line_is_named(log, tmp_path, line):
    lines = log.read_text(encoding="utf-8").split("\n")
    lines[line - 1] = changed(lines[line - 1], time="2020-01-01")
    log.write_text("\n".join(lines), encoding="utf-8")
    words = f"line {line}: operation {line - 1}: its hash is wrong"
    with LabelStore.open(tmp_path / "second.db") as second:
        with pytest.raises(SemvizError, match=words):
            import_operations(log, second)
        assert second.labels == Labels()


@pytest.mark.parametrize(
    ("line", "break_it", "words"),
    [
        (1, lambda line: "{}", "not a log of label operations"),
        (1, lambda line: "[]", "not a log"),
        (1, lambda line: changed(line, version=9), "version 9, this semviz reads up to 8"),
        (3, lambda line: line[:-10], "line 3: Invalid JSON"),
        (4, lambda line: "", "line 4: Invalid JSON"),
        (4, lambda line: changed(line, number=9), "line 4: number 9 where 3 follows"),
        (5, lambda line: changed(line, more=1), "line 5: more"),
        (5, lambda line: line.replace("1e-300", "1e999"), "line 5: changes.*finite"),
        (5, lambda line: line.replace("1e-300", "2e-300"), "line 6: operation 5: element 2 was"),
        (6, lambda line: changed(line, undoes=2), "line 6: operation 5: operation 2 is not"),
        (2, lambda line: line.replace('"class_id":0', '"class_id":8'), "line 2.*class 8"),
        (2, lambda line: line.replace('"class_id":0', '"class_id":1'), "line 2.*one point"),
        (3, lambda line: changed(line, changes=[]), "line 5: operation 4: .* was changed"),
        (2, lambda line: changed(line, changes=[{"before": None, "after": None}]), "line 2"),
        (3, lambda line: changed(line, origin="cat"), "line 3: origin"),
    ],
)
def test_a_broken_line_is_named_and_nothing_imported(log, tmp_path, line, break_it, words):
    lines = as_version_1(log).split("\n")
    lines[line - 1] = break_it(lines[line - 1])
    log.write_text("\n".join(lines), encoding="utf-8")
    with LabelStore.open(tmp_path / "second.db") as second:
        with pytest.raises(SemvizError, match=words) as caught:
            import_operations(log, second)
        assert "\n" not in str(caught.value)
        assert second.labels == Labels()
        assert second.last_operation == 0
        assert second.labels.next_number == 1
    with LabelStore.open(tmp_path / "second.db") as second:
        assert second.operations() == ()


def test_a_missing_file_is_named(tmp_path, store):
    with pytest.raises(SemvizError, match=r"none.jsonl: cannot be read"):
        import_operations(tmp_path / "none.jsonl", store)


@pytest.mark.parametrize(
    "header", ["[" * 200_000, '{"format":"semviz-operations","version":1e999}']
)
def test_an_absurd_header_is_refused(tmp_path, store, header):
    path = tmp_path / "absurd.jsonl"
    path.write_text(header)
    with pytest.raises(SemvizError, match="line 1: not a log"):
        import_operations(path, store)


def test_a_log_tells_its_length_and_an_older_one_does_not(log, tmp_path):
    header = json.loads(log.read_text().split("\n")[0])
    with LabelStore.open(tmp_path / "first.db") as store:
        assert header["operations"] == store.last_operation == 7
        assert header["hash"] == store.operations()[-1].hash
    assert tells_its_length(log)
    old = tmp_path / "old.jsonl"
    old.write_text(as_version_1(log), encoding="utf-8")
    assert not tells_its_length(old)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(data=st.data())
def test_a_log_that_was_cut_is_refused_wherever_it_was_cut(log, tmp_path, data):
    """At a line's end too, where each line that is left is valid."""
    whole = log.read_bytes()
    ends = [at + 1 for at, byte in enumerate(whole) if byte == ord("\n")]
    at = data.draw(st.sampled_from(ends[:-1]) | st.integers(0, len(whole) - 2))
    cut = tmp_path / "cut.jsonl"
    cut.write_bytes(whole[:at])
    with LabelStore.open(tmp_path / "second.db") as second:
        with pytest.raises(SemvizError, match=r"cut\.jsonl") as caught:
            import_operations(cut, second)
        assert "\n" not in str(caught.value)
        assert second.last_operation == 0


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"operations": 6}, "cut short: 7 of 6"),
        ({"hash": "0" * 64}, "its last operation is not the one exported"),
        ({"operations": "7"}, "line 1: not a log"),
        ({"version": 10**20}, "line 1: not a log"),
        ({"hash": "\ud800"}, "its last operation|line 1: not a log"),
    ],
)
def test_a_header_that_contradicts_its_log_is_refused(log, tmp_path, values, words):
    lines = log.read_text(encoding="utf-8").split("\n")
    log.write_text("\n".join([changed(lines[0], **values), *lines[1:]]), encoding="utf-8")
    with (
        LabelStore.open(tmp_path / "second.db") as second,
        pytest.raises(SemvizError, match=words),
    ):
        import_operations(log, second)


@pytest.mark.parametrize(
    "line",
    [
        '{"number":' + "9" * 5000 + "}",
        "[" * 100_000,
        '{"number":1,"text":"\\ud800"}',
        '{"number":1,"author":"' + "a" * 3000 + '"}',
        '{"number":1e999}',
        "\udcff",
    ],
)
def test_absurd_lines_are_refused_in_one_short_line(tmp_path, store, line):
    path = tmp_path / "absurd.jsonl"
    header = b'{"format": "semviz-operations", "version": 3}\n'
    path.write_bytes(header + line.encode(errors="surrogateescape"))
    with pytest.raises(SemvizError, match=r"line 2: ") as caught:
        import_operations(path, store)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300
