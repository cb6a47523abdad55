"""Absurd values anywhere in a file of another tool: one short line, never a traceback."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from label_files import FRAMES, labels_of, store_of, street

from semviz_annotation.label_formats.exchange import export_labels, import_labels
from semviz_core.common.errors import SemvizError

LONGEST = 500
ABSURD = {
    "long name": json.dumps("n" * 3000),
    "digits": "9" * 5000,
    "fewer digits": "9" * 4000,
    "lone surrogate": '"\\ud800"',
    "infinite": "1e999",
    "Infinity": "-Infinity",
    "deep": "[" * 100_000 + "]" * 100_000,
    "null": "null",
}


def places(value: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Every key of a JSON document, and the first items of its lists."""
    if isinstance(value, dict | list):
        items = list(value.items() if isinstance(value, dict) else enumerate(value))
        for key, inner in items if isinstance(value, dict) else items[:2]:
            yield (*place, key)
            yield from places(inner, (*place, key))


def with_value(document: Any, place: tuple[Any, ...], text: str) -> str:
    copy = part = json.loads(json.dumps(document))
    for key in place[:-1]:
        part = part[key]
    part[place[-1]] = "@@"
    return json.dumps(copy).replace('"@@"', text)


@pytest.mark.parametrize("absurd", ABSURD)
@pytest.mark.parametrize("format_", ["coco", "labelme"])
def test_absurd_json_is_refused_in_one_short_line(tmp_path, format_, absurd):
    target, bad = tmp_path / "out.json", tmp_path / "bad.json"
    with store_of(street(), tmp_path / "first") as store:
        export_labels(store, target, format_)
    file = target if target.is_file() else min(target.rglob("*.json"))
    document = json.loads(file.read_text())
    refused = 0
    with store_of(labels_of(), tmp_path / "second") as store:
        for place in places(document):
            bad.write_text(with_value(document, place, ABSURD[absurd]))
            refused += is_refused(bad, store, format_)
    assert refused


@pytest.mark.parametrize("absurd", ["n" * 3000, "9" * 5000, "inf", "nan", "1e999", "&#xD800;"])
def test_absurd_xml_is_refused_in_one_short_line(tmp_path, absurd):
    with store_of(street(), tmp_path / "first") as store:
        export_labels(store, tmp_path / "out.xml", "cvat")
    parts = (tmp_path / "out.xml").read_text().split('"')
    bad, refused = tmp_path / "bad.xml", 0
    with store_of(labels_of(), tmp_path / "second") as store:
        for at in range(1, len(parts), 2):
            bad.write_text('"'.join([*parts[:at], absurd, *parts[at + 1 :]]))
            refused += is_refused(bad, store, "cvat")
        bad.write_text("<a>" * 100_000 + "</a>" * 100_000)
        assert is_refused(bad, store, "cvat")
    assert refused


def is_refused(path: Path, store: Any, format_: Any) -> bool:
    """Whether an import is refused; some absurd values are dropped or do not matter."""
    try:
        import_labels(path, store, "ann", format_, frames=FRAMES)
    except SemvizError as error:
        words = str(error)
        if "\n" in words or len(words) > LONGEST or not words.isascii():
            raise AssertionError(f"not one short line: {words[:200]!r}") from None
        return True
    return False


def test_a_text_that_is_not_unicode_is_refused_in_one_line(tmp_path):
    """Bytes of a command line that are not UTF-8 come as lone surrogates."""
    with store_of(street(), tmp_path / "first") as store:
        before = store.last_operation
        for text in ("\udcff", "\ud800"):
            with pytest.raises(SemvizError, match="characters that are not Unicode"):
                store.name_state("a", text)
            with pytest.raises(SemvizError, match="characters that are not Unicode"):
                store.name_state(text, "ann")
        assert store.last_operation == before
