"""What of the last map waits for a person: the lists of the labelling page, without a browser."""

import contextlib
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_marks import do
from duplicated_pole import element_id, left_out, merge, planted_map, street
from random_edits import pole, random_edit

from semviz.annotator.map_review import MapSummary, OpenDecisions, ReviewEntry
from semviz.annotator.messages import ReviewEvent, ShowReviewRequest
from semviz.annotator.page_session import HANDLERS
from semviz.annotator.session import LabelSession
from semviz.web.protocol import MalformedRequestError
from semviz.workspace.maps.map_review import FigureView
from semviz.workspace.workspace import MAIN, Workspace
from semviz_annotation.labels.edits import DecideElements, edit_to_json
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.rows import Rules, different_elements, review_decision
from semviz_annotation.mapping.decisions import is_open
from semviz_core.base.map_file import save_map
from semviz_core.base.semantic_map import Decision
from semviz_core.common.errors import SemvizError


@pytest.fixture(scope="module")
def planted(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    return street(tmp_path_factory.mktemp("planted") / "street")


@pytest.fixture
def session(planted: Workspace) -> Iterator[LabelSession]:
    """Without a map; its edits are undone at the end."""
    planted.map_path(MAIN).unlink(missing_ok=True)
    session = LabelSession(planted, "tester")
    yield session
    while session.summary().can_undo:
        do(session, {"kind": "undo"})
    session.close()


def keep_map(session: LabelSession, *decisions: Decision) -> None:
    """Another program writes the map, and the session notices."""
    planted = planted_map(session.workspace, session.labels, decisions)
    save_map(planted, session.workspace.map_path(MAIN))
    noticed(session, session.map_work.refresh)


def noticed(session: LabelSession, what: Callable[[], None]) -> None:
    before = session.map_work.version
    what()
    session.map_work._pool.submit(lambda: None).result()
    assert session.map_work.version > before


def summary(session: LabelSession) -> MapSummary:
    return session.summary().map


def card(
    session: LabelSession,
    step: int = 0,
    before: ReviewEntry | None = None,
    of: str = "decisions",
) -> ReviewEntry:
    key = before.entry.key if before and before.entry else None
    asked = {"list_name": of, "key": key, "place": before.place if before else 0, "by": step}
    answer = session.review(ShowReviewRequest(id="1", **asked))
    ReviewEvent(review=answer).model_dump_json()
    return answer


def edit(of: ReviewEntry, place: int) -> dict[str, Any]:
    """What the page sends for an answer."""
    return edit_to_json(of.entry.answers[place].edit)


def test_without_a_map_there_is_nothing_to_judge(session: LabelSession) -> None:
    assert summary(session).built is None
    assert card(session) == ReviewEntry(list_name="decisions", count=0)


def test_a_card_says_what_was_decided_why_and_what_can_be_said_to_it(session: LabelSession) -> None:
    keep_map(session, merge(), left_out(session.labels))
    assert (summary(session).decisions, summary(session).built) == (2, 1)
    first = card(session)
    assert (first.entry.kind, first.place, first.count) == ("merge", 0, 2)
    assert first.entry.reason == "They fit one place"
    assert FigureView(name="Distance", value="0.12 m") in first.entry.evidence
    assert FigureView(name="Off", value="unknown") in first.entry.evidence
    assert [element.name for element in first.entry.elements] == ["P-01", "P-02"]
    assert [element.frames for element in first.entry.elements] == [[0, 1, 2], [3, 4, 5]]
    assert [element.number for element in first.entry.elements] == [1, 2]
    assert first.entry.frame == 2
    assert [answer.title for answer in first.entry.answers] == [
        "Same landmark",
        "Different landmarks",
    ]
    second = card(session, 1, first)
    assert (second.entry.kind, second.place) == ("leave out", 1)
    assert card(session, 1, second).entry.key == second.entry.key  # the last one
    assert card(session, -1, second).entry.key == first.entry.key


@pytest.mark.parametrize("place", [0, 1])
def test_an_answer_is_an_edit_that_closes_the_decision_until_it_is_undone(
    session: LabelSession, place: int
) -> None:
    keep_map(session, merge(), left_out(session.labels))
    first = card(session)
    done = do(session, edit(first, place))
    assert done.operation.kind == ("link", "judge")[place]
    assert summary(session).decisions == 1
    following = card(session, 0, first)
    assert (following.entry.kind, following.place) == ("leave out", 0)
    do(session, {"kind": "undo"})
    assert summary(session).decisions == 2
    assert card(session).entry.key == first.entry.key


def test_a_decision_is_shown_on_its_elements_and_in_the_history(session: LabelSession) -> None:
    keep_map(session, merge())
    do(session, edit(card(session), 1))
    (shown,) = (element for element in session.frame(0).elements if element.name == "P-01")
    assert [decision.text for decision in shown.review_decisions] == ["apart from P-02"]
    assert session.summary().history[0].text == "P-01 and P-02 are apart"
    do(session, {"kind": "take back", "judgement_id": shown.review_decisions[0].id})
    assert session.summary().history[0].text.startswith("Revoke the decision on P-0")
    assert summary(session).decisions == 1


def test_the_history_says_which_of_several_is_another_element(session: LabelSession) -> None:
    poles = [element for element in session.labels.elements.values() if element.class_id == 0]
    first, *others = sorted(poles, key=lambda element: element.number)[:3]
    rows = [different_elements(first.id, other.id) for other in others]
    for judgements, text in (
        (rows, "P-01 is apart from 2 others"),
        (
            [*rows, different_elements(others[0].id, others[1].id)],
            f"P-01, P-02 and P-{others[1].number} are",
        ),
        ([review_decision(first.id, "keep")], "P-01 kept as one landmark"),
        ([review_decision(first.id, "leave out")], "P-01 left out of maps"),
    ):
        do(session, edit_to_json(DecideElements(tuple(judgements))))
        assert session.summary().history[0].text.startswith(text)
        do(session, {"kind": "undo"})


def test_findings_are_of_the_map_that_is_there(session: LabelSession) -> None:
    keep_map(session)
    count = summary(session).findings
    assert count > 0  # the planted place does not fit the labels
    shown = card(session, of="findings")
    assert shown.count == count
    assert shown.entry.severity in ("error", "warning", "hint")
    assert shown.entry.elements[0].id == element_id(1)


def test_a_map_that_is_gone_broken_or_built_anew_is_noticed(session: LabelSession) -> None:
    keep_map(session, merge())
    path = session.workspace.map_path(MAIN)
    path.write_text("not a map")
    noticed(session, session.map_work.refresh)
    assert "not a readable Parquet file" in summary(session).failure
    path.unlink()
    noticed(session, session.map_work.refresh)
    assert summary(session).built is None
    assert session.has_updates()
    session.updates()
    noticed(session, session.map_work.build)
    session.map_work.refresh()
    assert summary(session).failure == ""
    assert summary(session).built == session.labels.operation
    assert summary(session).elements > 5
    assert session.has_updates()
    assert session.workspace.read_map(MAIN).operation == session.labels.operation


def test_a_build_that_fails_says_why_and_leaves_the_map(tmp_path: Path) -> None:
    session = LabelSession(Workspace.create_street(tmp_path / "empty", 7, range(2)), "tester")
    noticed(session, session.map_work.build)
    assert "no element is labelled in two images" in summary(session).failure
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
    [{}, {"list_name": "cats"}, {"place": "0"}, {"place": -1}, {"by": 2}, {"key": 3}, {"more": 1}],
)
def test_what_is_no_list_is_refused(asked: dict[str, Any]) -> None:
    whole = {"type": "show_review", "id": "1", "list_name": "decisions"}
    HANDLERS.decode(json.dumps(whole))
    wrong = whole | asked if asked else {"type": "show_review", "id": "1"}
    with pytest.raises(MalformedRequestError, match="not a message of this page"):
        HANDLERS.decode(json.dumps(wrong))


@pytest.mark.parametrize("seed", range(20))
def test_what_is_open_is_followed_through_any_edits(seed: int) -> None:
    rng = np.random.default_rng(seed)
    labels = Labels()
    for frame in range(12):
        labels = labels.changed(pole(frame % 3).changes(labels, Rules()))
    labels = edited(labels, rng, 20)
    decisions = random_decisions(labels, rng)
    followed = OpenDecisions(decisions)
    for _ in range(60):
        assert followed.of(labels) == tuple(
            decision for decision in decisions if is_open(decision, labels)
        )
        labels = edited(labels, rng, 1)


def edited(labels: Labels, rng: np.random.Generator, times: int) -> Labels:
    for _ in range(times):
        with contextlib.suppress(SemvizError):
            labels = labels.changed(random_edit(labels, rng).changes(labels, Rules()))
    return labels


def random_decisions(labels: Labels, rng: np.random.Generator) -> list[Decision]:
    found = []
    elements = sorted(labels.elements.values(), key=lambda element: element.number)
    for _ in range(30):
        kind = ("merge", "different_elements", "split", "leave out")[rng.integers(4)]
        count = int(rng.integers(2, 4)) if kind in ("merge", "apart") else 1
        chosen = [elements[place] for place in rng.choice(len(elements), count)]
        rows = [row.id for row in labels.of_element(chosen[0].id)][: int(rng.integers(3))]
        about = tuple(rows) if count == 1 else ()
        ids, numbers = (
            tuple(element.id for element in chosen),
            tuple(element.number for element in chosen),
        )
        found.append(Decision(kind, ids, numbers, "machine", "So.", {}, about))
    return found
