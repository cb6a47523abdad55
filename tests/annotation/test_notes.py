"""Notes on elements, and edits of many labels: what they do, refuse, and survive."""

from pathlib import Path

import pytest

from semviz_annotation.labels.edits import (
    AcceptFrame,
    AddMany,
    AddObservation,
    DeleteElement,
    DeleteNote,
    Link,
    MoveObservation,
    ReSnap,
    ReviewFrame,
    SendBackFrame,
    SetClassOfViews,
    Unlink,
    WriteNote,
)
from semviz_annotation.labels.labels import Labels, Note, new_id
from semviz_annotation.labels.rows import Rules
from semviz_annotation.storage.backup import export_operations, import_operations
from semviz_annotation.storage.integrity import check_labels
from semviz_annotation.storage.operations import EditBase
from semviz_annotation.storage.placement import is_accepted
from semviz_annotation.storage.store import ConflictError, LabelStore
from semviz_annotation.storage.teamwork import AssignedFrames, assignment_text
from semviz_core.common.errors import SemvizError

RULES = Rules()


def sign(element_id: str, frame: int, class_id: int | None = None) -> AddObservation:
    return AddObservation(
        new_id(), element_id, frame, "left", (10.0 + frame, 20.0), class_id=class_id
    )


def track(frames: int = 4, class_id: int = 3, first: int = 0) -> tuple[str, AddMany]:
    element_id = new_id()
    rows = [sign(element_id, first + n, None if n else class_id) for n in range(frames)]
    return element_id, AddMany(tuple(rows))


def note(element_id: str, text: str = "look", unsure: bool = False, frame: int | None = 1) -> Note:
    return Note(new_id(), element_id, frame, unsure, text, "ann", "2026-01-01T00:00:00.000+00:00")


def after(labels: Labels, *edits) -> Labels:
    for edit in edits:
        labels = labels.changed(edit.changes(labels, RULES))
    return labels


def test_a_note_is_kept_and_goes_along_with_its_element(path: Path, tmp_path: Path) -> None:
    first, draw_first = track()
    second, draw_second = track(first=10)
    written = note(second, frame=11)
    with LabelStore.open(path) as store:
        store.apply(draw_first, "ann")
        store.apply(draw_second, "ann")
        store.apply(WriteNote(written), "ann")
        store.apply(Link((first, second)), "bea")
        (moved,) = store.labels.notes_of(first)
        assert (moved.id, moved.author, moved.text) == (written.id, "ann", "look")
        store.undo("bea")
        assert store.labels.notes_of(second) == (written,)
        store.apply(DeleteElement(second), "bea")
        assert not store.labels.notes
        store.undo("bea")
        export_operations(store, tmp_path / "log.jsonl")
    check_labels(path)
    with LabelStore.open(path) as store, LabelStore.open(tmp_path / "other.db") as other:
        assert store.labels.notes_of(second) == (written,)
        import_operations(tmp_path / "log.jsonl", other)
        assert other.labels == store.labels


def test_a_split_takes_along_the_notes_of_its_frames() -> None:
    element_id, draw = track()
    here, whole, before = note(element_id, frame=3), note(element_id, frame=None), note(element_id)
    labels = after(Labels(), draw, *map(WriteNote, (here, whole, before)))
    rows = [row.id for row in labels.of_element(element_id) if row.frame_index >= 2]
    new = new_id()
    labels = after(labels, Unlink(tuple(rows), new))
    assert [row.id for row in labels.notes_of(new)] == [here.id]
    assert {row.id for row in labels.notes_of(element_id)} == {whole.id, before.id}


def test_a_note_says_something_about_an_element_that_is_there() -> None:
    element_id, draw = track()
    labels = after(Labels(), draw)
    with pytest.raises(SemvizError, match="a note has a text, or says that"):
        after(labels, WriteNote(note(element_id, text="")))
    with pytest.raises(SemvizError, match="no element"):
        after(labels, WriteNote(note(new_id())))
    with pytest.raises(SemvizError, match="deleted already"):
        after(labels, DeleteNote(new_id()))
    unsure = note(element_id, text="", unsure=True)
    assert after(labels, WriteNote(unsure), DeleteNote(unsure.id)) == labels


def test_a_class_over_a_range_is_an_element_of_its_own_unless_it_is_all_of_it() -> None:
    element_id, draw = track()
    labels = after(Labels(), draw)
    rows = [row.id for row in labels.of_element(element_id)]
    new = new_id()
    split = after(labels, SetClassOfViews(tuple(rows[2:]), 1, new))
    assert (split.elements[element_id].class_id, split.elements[new].class_id) == (3, 1)
    assert [row.id for row in split.of_element(new)] == rows[2:]
    whole = after(labels, SetClassOfViews(tuple(rows), 1, new))
    assert whole.elements.keys() == {element_id}
    assert whole.elements[element_id].class_id == 1
    with pytest.raises(SemvizError, match="cannot become a pole"):
        after(labels, SetClassOfViews(tuple(rows[2:]), 0, new))


def test_a_resnap_moves_all_or_none_and_overwrites_nobody(path: Path) -> None:
    element_id, draw = track()
    with LabelStore.open(path) as store:
        store.apply(draw, "ann")
        base = EditBase.at(store.end)
        rows = store.labels.of_element(element_id)
        moves = tuple(MoveObservation(row.id, (50.0, 50.0)) for row in rows)
        store.apply(MoveObservation(rows[2].id, (11.0, 11.0)), "bea")
        before = store.labels
        with pytest.raises(ConflictError, match="bea changed"):
            store.apply(ReSnap(moves), "ann", base=base)
        assert store.labels == before
        store.apply(ReSnap((moves[0], moves[1])), "ann", base=base)
        assert store.labels.observations[rows[2].id].anchor_px == (11.0, 11.0)
        store.undo("ann")
        assert store.labels == before


def test_who_placed_a_label_is_known_after_links_and_splits(path: Path) -> None:
    """Linking and splitting write the row, and not its ends."""
    element_id, draw = track()
    drawn = sign(new_id(), 9, class_id=3)
    with LabelStore.open(path) as store:
        store.apply(draw, "ann")
        store.apply(drawn, "bea")
        store.apply(Link((element_id, drawn.element_id)), "cy")
        rows = [row.id for row in store.labels.of_element(element_id)]
        store.apply(Unlink(tuple(rows[2:]), new_id()), "cy")
        placed = store.placing_operations(rows)
    assert {id_ for id_ in rows if not is_accepted(placed[id_])} == {drawn.observation_id}
    assert placed[drawn.observation_id].author == "bea"
    assert {placed[id_].author for id_ in rows[:-1]} == {"ann"}


def test_files_without_notes_are_upgraded_and_their_log_stays(path: Path) -> None:
    import sqlite3

    for center, old in (("box", 3), ("centroid", 4)):
        file = path.with_name(f"{old}.db")
        with LabelStore.open(file, triangle_center=center) as store:
            store.apply(track()[1], "ann")
            operations = store.operations()
        with sqlite3.connect(file) as connection:
            for table in ("notes", "declarations", "attribute_types", "attributes", "outlines"):
                connection.execute(f"DROP TABLE {table}")
            connection.execute(f"PRAGMA user_version = {old}")
        assert check_labels(file).operations == 1
        with LabelStore.open(file) as store:
            assert store.operations() == operations
            assert store.labels.triangle_center == center
            (element_id,) = store.labels.elements
            store.apply(WriteNote(note(element_id)), "ann")
        check_labels(file)


def test_the_log_tells_who_accepted_a_frame_and_an_undo_takes_it_back(path: Path) -> None:
    _, draw = track(2)
    with LabelStore.open(path) as store:
        store.apply(draw, "ann")
        with pytest.raises(SemvizError, match="frame 0 is not marked as reviewed"):
            store.apply(AcceptFrame(0), "bea")
        store.apply(ReviewFrame(0, "reviewed"), "ann")
        store.apply(AcceptFrame(0), "bea")
        reviews, tallies, *_ = store.team()
        assert (reviews[0].kind, reviews[0].author) == ("accept frame", "bea")
        assert (tallies["ann"].edits, tallies["bea"].edits) == (2, 1)
        store.undo("bea")
        assert store.team()[0][0].kind == "undo"
        assert store.labels.review(0) == "reviewed"
        store.apply(SendBackFrame(0), "bea")
        assert store.labels.review(0) == "in work"
        with pytest.raises(SemvizError, match="not marked as reviewed"):
            store.apply(AcceptFrame(0), "bea")
    check_labels(path)


def test_assignments_are_read_from_the_log(path: Path) -> None:
    with LabelStore.open(path) as store:
        for name, frames in (("ann lee", (0, 9)), ("bea", (5, 7)), ("ann lee", (20, 29))):
            store.state("assign", assignment_text(name, AssignedFrames(*frames)), "eva")
        assert store.team()[1:3] == ({}, {"ann lee": [(0, 9), (20, 29)], "bea": [(5, 7)]})
        store.state("assign", assignment_text("ann lee", None), "eva")
        assert store.team()[2] == {"bea": [(5, 7)]}
        assert store.undoable("eva") is None
    check_labels(path)
