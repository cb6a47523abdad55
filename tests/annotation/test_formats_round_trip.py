"""Labels written to a format and read back are the same, to the last digit."""

import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from label_files import FRAMES, RIG, RULES, any_labels, said, store_of, street

from semviz_annotation.label_formats.coco import read_coco, write_coco
from semviz_annotation.label_formats.cvat import read_cvat, write_cvat, write_cvat_video
from semviz_annotation.label_formats.exchange import export_labels, import_labels
from semviz_annotation.label_formats.import_context import LabelImportContext
from semviz_annotation.label_formats.import_plan import ImportLabels, plan_import
from semviz_annotation.label_formats.labelme import read_labelme, write_labelme
from semviz_annotation.label_formats.reading import (
    ParsedLabels,
    from_corner,
    to_corner,
)
from semviz_annotation.label_formats.writing import LabelExportContext, Sidecar
from semviz_annotation.labels.labels import Labels, RowChange
from semviz_annotation.labels.rows import review_decision
from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.base.frame import Side

READING = LabelImportContext(RULES, FRAMES)


def writing(labels: Labels, side: Side | None = None) -> LabelExportContext:
    return LabelExportContext.of(labels, DEFAULT_CLASSES, RIG, side)


def taken_in(before: Labels, found: ParsedLabels) -> Labels:
    plan = plan_import(found.observations, before)
    edit = ImportLabels(tuple(plan.elements), tuple(plan.observations))
    return before.changed(edit.changes(before, RULES))


def through_cvat(labels: Labels, folder: Path) -> Labels:
    write_cvat(writing(labels), folder / "street.xml")
    return taken_in(Labels(), read_cvat(folder / "street.xml", READING))


def through_cvat_video(labels: Labels, folder: Path) -> Labels:
    result = Labels()
    for side in ("left", "right"):
        write_cvat_video(writing(labels, side), folder / f"{side}.xml")
        result = taken_in(result, read_cvat(folder / f"{side}.xml", READING))
    return result


def through_labelme(labels: Labels, folder: Path) -> Labels:
    if not labels.observations:
        return Labels()
    write_labelme(writing(labels), folder, Sidecar())
    return taken_in(Labels(), read_labelme(folder, READING))


def through_coco(labels: Labels, folder: Path) -> Labels:
    write_coco(writing(labels), folder / "street.json")
    return taken_in(Labels(), read_coco(folder / "street.json", READING))


def test_elements_that_are_left_out_of_maps_are_not_written(tmp_path: Path) -> None:
    labels = street()
    first, *others = labels.elements
    decision = review_decision(first, "leave out")
    decided = labels.changed([RowChange(None, decision)])
    rows = len(labels.of_element(first))
    dropped = writing(decided).dropped
    assert dropped["labels of elements that a person left out of maps"] == rows
    back = through_coco(decided, tmp_path)
    assert len(back.elements) == len(others)
    assert len(back.observations) == len(labels.observations) - rows


@pytest.mark.parametrize("through", [through_cvat, through_labelme, through_coco])
@settings(max_examples=40)
@given(labels=any_labels())
def test_what_comes_back_is_the_same(
    through: Callable[[Labels, Path], Labels], labels: Labels
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        assert said(through(labels, Path(folder))) == said(labels)


@settings(max_examples=40)
@given(labels=any_labels())
def test_tracks_come_back_the_same_but_for_numbers(labels: Labels) -> None:
    """Each side is a file of its own; the second cannot have numbers below those of the first."""
    with tempfile.TemporaryDirectory() as folder:
        back = through_cvat_video(labels, Path(folder))
    assert unnumbered(back) == unnumbered(labels)


def unnumbered(labels: Labels) -> set[tuple[object, ...]]:
    return {(content[0].id, content[0].class_id, *content[1:]) for content in said(labels)}


@pytest.mark.parametrize(
    "value", [0.0, -0.5, 0.1, 1e-300, -1e-300, 5e-324, 0.30000000000000004, 1240.5, 123.456789]
)
def test_half_a_pixel_loses_no_digit(value: float) -> None:
    assert from_corner(to_corner(value)) == value


def test_where_the_centre_of_the_first_pixel_is(tmp_path: Path) -> None:
    """(0, 0) here is (0.5, 0.5) in CVAT and labelme, (0, 0) among COCO's keypoints, whose boxes
    count from the corner again."""
    from label_files import labels_of, pole

    labels = labels_of(pole(1, 0, "left", (0.0, 0.0)))
    write_cvat(writing(labels), tmp_path / "a.xml")
    assert 'points="0.5,0.5"' in (tmp_path / "a.xml").read_text()
    write_labelme(writing(labels), tmp_path, Sidecar())
    assert '"points": [[0.5, 0.5]]' in (tmp_path / "left" / "000000.json").read_text()
    write_coco(writing(labels), tmp_path / "a.json")
    flat = "".join((tmp_path / "a.json").read_text().split())
    assert '"keypoints":[0.0,0.0,2]' in flat
    assert '"bbox":[0.5,0.5,0.0,0.0]' in flat


@pytest.mark.parametrize("format_", ["cvat", "labelme", "coco"])
def test_a_label_file_goes_out_and_in(tmp_path: Path, format_: str) -> None:
    with (
        store_of(street(), tmp_path / "first") as first,
        store_of(Labels(), tmp_path / "second") as second,
    ):
        out = export_labels(first, tmp_path / "out", format_)  # type: ignore[arg-type]
        assert (out.observations, out.images, out.dropped) == (6, 6, {})
        report = import_labels(tmp_path / "out", second, "bea", frames=FRAMES)
        assert (report.observations, report.elements, report.format) == (6, 4, format_)
        assert report.dropped == {}
        assert said(second.labels) == said(first.labels)
        assert second.labels.elements == first.labels.elements
        assert second.last_operation == 1
        second.undo("bea")
        assert second.labels == Labels()
