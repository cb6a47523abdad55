"""Several people edit at once: no acknowledged change is taken back by a page that lacks it."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError
from random_edits import pole, random_edit

from semviz_annotation.labels.edits import (
    AnyEdit,
    DeleteElement,
    DeleteObservation,
    MoveObservation,
    ReviewFrame,
    SetClass,
    SetKnown,
    SwapEnds,
)
from semviz_annotation.labels.labels import Labels, Observation, Review, new_id
from semviz_annotation.labels.rows import RowChange
from semviz_annotation.storage.backup import backup_labels, restore_labels
from semviz_annotation.storage.store import (
    ConflictError,
    EditBase,
    LabelStore,
    Operation,
    ReplacedLogError,
)
from semviz_core.common.errors import SemvizError


@dataclass
class Client:
    """A page: what it shows, what it showed when the edit in hand was begun, and its requests."""

    author: str
    shown: Labels = field(default_factory=Labels)
    begun: tuple[Labels, Callable[["Client", LabelStore], Operation]] | None = None
    requests: list[str] = field(default_factory=list)

    def base(self) -> EditBase:
        assert self.begun is not None
        return EditBase(self.begun[0].operation, tuple(self.requests))

    def request(self) -> str:
        self.requests.append(new_id())
        return self.requests[-1]


def begin(client: Client, rng: np.random.Generator) -> None:
    """Start an edit of what is on screen: a drag of one end or both, a flag, a class, a review."""
    labels = client.shown
    what = rng.integers(9)
    if what == 0:
        client.begun = labels, lambda me, store: store.undo(me.author, me.request(), base=me.base())
    elif what == 1:
        client.begun = labels, lambda me, store: store.redo(me.author, me.request(), me.base())
    elif what == 2 and labels.operation > 3:
        number = int(rng.integers(1, labels.operation))
        client.begun = (
            labels,
            lambda me, store: store.restore(number, me.author, me.request(), me.base()),
        )
    else:
        edit = page_edit(labels, rng)
        client.begun = (
            labels,
            lambda me, store: store.apply(edit, me.author, me.request(), base=me.base()),
        )


def page_edit(labels: Labels, rng: np.random.Generator) -> AnyEdit:
    rows = list(labels.observations.values())
    if not rows or rng.integers(3) == 0:
        return random_edit(labels, rng)
    row = rows[rng.integers(len(rows))]
    u, v = (float(at) for at in rng.uniform(0, 300, 2))
    choices: list[AnyEdit] = [
        MoveObservation(row.id, (u, v)),
        MoveObservation(row.id, None, (u, v) if row.end_px else None),
        SetKnown(row.id, not row.anchor_known),
        SetKnown(row.id, None, not row.end_known),
        SwapEnds(row.id),
        SetClass(row.element_id, int(rng.integers(1, 4))),
        ReviewFrame(row.frame_index, ("reviewed", "unseen", "in work")[rng.integers(3)]),
        DeleteObservation(row.id),
        DeleteElement(row.element_id),
    ]
    return choices[rng.choice(len(choices), p=[0.2, 0.2, 0.15, 0.15, 0.05, 0.1, 0.05, 0.05, 0.05])]


class Witness:
    """Remembers who wrote each field last, and what each page saw."""

    def __init__(self) -> None:
        self.writers: dict[tuple[Any, str], int] = {}
        self.reverted: list[RowChange] = []

    def acknowledged(self, who: int, saw: Labels, operation: Operation) -> None:
        for change in operation.changes:
            row = change.before or change.after
            assert row is not None
            for one in fields(row):
                was, now = (getattr(side, one.name, None) for side in (change.before, change.after))
                if was == now:
                    continue
                seen = getattr(saw.row(change.key), one.name, None)
                if seen != was and self.writers.get((change.key, one.name)) != who:
                    self.reverted.append(change)
                self.writers[change.key, one.name] = who


def edit_together(
    store: LabelStore, clients: list[Client], rng: np.random.Generator, steps: int, checked: bool
) -> tuple[Witness, int]:
    """Let ``clients`` edit in turn, with old pictures on their screens. Return the witness, and
    how many edits were refused as conflicts."""
    witness, conflicts = Witness(), 0
    for _ in range(steps):
        who = int(rng.integers(len(clients)))
        client = clients[who]
        if rng.integers(3) == 0:
            client.shown = store.labels
        if client.begun is None:
            begin(client, rng)
            continue
        saw, run = client.begun
        if not checked:
            client.begun = Labels(operation=store.last_operation), run
        try:
            witness.acknowledged(who, saw, run(client, store))
        except ConflictError:
            conflicts += 1
        except SemvizError:
            pass
        client.begun = None
    return witness, conflicts


@pytest.mark.parametrize("authors", [("ann", "bea"), ("ann", "ann"), ("ann", "bea", "cid", "ann")])
@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_no_acknowledged_change_is_reverted_by_a_page_that_did_not_show_it(authors, seed):
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder, LabelStore.open(Path(folder) / "l.db") as store:
        for frame in range(2):
            store.apply(pole(frame), "ann")
        clients = [Client(author, store.labels) for author in authors]
        witness, _ = edit_together(store, clients, rng, 120, checked=True)
    assert witness.reverted == []


def test_the_witness_sees_changes_that_are_reverted(store):
    """Edits that do not say what they are based on take others' work back: the law can fail."""
    for frame in range(2):
        store.apply(pole(frame), "ann")
    clients = [Client(name, store.labels) for name in ("ann", "bea")]
    witness, conflicts = edit_together(store, clients, np.random.default_rng(4), 200, checked=False)
    assert len(witness.reverted) > 5
    assert conflicts == 0


def test_a_drag_and_a_nudge_of_different_ends_are_both_kept(store):
    """One drags the bottom; the other nudges the peak and says that the bottom is hidden."""
    drawn = pole()
    begun = store.apply(drawn, "ann").number
    store.apply(MoveObservation(drawn.observation_id, anchor_px=(1.5, 2.0)), "ann")
    store.apply(SetKnown(drawn.observation_id, end_known=False), "ann")
    move = MoveObservation(drawn.observation_id, end_px=(9.0, 50.0))
    store.apply(move, "bea", base=EditBase(begun))
    row = store.labels.observation(drawn.observation_id)
    assert (row.anchor_px, row.end_px, row.end_known) == ((1.5, 2.0), (9.0, 50.0), False)


def test_the_same_end_twice_is_asked_about_and_then_overwritten(store):
    drawn = pole()
    begun = EditBase(store.apply(drawn, "ann").number)
    theirs = store.apply(MoveObservation(drawn.observation_id, end_px=(4.0, 41.0)), "ann")
    mine = MoveObservation(drawn.observation_id, end_px=(9.0, 50.0))
    with pytest.raises(ConflictError, match=r"ann changed P-01 .*operation 2, move.*or thei") as no:
        store.apply(mine, "bea", base=begun)
    assert no.value.overwritten == (theirs.request_id,)
    assert not no.value.is_deleted
    store.apply(mine, "bea", base=EditBase(begun.operation, no.value.overwritten))
    assert store.labels.observation(drawn.observation_id).end_px == (9.0, 50.0)


def test_a_flag_does_not_go_to_the_other_end_of_a_swapped_pole(store):
    drawn = pole()
    begun = EditBase(store.apply(drawn, "ann").number)
    store.apply(SwapEnds(drawn.observation_id), "ann")
    with pytest.raises(ConflictError, match="swap ends"):
        store.apply(SetKnown(drawn.observation_id, end_known=False), "bea", base=begun)


def test_what_was_deleted_meanwhile_is_asked_about(store):
    drawn = pole()
    begun = EditBase(store.apply(drawn, "ann").number)
    store.apply(DeleteObservation(drawn.observation_id), "ann")
    with pytest.raises(ConflictError, match="delete") as deleted:
        store.apply(MoveObservation(drawn.observation_id, (7.0, 7.0)), "bea", base=begun)
    assert deleted.value.is_deleted


def test_a_class_and_a_review_are_not_overwritten_unseen(store):
    drawn = pole()
    sign = type(drawn)(new_id(), new_id(), 1, "left", (5.0, 5.0), class_id=1)
    store.apply(sign, "ann")
    begun = EditBase(store.last_operation)
    store.apply(SetClass(sign.element_id, 2), "ann")
    store.apply(ReviewFrame(1, "reviewed"), "ann")
    for edit in (SetClass(sign.element_id, 3), ReviewFrame(1, "in work")):
        with pytest.raises(ConflictError, match="ann changed"):
            store.apply(edit, "bea", base=begun)
    moved = MoveObservation(sign.observation_id, (6.0, 5.0))
    store.apply(moved, "bea", base=begun)
    assert store.labels.row((Review, 1)) == Review(1, "reviewed")
    row = store.labels.row((Observation, sign.observation_id))
    assert isinstance(row, Observation)
    assert row.anchor_px == (6.0, 5.0)


def test_undo_leaves_what_the_same_person_did_on_another_page_unseen(store):
    first, second = pole(0), pole(1)
    seen = store.apply(first, "ann").number
    other = store.apply(second, "ann")
    done = store.undo("ann", base=EditBase(seen))
    assert done.undoes == seen
    assert "newer than what you see" in done.text
    assert store.undo("ann", base=EditBase(seen, (other.request_id,))).undoes == other.number


def test_a_flag_does_not_go_to_the_other_end_after_a_swap_and_a_move(store):
    """Ann swaps the ends and moves one; Bea restores the state before; Ann sets a flag offline."""
    drawn = pole()
    begun = store.apply(drawn, "ann").number
    store.apply(SwapEnds(drawn.observation_id), "ann")
    seen = store.apply(MoveObservation(drawn.observation_id, end_px=(5.0, 5.0)), "ann").number
    store.restore(begun, "bea")
    edit = SetKnown(drawn.observation_id, anchor_known=False)
    with pytest.raises(ConflictError, match="bea changed"):
        store.apply(edit, "ann", base=EditBase(seen))


def test_an_edit_that_is_invalid_only_on_what_others_did_is_asked_about(store):
    """Bea moved the bottom up to where Ann, offline, brings the peak: not an error of Ann's."""
    drawn = pole()
    begun = EditBase(store.apply(drawn, "ann").number)
    theirs = store.apply(MoveObservation(drawn.observation_id, end_px=(3.0, 20.0)), "bea")
    mine = MoveObservation(drawn.observation_id, anchor_px=(3.0, 20.0))
    with pytest.raises(ConflictError, match="bea changed") as no:
        store.apply(mine, "ann", base=begun)
    assert no.value.overwritten == (theirs.request_id,)
    assert not no.value.is_deleted
    with pytest.raises(SemvizError, match="click them apart") as known:
        store.apply(mine, "ann", base=EditBase(begun.operation, no.value.overwritten))
    assert not isinstance(known.value, ConflictError)


def test_a_base_after_the_last_operation_is_of_a_replaced_log(tmp_path):
    """A page saw operation 6; a backup of operation 1 is restored, and others go on."""
    drawn = pole()
    with LabelStore.open(tmp_path / "labels.db") as store:
        store.apply(drawn, "ann")
        backup_labels(store.path, tmp_path / "backup.db")
        for u in range(5):
            seen = store.apply(MoveObservation(drawn.observation_id, end_px=(u, 44.0)), "ann")
        restore_labels(store.path, tmp_path / "backup.db")
        store.apply(MoveObservation(drawn.observation_id, end_px=(4.0, 41.0)), "bea")
        assert seen.number > store.last_operation
        mine = MoveObservation(drawn.observation_id, end_px=(9.0, 50.0))
        with pytest.raises(ConflictError, match="bea changed"):
            store.apply(mine, "ann", base=EditBase(seen.number))


def test_a_base_of_a_replaced_log_is_refused_though_its_number_is_in_use_again(tmp_path):
    """Numbers alone would say that the page had seen what bea did: her work would be lost."""
    drawn = pole()
    move = partial(MoveObservation, drawn.observation_id)
    with LabelStore.open(tmp_path / "labels.db") as store:
        store.apply(drawn, "ann")
        first = store.end
        backup_labels(store.path, tmp_path / "backup.db")
        store.apply(move(end_px=(1.0, 44.0)), "ann", "sent again")
        seen = EditBase.at(store.end)
        restore_labels(store.path, tmp_path / "backup.db")
        for u in range(3):
            theirs = store.apply(move(end_px=(2.0, 50.0 + u)), "bea")
        assert seen.operation < store.last_operation
        for refused in (
            lambda: store.apply(move(end_px=(9.0, 50.0)), "ann", base=seen),
            lambda: store.apply(pole(), "ann", base=seen),
            lambda: store.undo("bea", base=seen),
            lambda: store.redo("bea", base=seen),
            lambda: store.restore(2, "ann", base=seen),
        ):
            with pytest.raises(ReplacedLogError, match="a backup replaced the labels"):
                refused()
        assert store.last_operation == theirs.number
        assert store.holds(first)
        store.apply(move((9.0, 9.0)), "ann", base=EditBase.at(first))
        again = store.apply(
            move(end_px=(1.0, 44.0)), "ann", "sent again", base=EditBase.at(store.end)
        )
        same = store.apply(move(end_px=(1.0, 44.0)), "ann", "sent again", base=seen)
        assert same == again  # it is saved: nothing to ask


def test_a_base_is_checked_when_it_is_read():
    for wrong in ("x" * 64, "ab", 7, None):
        with pytest.raises(ValidationError):
            TypeAdapter(EditBase).validate_python({"operation": 1, "known": (), "hash": wrong})
