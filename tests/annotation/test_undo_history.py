"""Undo with others about, former states, names, and whose work a machine may touch."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_edits import pole, random_edit

from semviz_annotation.labels.edits import (
    AddMany,
    AddObservation,
    DecideElements,
    DeleteElement,
    Dismiss,
    MoveObservation,
    ReviewFrame,
)
from semviz_annotation.labels.labels import (
    Dismissal,
    Labels,
    Observation,
    new_id,
    proposal_id,
    row_key,
)
from semviz_annotation.labels.rows import different_elements, review_decision
from semviz_annotation.storage.store import EditBase, LabelStore
from semviz_core.common.errors import SemvizError


def moved(edit: AddObservation, u: float) -> MoveObservation:
    return MoveObservation(edit.observation_id, (u, 2.0))


# -- undo


def test_a_blocked_edit_does_not_block_those_before_it(path):
    mine = [pole(frame) for frame in range(3)]
    with LabelStore.open(path) as store:
        for edit in mine:
            store.apply(edit, "ann")
        store.apply(moved(mine[2], 9.0), "bea")
        undo = store.undo("ann")
        assert undo.undoes == 2
        assert undo.text == (
            "operation 3 (add): bea changed P-03 in the left image of frame 2 since "
            "(operation 4, move)"
        )
        assert store.undo("ann").undoes == 1
        with pytest.raises(SemvizError, match=r"Cannot undo operation 3 \(add\): bea changed P-03"):
            store.undo("ann")
    with LabelStore.open(path) as store:  # all the same after a restart
        assert [store.redo("ann").redoes for _ in range(2)] == [1, 2]
        store.undo("bea")
        assert [store.undo("ann").undoes for _ in range(3)] == [2, 1, 3]
        assert store.labels == Labels()


def test_a_redo_that_is_blocked_is_passed_over_too(store):
    first, second = pole(0), pole(1)
    store.apply(first, "ann")
    store.apply(second, "bea")
    store.apply(moved(first, 5.0), "ann")
    store.apply(moved(second, 5.0), "ann")
    store.undo("ann")
    store.undo("ann")
    store.apply(moved(first, 7.0), "bea")
    redo = store.redo("ann")
    assert redo.redoes == 4
    assert "operation 3 (move): bea changed P-01" in redo.text


def test_one_edit_is_undone_by_its_number(store):
    mine = [pole(frame) for frame in range(3)]
    for edit in mine:
        store.apply(edit, "ann")
    store.apply(moved(mine[0], 5.0), "ann")
    assert store.undo("ann", number=2).undoes == 2
    assert store.labels.frames == (0, 2)
    with pytest.raises(SemvizError, match=r"Cannot undo operation 1 \(add\): ann changed P-01 .*4"):
        store.undo("ann", number=1)
    for author, number in (("ann", 2), ("bea", 3), ("ann", 99)):
        with pytest.raises(SemvizError, match=f"Cannot undo operation {number}: it is no edit of"):
            store.undo(author, number=number)
    assert store.redo("ann").redoes == 2


def test_a_decision_of_others_is_named(store):
    mine, theirs = pole(0), pole(1)
    store.apply(mine, "ann")
    store.apply(theirs, "bea")
    store.apply(DecideElements((different_elements(mine.element_id, theirs.element_id),)), "bea")
    with pytest.raises(SemvizError, match=r"bea changed the decision about P-0. and P-0. since"):
        store.undo("ann")
    store.undo("bea")
    store.apply(DecideElements((review_decision(mine.element_id, "keep"),)), "ann")
    store.apply(DecideElements((review_decision(mine.element_id, "leave out"),)), "bea")
    with pytest.raises(SemvizError, match=r"bea changed the decision about P-01 since"):
        store.undo("ann")


def test_what_was_deleted_is_named_as_it_was(store):
    mine = pole(4)
    store.apply(mine, "ann")
    store.apply(DeleteElement(mine.element_id), "bea")
    with pytest.raises(SemvizError, match=r"bea changed P-01 .*\(operation 2, delete element\)"):
        store.undo("ann")


def test_a_dismissal_or_a_review_of_others_is_named(store):
    mine = pole(0)
    store.apply(mine, "ann")
    down = Dismissal(proposal_id(mine.element_id, 1, "left"), 1, "left", "absent", mine.element_id)
    store.apply(Dismiss((down,)), "bea")
    with pytest.raises(SemvizError, match=r"bea changed P-01 in the left image of frame 1"):
        store.undo("ann")
    store.apply(ReviewFrame(8, "in work"), "ann")
    store.apply(ReviewFrame(8, "reviewed, empty"), "bea")
    with pytest.raises(SemvizError, match="bea changed the review of frame 8"):
        store.undo("ann")


# -- what the author saw


def test_a_repeated_request_is_no_conflict(store):
    edit, request = pole(), new_id()
    seen = EditBase(store.apply(edit, "ann").number)
    first = store.apply(moved(edit, 5.0), "ann", request, base=seen)
    assert store.apply(moved(edit, 5.0), "ann", request, base=seen) == first


def test_restoring_and_naming_are_done_once_a_request(store):
    store.apply(pole(), "ann")
    restoring, naming = new_id(), new_id()
    assert store.restore(0, "ann", restoring) == store.restore(0, "ann", restoring)
    assert store.name_state("none", "ann", naming) == store.name_state("none", "ann", naming)
    assert store.last_operation == 3


# -- machines


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_no_machine_ever_overwrites_a_human(seed):
    rng = np.random.default_rng(seed)
    by_human: set[object] = set()
    machine_wrote = 0
    with tempfile.TemporaryDirectory() as folder, LabelStore.open(Path(folder) / "l.db") as store:
        for _ in range(60):
            before, what = store.labels, rng.integers(9)
            author = ("ann", "bea", "detector")[rng.integers(3)]
            try:
                if what == 0:
                    operation = store.undo(author)
                elif what == 1:
                    operation = store.redo(author)
                elif what == 2 and author != "detector":
                    operation = store.restore(int(rng.integers(store.last_operation + 1)), author)
                else:
                    origin = "machine" if author == "detector" else "human"
                    operation = store.apply(random_edit(before, rng), author, origin=origin)
            except SemvizError:
                assert store.labels == before
                continue
            keys = {change.key for change in operation.changes}
            if author == "detector":
                assert operation.origin == "machine"
                assert not keys & by_human
                machine_wrote += len(keys)
            else:
                by_human |= keys
        for row in store.labels.observations.values():
            writer = store.last_writers([row.id])[row.id]
            assert (writer.origin == "human") == (row_key(row) in by_human)


def test_what_a_machine_may_not_touch_is_named(store):
    edit = pole()
    store.apply(edit, "detector", origin="machine")
    store.apply(moved(edit, 3.0), "detector", origin="machine")
    store.apply(moved(edit, 5.0), "ann")
    store.undo("ann")
    for change in (moved(edit, 7.0), DeleteElement(edit.element_id)):
        with pytest.raises(SemvizError, match="P-01 in the left image of frame 0 is a person's"):
            store.apply(change, "detector", origin="machine")
    with pytest.raises(SemvizError, match="is a person's work"):
        store.undo("detector")
    more = AddObservation(new_id(), edit.element_id, 1, "left", (1.0, 2.0), (3.0, 40.0))
    down = Dismissal(proposal_id(edit.element_id, 1, "left"), 1, "left", "absent", edit.element_id)
    store.apply(Dismiss((down,)), "ann")
    with pytest.raises(SemvizError, match="is a person's work"):
        store.apply(more, "detector", origin="machine")
    assert store.last_operation == 5


# -- former states


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_every_former_state_is_there_and_can_be_restored_and_the_restoring_undone(seed):
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "labels.db"
        states = [Labels()]
        with LabelStore.open(path) as store:
            while len(states) < 30:
                try:
                    if rng.integers(8) == 0 and len(states) > 2:
                        store.restore(int(rng.integers(len(states))), "bea")
                    else:
                        store.apply(random_edit(store.labels, rng), ("ann", "bea")[rng.integers(2)])
                except SemvizError:
                    continue
                states.append(store.labels)
            for number, state in enumerate(states):
                then = store.labels_at(number)
                assert (then, then.operation) == (state, number)
                assert then.next_number >= state.next_number
                assert then.frames == state.frames
        with LabelStore.open(path) as store:
            number = int(rng.integers(len(states) - 1))
            if store.labels != states[number]:
                operation = store.restore(number, "cat")
                assert (operation.kind, operation.text) == ("restore", f"operation {number}")
                assert store.labels == states[number]
                store.undo("cat")
                assert store.labels == states[-1]
        with LabelStore.open(path) as store:
            if store.redoable("cat"):
                store.redo("cat")
                assert store.labels == states[number]


def test_no_state_is_restored_that_never_was_or_that_is_there(store):
    store.apply(pole(), "ann")
    for number in (-1, 2):
        with pytest.raises(SemvizError, match=f"no operation {number}; the last one is 1"):
            store.restore(number, "ann")
    with pytest.raises(SemvizError, match="already those after operation 1"):
        store.restore(1, "ann")
    assert store.last_operation == 1


def test_states_get_names_and_naming_is_no_edit(path):
    with LabelStore.open(path) as store:
        store.apply(pole(0), "ann")
        named = store.name_state("  before\n lunch ", "ann")
        assert (named.kind, named.text, named.changes) == ("name", "before lunch", ())
        store.apply(pole(1), "ann")
        store.undo("ann")
        store.name_state("after", "ann")
        assert store.redoable("ann") == 3
        store.redo("ann")
        for name in ("", "   ", "x" * 101):
            with pytest.raises(SemvizError, match="1 to 100 characters"):
                store.name_state(name, "ann")
        with pytest.raises(SemvizError, match="operation 2 is already named"):
            store.name_state("before lunch", "bea")
        assert store.restore(named.number, "bea").text == "operation 2, 'before lunch'"
        assert store.labels.frames == (0,)
    with LabelStore.open(path) as store:
        assert [state.text for state in store.named()] == ["before lunch", "after"]
        assert store.undo("ann").undoes == 1  # not the name; 3 was taken back by bea's restore


# -- looking back


def test_operations_come_in_pages(store):
    for frame in range(9):
        store.apply(pole(frame), "ann")

    def numbers(**page: int) -> list[int]:
        return [operation.number for operation in store.operations(**page)]

    assert numbers() == list(range(1, 10))
    assert numbers(after=7) == [8, 9]
    assert numbers(after=2, limit=3) == [3, 4, 5]
    assert numbers(before=6, limit=3) == [3, 4, 5]
    assert numbers(after=4, before=6, limit=3) == [5]
    assert numbers(before=1, limit=3) == numbers(after=9) == numbers(limit=0) == []


def test_who_wrote_what_last(store):
    first, second = pole(0), pole(1)
    store.apply(AddMany((first, second)), "detector", origin="machine")
    operation = store.apply(moved(first, 4.0), "ann")
    ids = [first.observation_id, second.observation_id, new_id()]
    writers = store.last_writers(ids)
    assert list(writers) == ids[:2]
    entry, other = writers.values()
    assert entry == (2, "ann", "human", operation.time, "move")
    assert (other.number, other.author, other.origin) == (1, "detector", "machine")
    store.undo("ann")
    assert store.last_writers(ids)[ids[0]].kind == "undo"


def test_order_does_not_depend_on_the_clock_or_on_ids(path, monkeypatch):
    times = iter([5_000_000, 4_000_000, 3_000_000, 2_000_000, 1_000_000] * 10)
    monkeypatch.setattr(
        "semviz_annotation.labels.rows.time.time_ns", lambda: next(times) * 1_000_000
    )
    monkeypatch.setattr("semviz_annotation.storage.store._now", lambda: f"{next(times)}")
    with LabelStore.open(path) as store:
        edits = [pole(0) for _ in range(4)]
        assert [edit.element_id for edit in edits] != sorted(edit.element_id for edit in edits)
        for edit in edits:
            store.apply(edit, "ann")
        more = [
            AddObservation(new_id(), edits[1].element_id, f, "left", (1.0, 2.0), (3.0, 40.0))
            for f in (3, 2)
        ]
        for edit in more:
            store.apply(edit, "ann")
        live = store.labels
        assert [store.undo("ann").undoes for _ in range(2)] == [6, 5]
        assert [store.redo("ann").redoes for _ in range(2)] == [5, 6]
    with LabelStore.open(path) as store:
        labels = store.labels
        assert [row.element_id for row in labels.in_frame(0)] == [edit.element_id for edit in edits]
        assert labels.in_frame(0) == live.in_frame(0)
        seen: tuple[Observation, ...] = labels.of_element(edits[1].element_id)
        assert [row.frame_index for row in seen] == [0, 2, 3]
        assert [operation.number for operation in store.operations()] == list(range(1, 11))
        assert [store.undo("ann").undoes for _ in range(3)] == [6, 5, 4]
