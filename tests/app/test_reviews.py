"""What of the last map waits for a person: the lists of the labelling page, without a browser."""

import contextlib
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from planted import element_id, left_out, merge, planted_map, street
from random_edits import pole, random_edit

from semviz.annotator.reviews import Open
from semviz.annotator.session import LabelSession
from semviz.workspace import MAIN, Workspace
from semviz_annotation.edits import Judge, edit_to_json
from semviz_annotation.labels import Labels, new_id
from semviz_annotation.mapping.review import is_open
from semviz_annotation.rows import apart, judged
from semviz_annotation.rules import Rules
from semviz_core.errors import SemvizError
from semviz_core.map_file import save_map
from semviz_core.semantic_map import Decision


@pytest.fixture(scope="module")
def planted(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    return street(tmp_path_factory.mktemp("planted") / "street")


@pytest.fixture
def session(planted: Workspace) -> Iterator[LabelSession]:
    """Without a map; its edits are undone at the end."""
    planted.map_path(MAIN).unlink(missing_ok=True)
    session = LabelSession(planted, "tester")
    yield session
    while session.summary()["can_undo"]:
        session.do(new_id(), {"kind": "undo"})
    session.close()


def keep_map(session: LabelSession, *decisions: Decision) -> None:
    """Another program writes the map, and the session notices."""
    planted = planted_map(session.workspace, session.labels, decisions)
    save_map(planted, session.workspace.map_path(MAIN))
    noticed(session, session.map_work.look)


def noticed(session: LabelSession, what: Callable[[], None]) -> None:
    before = session.map_work.version
    what()
    session.map_work._pool.submit(lambda: None).result()
    assert session.map_work.version > before


def summary(session: LabelSession) -> dict[str, Any]:
    found: dict[str, Any] = session.summary()["map"]
    return found


def card(
    session: LabelSession,
    step: int = 0,
    before: dict[str, Any] | None = None,
    of: str = "decisions",
) -> dict[str, Any]:
    before = before or {"key": None, "place": 0}
    asked = {"list": of, "key": before["key"], "place": before["place"], "by": step}
    answer = session.review(asked)
    json.dumps(answer, allow_nan=False)
    return answer


def test_without_a_map_there_is_nothing_to_judge(session: LabelSession) -> None:
    assert summary(session)["built"] is None
    assert card(session) == {"list": "decisions", "count": 0}


def test_a_card_says_what_was_decided_why_and_what_can_be_said_to_it(session: LabelSession) -> None:
    keep_map(session, merge(), left_out(session.labels))
    assert (summary(session)["decisions"], summary(session)["built"]) == (2, 1)
    first = card(session)
    assert (first["kind"], first["place"], first["count"]) == ("merge", 0, 2)
    assert first["reason"] == "They fit one place"
    assert {"name": "Distance", "value": "0.12 m"} in first["evidence"]
    assert {"name": "Off", "value": "unknown"} in first["evidence"]
    assert [one["name"] for one in first["elements"]] == ["P-01", "P-02"]
    assert [one["frames"] for one in first["elements"]] == [[0, 1, 2], [3, 4, 5]]
    assert [one["number"] for one in first["elements"]] == [1, 2]
    assert first["frame"] == 2
    assert [one["title"] for one in first["answers"]] == ["One thing", "Two things"]
    second = card(session, 1, first)
    assert (second["kind"], second["place"]) == ("leave out", 1)
    assert card(session, 1, second)["key"] == second["key"]  # the last one
    assert card(session, -1, second)["key"] == first["key"]


@pytest.mark.parametrize("place", [0, 1])
def test_an_answer_is_an_edit_that_closes_the_decision_until_it_is_undone(
    session: LabelSession, place: int
) -> None:
    keep_map(session, merge(), left_out(session.labels))
    first = card(session)
    done = session.do(new_id(), first["answers"][place]["edit"])
    assert done.operation.kind == ("link", "judge")[place]
    assert summary(session)["decisions"] == 1
    following = card(session, 0, first)
    assert (following["kind"], following["place"]) == ("leave out", 0)
    session.do(new_id(), {"kind": "undo"})
    assert summary(session)["decisions"] == 2
    assert card(session)["key"] == first["key"]


def test_a_judgement_is_shown_on_its_elements_and_in_the_history(session: LabelSession) -> None:
    keep_map(session, merge())
    session.do(new_id(), card(session)["answers"][1]["edit"])
    (shown,) = (one for one in session.frame(0)["elements"] if one["name"] == "P-01")
    assert [one["text"] for one in shown["judged"]] == ["apart from P-02"]
    assert session.summary()["history"][0]["text"] == "P-01 and P-02 are apart"
    session.do(new_id(), {"kind": "take back", "judgement_id": shown["judged"][0]["id"]})
    assert session.summary()["history"][0]["text"].startswith("Leave to the map P-0")
    assert summary(session)["decisions"] == 1


def test_the_history_says_which_of_several_is_another_thing(session: LabelSession) -> None:
    poles = [one for one in session.labels.elements.values() if one.class_id == 0]
    first, *others = sorted(poles, key=lambda one: one.number)[:3]
    rows = [apart(first.id, one.id) for one in others]
    for judgements, text in (
        (rows, "P-01 is apart from 2 others"),
        ([*rows, apart(others[0].id, others[1].id)], f"P-01, P-02 and P-{others[1].number} are"),
        ([judged(first.id, "keep")], "P-01 kept as one thing"),
        ([judged(first.id, "leave out")], "P-01 left out of maps"),
    ):
        session.do(new_id(), edit_to_json(Judge(tuple(judgements))))
        assert session.summary()["history"][0]["text"].startswith(text)
        session.do(new_id(), {"kind": "undo"})


def test_findings_are_of_the_map_that_is_there(session: LabelSession) -> None:
    keep_map(session)
    count = summary(session)["findings"]
    assert count > 0  # the planted place does not fit the labels
    shown = card(session, of="findings")
    assert shown["count"] == count
    assert shown["severity"] in ("error", "warning", "hint")
    assert shown["elements"][0]["id"] == element_id(1)


def test_a_map_that_is_gone_broken_or_built_anew_is_noticed(session: LabelSession) -> None:
    keep_map(session, merge())
    path = session.workspace.map_path(MAIN)
    path.write_text("not a map")
    noticed(session, session.map_work.look)
    assert "not a readable Parquet file" in summary(session)["failure"]
    path.unlink()
    noticed(session, session.map_work.look)
    assert summary(session)["built"] is None
    assert session.has_news()
    session.news()
    noticed(session, session.map_work.build)
    session.map_work.look()
    assert summary(session)["failure"] == ""
    assert summary(session)["built"] == session.labels.operation
    assert summary(session)["elements"] > 5
    assert session.has_news()
    assert session.workspace.read_map(MAIN).operation == session.labels.operation


def test_a_build_that_fails_says_why_and_leaves_the_map(tmp_path: Path) -> None:
    session = LabelSession(Workspace.create_street(tmp_path / "empty", 7, range(2)), "tester")
    noticed(session, session.map_work.build)
    assert "no element is labelled in two images" in summary(session)["failure"]
    assert not session.workspace.map_path(MAIN).exists()
    session.map_work.building = "linking, 50 %"
    with pytest.raises(SemvizError, match="being built already"):
        session.map_work.build()
    session.close()


def test_a_build_that_is_stopped_leaves_the_map(tmp_path: Path) -> None:
    session = LabelSession(street(tmp_path / "street"), "tester")
    session.map_work._pool.submit(time.sleep, 0.3)
    session.map_work.build()
    session.map_work.stop()
    session.map_work._pool.submit(lambda: None).result()
    assert session.map_work.failure.startswith("Stopped")
    assert session.map_work.building is None
    assert not session.workspace.map_path(MAIN).exists()
    noticed(session, session.map_work.build)
    assert session.workspace.map_path(MAIN).exists()
    session.close()


@pytest.mark.parametrize(
    "asked",
    [{}, {"list": "cats"}, {"list": "decisions", "place": "0", "by": 0}, {"list": "decisions"}],
)
def test_what_is_no_list_is_refused(session: LabelSession, asked: dict[str, Any]) -> None:
    with pytest.raises(SemvizError, match="not a list of this page"):
        session.review(asked)


@pytest.mark.parametrize("seed", range(20))
def test_what_is_open_is_followed_through_any_edits(seed: int) -> None:
    rng = np.random.default_rng(seed)
    labels = Labels()
    for frame in range(12):
        labels = labels.changed(pole(frame % 3).changes(labels, Rules()))
    labels = edited(labels, rng, 20)
    decisions = random_decisions(labels, rng)
    followed = Open(decisions)
    for _ in range(60):
        assert followed.of(labels) == tuple(one for one in decisions if is_open(one, labels))
        labels = edited(labels, rng, 1)


def edited(labels: Labels, rng: np.random.Generator, times: int) -> Labels:
    for _ in range(times):
        with contextlib.suppress(SemvizError):
            labels = labels.changed(random_edit(labels, rng).changes(labels, Rules()))
    return labels


def random_decisions(labels: Labels, rng: np.random.Generator) -> list[Decision]:
    found = []
    elements = sorted(labels.elements.values(), key=lambda one: one.number)
    for _ in range(30):
        kind = ("merge", "apart", "split", "leave out")[rng.integers(4)]
        count = int(rng.integers(2, 4)) if kind in ("merge", "apart") else 1
        chosen = [elements[place] for place in rng.choice(len(elements), count)]
        rows = [row.id for row in labels.of_element(chosen[0].id)][: int(rng.integers(3))]
        about = tuple(rows) if count == 1 else ()
        ids, numbers = tuple(one.id for one in chosen), tuple(one.number for one in chosen)
        found.append(Decision(kind, ids, numbers, "machine", "So.", {}, about))
    return found
