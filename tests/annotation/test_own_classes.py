"""Classes and attributes of a workspace's own, and outlines: kept, logged, undone, never lost."""

import gzip
from dataclasses import replace
from pathlib import Path

import pytest

from semviz_annotation.labels.edits import (
    AddObservation,
    DeleteElement,
    DeleteObservation,
    Link,
    SetAttribute,
    SetClass,
)
from semviz_annotation.labels.labels import Labels, new_id
from semviz_annotation.labels.own_classes import (
    DeclareAttribute,
    DeclareClass,
    RemoveClass,
    class_keys,
)
from semviz_annotation.labels.rows import AttributeType, ClassDeclaration, Rules
from semviz_annotation.storage.backup import (
    backup_labels,
    check_labels,
    export_operations,
    import_operations,
    restore_labels,
)
from semviz_annotation.storage.operations import EditBase
from semviz_annotation.storage.store import ConflictError, LabelStore
from semviz_core.common.errors import SemvizError

OLD = Path(__file__).parent / "old_files"
GANTRY = ClassDeclaration(4, "gantry", "line", "G", "line", "#FF8800", "#803300", "5")
BEACON = ClassDeclaration(5, "beacon", "point", "B", "diamond", "#AA66FF", "#440088", "6")


def drawn(class_id: int, frame: int = 0) -> AddObservation:
    end = (3.0, 40.0) if class_id in (0, 4) else None
    return AddObservation(new_id(), new_id(), frame, "left", (1.0, 2.0), end, class_id=class_id)


def after(labels: Labels, *edits) -> Labels:
    for edit in edits:
        labels = labels.changed(edit.changes(labels, Rules(labels.classes)))
    return labels


@pytest.mark.parametrize(
    ("version", "number", "last"),
    [
        (5, 70, "1243643dd9973ab2a746fe21ff918e503c93309af6cd860b82ed754425ac48f7"),
        (6, 71, "bbc3fe9f23b871f29b501326a2394c23fb438b09341eec4c6735eb0190eee11d"),
    ],
)
def test_a_file_of_before_is_upgraded_and_its_chain_stays(tmp_path, version, number, last) -> None:
    content = gzip.decompress((OLD / f"labels-version-{version}.db.gz").read_bytes())
    path, untouched = tmp_path / "labels.db", tmp_path / "untouched.db"
    path.write_bytes(content)
    untouched.write_bytes(content)
    sound = check_labels(untouched)  # reads it upgraded, and leaves it as it is
    assert (sound.operations, sound.hash) == (number, last)
    assert untouched.read_bytes() == content
    with LabelStore.open(path) as store:
        assert (store.end.number, store.end.hash) == (number, last)
        assert [row.name for row in store.labels.classes][:1] == ["pole"]
        assert store.labels.triangle_center == ("box" if version == 5 else "centroid")
        store.apply(DeclareClass(GANTRY), "ann")
        store.apply(drawn(4), "ann")
        export_operations(store, tmp_path / "log.jsonl")
    assert check_labels(path).operations == number + 2
    with LabelStore.open(path) as store, LabelStore.open(tmp_path / "other.db") as other:
        import_operations(tmp_path / "log.jsonl", other)
        assert other.labels == store.labels
        assert store.undo("ann").kind == "undo"
        restored, _ = restore_labels(tmp_path / "third.db", untouched)
        assert restored.hash == last


def test_a_class_of_ones_own_is_drawn_named_and_found_after_reopening(tmp_path) -> None:
    path = tmp_path / "labels.db"
    with LabelStore.open(path) as store:
        with pytest.raises(SemvizError, match="unknown class 4"):
            store.apply(drawn(4), "ann")
        store.apply(DeclareClass(GANTRY), "ann")
        store.apply(DeclareClass(BEACON), "ann")
        add = drawn(4)
        store.apply(add, "ann")
        with pytest.raises(SemvizError, match="a gantry cannot become a beacon"):
            store.apply(SetClass(add.element_id, 5), "ann")
        store.apply(SetClass(add.element_id, 0), "ann")
        store.apply(SetClass(add.element_id, 4), "ann")
        backup_labels(path, tmp_path / "backup.db")
    for file in (path, tmp_path / "backup.db"):
        check_labels(file)
        with LabelStore.open(file) as store:
            assert store.labels.classes.element_name(4, 1) == "G-01"
            assert class_keys(store.labels) == dict(zip(range(6), "123456", strict=True))


def test_an_id_of_a_class_is_never_another_ones(tmp_path) -> None:
    with LabelStore.open(tmp_path / "labels.db") as store:
        assert store.free_class_id() == 4
        store.apply(DeclareClass(GANTRY), "ann")
        add = drawn(4)
        store.apply(add, "bea")
        with pytest.raises(SemvizError, match="1 elements are of the class gantry"):
            store.apply(RemoveClass(4), "ann")
        with pytest.raises(SemvizError, match="Cannot undo"):
            store.undo("ann")
        store.apply(DeleteElement(add.element_id), "bea")
        store.apply(RemoveClass(4), "ann")
        assert store.free_class_id() == 5
        with pytest.raises(SemvizError, match="unknown class 4"):
            store.undo("bea")  # its class is gone
        store.undo("ann")
        store.undo("bea")
        assert store.labels.elements[add.element_id].class_id == 4
        state = store.last_operation
        store.apply(DeleteElement(add.element_id), "bea")
        store.apply(RemoveClass(4), "ann")
        store.restore(state, "ann")  # brings the class back with its element
        assert store.labels.elements[add.element_id].class_id == 4
    check_labels(tmp_path / "labels.db")


@pytest.mark.parametrize(
    ("other", "why"),
    [
        (replace(BEACON, name="gantry"), "share the same name"),
        (replace(BEACON, name="pole"), "share the same name"),
        (replace(BEACON, letter="P"), "share the same letter"),
        (replace(BEACON, key="5"), "share a key"),
        (replace(GANTRY, kind="point"), "is line-like and stays so"),
    ],
)
def test_a_declaration_that_contradicts_another_is_refused(other, why) -> None:
    labels = after(Labels(), DeclareClass(GANTRY))
    with pytest.raises(SemvizError, match=why):
        after(labels, DeclareClass(other))


def test_values_are_of_their_type() -> None:
    add = drawn(0)
    height = AttributeType("height", "number", ())
    state = AttributeType("state", "choice", ("new", "bent"))
    labels = after(Labels(), add, DeclareAttribute(height), DeclareAttribute(state))

    def value(name: str, text: str | None) -> str | None:
        rows = after(labels, SetAttribute(add.element_id, name, text)).attributes_of(add.element_id)
        return rows[0].value if rows else None

    assert value("lamp", "True") == "yes"
    assert value("height", "4.50") == "4.5"
    assert value("height", "4") == "4"
    assert value("state", "bent") == "bent"
    assert value("anything", " free  text ") == "free text"
    assert value("lamp", None) is None
    for name, text in (
        ("lamp", "perhaps"),
        ("height", "tall"),
        ("state", "old"),
        ("material", " "),
    ):
        with pytest.raises(SemvizError, match=name if name != "material" else "a value has 1 to"):
            value(name, text)
    written = after(labels, SetAttribute(add.element_id, "bolts", "four"))
    with pytest.raises(SemvizError, match="bolts is a number, not 'four'"):
        after(written, DeclareAttribute(AttributeType("bolts", "number", ())))
    with pytest.raises(SemvizError, match="the type choice has choices"):
        after(labels, DeclareAttribute(AttributeType("side", "choice", ())))


def test_attributes_go_with_their_element_and_merge_by_name(tmp_path) -> None:
    first, second = drawn(0), drawn(0, frame=1)
    with LabelStore.open(tmp_path / "labels.db") as store:
        store.apply(first, "ann")
        store.apply(second, "ann")
        store.apply(SetAttribute(first.element_id, "material", "wood"), "ann")
        store.apply(SetAttribute(second.element_id, "material", "steel"), "ann")
        store.apply(SetAttribute(second.element_id, "lamp", "yes"), "ann")
        store.apply(Link((first.element_id, second.element_id)), "ann")
        kept = {row.name: row.value for row in store.labels.attributes_of(first.element_id)}
        assert kept == {"lamp": "yes", "material": "wood"}
        store.undo("ann")
        assert len(store.labels.attributes) == 3
        base = EditBase.at(store.end)
        store.apply(SetAttribute(second.element_id, "lamp", "no"), "bea", base=base)
        store.apply(SetAttribute(second.element_id, "sign code", "x"), "cid", base=base)
        with pytest.raises(ConflictError, match="bea changed lamp of P-02"):
            store.apply(SetAttribute(second.element_id, "lamp", "yes"), "cid", base=base)
        store.apply(DeleteObservation(second.observation_id), "ann")
        assert len(store.labels.attributes) == 1
        store.undo("ann")
        assert len(store.labels.attributes) == 4
    check_labels(tmp_path / "labels.db")
