"""CVAT 1.1: what is understood, what is dropped, what is refused."""

import json
from pathlib import Path

import pytest
from defusedxml import ElementTree
from label_files import FRAMES, RIG, RULES, labels_of, pole

from semviz_annotation.label_formats.cvat import read_cvat, write_cvat, write_cvat_video
from semviz_annotation.label_formats.import_context import LabelImportContext
from semviz_annotation.label_formats.import_plan import plan_import
from semviz_annotation.label_formats.reading import MOST_XML_BYTES, ParsedLabels
from semviz_annotation.label_formats.writing import LabelExportContext
from semviz_annotation.labels.labels import Labels
from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.common.errors import SemvizError

REPOSITORY = Path(__file__).parents[2]
READING = LabelImportContext(RULES, FRAMES)
POLE = '<polyline label="pole" occluded="0" points="10.5,20.5;11.5,200.5"/>'


def image(
    inside: str, name: str = "left/000003.png", size: str = 'width="640" height="480"'
) -> str:
    return f'<image id="0" name="{name}" {size}>{inside}</image>'


def read(tmp_path: Path, inside: str, reading: LabelImportContext = READING) -> ParsedLabels:
    path = tmp_path / "street.xml"
    path.write_text(f"<annotations><version>1.1</version>{inside}</annotations>")
    return read_cvat(path, reading)


def test_images(tmp_path: Path) -> None:
    found = read(
        tmp_path,
        image(
            POLE + '<points label="rounded_sign" occluded="1" z_order="2" points="7.5,8.5">'
            '<attribute name="colour">red</attribute></points>'
            '<box label="Triangle-Sign" xtl="10.5" ytl="20.5" xbr="30.5" ybr="60.5" occluded="0"/>'
        )
        + image("", "left/000004.png")
        + image(
            '<polyline label="lamp post" occluded="1" points="1,2;3,4;5,99"/>', "image_3/5.png"
        ),
    )
    first, second, third, fourth = found.observations
    assert (first.frame_index, first.side, first.class_id) == (3, "left", 0)
    assert (first.anchor_px, first.end_px) == ((10.0, 20.0), (11.0, 200.0))
    assert (second.class_id, second.anchor_px, second.end_px) == (3, (7.0, 8.0), None)
    assert (third.class_id, third.anchor_px) == (1, (20.0, 40.0))
    assert (fourth.frame_index, fourth.side, fourth.class_id) == (5, "right", 0)
    assert (fourth.anchor_px, fourth.end_px) == ((0.5, 1.5), (4.5, 98.5))
    assert (first.end_known, fourth.end_known, fourth.anchor_known) == (True, False, True)
    assert found.images == 3
    assert found.dropped == {
        "z_order: not known here": 1,
        "occluded on a sign: not known here": 1,
        "inner points of lines: a pole is its peak and its bottom": 1,
    }


def test_tracks_end_where_they_are_outside(tmp_path: Path) -> None:
    shape = '<polyline frame="{}" outside="{}" occluded="0" keyframe="1" points="10,20;11,{}"/>'
    tracks = (
        '<meta><task><name>drive_right</name></task></meta>'
        '<track id="7" label="pole">'
        + shape.format(3, 0, 90) + shape.format(4, 0, 95) + shape.format(5, 1, 95)
        + '</track><track id="8" label="pole">' + shape.format(3, 0, 99) + "</track>"
    )  # fmt: skip
    found = read(tmp_path, tracks)
    assert [
        (observation.frame_index, observation.side, observation.number)
        for observation in found.observations
    ] == [
        (3, "right", 7),
        (4, "right", 7),
        (3, "right", 8),
    ]
    plan = plan_import(found.observations, Labels())
    assert (len(plan.elements), len(plan.observations)) == (2, 3)
    assert found.dropped == {}


def test_a_track_needs_a_side(tmp_path: Path) -> None:
    track = '<track id="7" label="pole"><polyline frame="3" outside="0" points="1,2;3,40"/></track>'
    with pytest.raises(SemvizError, match=r"item 1: a track does not say whether .* --side left"):
        read(tmp_path, track)
    assert (
        read(tmp_path, track, LabelImportContext(RULES, side="right")).observations[0].side
        == "right"
    )


def test_a_track_is_ended_where_nothing_follows(tmp_path: Path) -> None:
    """Otherwise CVAT would carry the last shape on to the end of the drive."""
    ends = (10.0, 20.0), (11.0, 99.0)
    labels = labels_of(*(pole(1, frame, "left", *ends) for frame in (2, 3, 7)))
    write_cvat_video(
        LabelExportContext.of(labels, DEFAULT_CLASSES, RIG, "left", FRAMES), tmp_path / "a.xml"
    )
    text = (tmp_path / "a.xml").read_text()
    frames = [(f'frame="{n}" outside="{o}"' in text) for n, o in ((2, 0), (3, 0), (4, 1), (8, 1))]
    assert frames == [True] * 4
    assert 'frame="3" outside="1"' not in text


def test_the_documented_labels_are_those_that_a_file_lists(tmp_path: Path) -> None:
    write_cvat(LabelExportContext.of(labels_of(), DEFAULT_CLASSES, RIG), tmp_path / "a.xml")
    written = ElementTree.parse(tmp_path / "a.xml").findall("meta/task/labels/label")
    documented = json.loads((REPOSITORY / "docs" / "formats" / "cvat_labels.json").read_text())
    assert [
        (label.findtext("name"), label.findtext("type"), label.findtext("color"),
         [attribute.findtext("name") for attribute in label.findall("attributes/attribute")])
        for label in written
    ] == [
        (
            class_["name"],
            class_["type"],
            class_["color"],
            [part["name"] for part in class_["attributes"]],
        )
        for class_ in documented
    ]  # fmt: skip


@pytest.mark.parametrize("by", ["group", "name"])
def test_groups_and_names_are_elements(tmp_path: Path, by: str) -> None:
    marked = {
        "group": POLE.replace("occluded", 'group_id="5" occluded'),
        "name": POLE.replace("/>", '><attribute name="element">lamp 5</attribute></polyline>'),
    }[by]
    found = read(tmp_path, image(marked) + image(marked, "right/3.png") + image(POLE, "left/4.png"))
    plan = plan_import(found.observations, Labels())
    assert len(plan.elements) == 2
    assert plan.observations[0].element_id == plan.observations[1].element_id
    twice = image(marked + marked.replace("10.5", "99.5"))
    with pytest.raises(SemvizError, match=r"street.xml, item 2: element .* is twice in this image"):
        plan_import(read(tmp_path, twice).observations, Labels())


def test_known_ends_are_attributes(tmp_path: Path) -> None:
    known = '<attribute name="{}">{}</attribute>'
    shape = POLE.replace('occluded="0"', 'occluded="1"').replace("/>", ">{}</polyline>")
    (track,) = read(
        tmp_path, image(shape.format(known.format("anchor_known", "False")))
    ).observations
    assert (track.anchor_known, track.end_known) == (False, False)
    (track,) = read(tmp_path, image(shape.format(known.format("end_known", "true")))).observations
    assert (track.anchor_known, track.end_known) == (True, True)


def test_other_shapes_and_ignored_classes_are_dropped_by_name(tmp_path: Path) -> None:
    others = (
        '<polygon label="car" points="1,2;3,4;5,6"/><tag label="rain"/><cuboid label="car"/>'
        '<skeleton label="man"><points label="1" points="1,1"/></skeleton>'
        '<box label="car" xtl="1" ytl="1" xbr="2" ybr="2"/>'
        '<points label="rounded sign" points="1,2;3,4"/>'
        '<box label="pole" xtl="1" ytl="1" xbr="2" ybr="99"/>'
    )
    found = read(
        tmp_path, image(others + POLE), LabelImportContext(RULES, class_map={"car": "ignore"})
    )
    assert len(found.observations) == 2
    assert sum(found.dropped.values()) == 6
    assert "cuboid: neither line, point, box nor polygon" in found.dropped
    assert "shapes of class 'car': ignored, as asked" in found.dropped


def test_a_class_map_names_classes(tmp_path: Path) -> None:
    lamp = POLE.replace('"pole"', '"Laterne"')
    assert read(
        tmp_path, image(lamp), LabelImportContext(RULES, class_map={"Laterne": "pole"})
    ).observations
    with pytest.raises(SemvizError, match="'Laterne' is mapped to 'tree', which is not known"):
        read(tmp_path, image(lamp), LabelImportContext(RULES, class_map={"Laterne": "tree"}))


@pytest.mark.parametrize(
    ("inside", "words"),
    [
        (image('<polyline label="pole" points="1,2"/>'), "item 1: a polyline with 1 point"),
        (image(POLE + POLE.replace("pole", "car")), r"item 2: class 'car'.*--class-map car=CLASS"),
        (image(POLE.replace("20.5", "nan")), "item 1: 'nan' is not a number"),
        (image(POLE.replace("20.5", "1e999")), "item 1: '1e999' is too large"),
        (image(POLE.replace("20.5", "1" * 500)), "item 1: '1+ ... is not a number"),
        (image(POLE.replace(",20.5", "")), "item 1: '10.5' is not a point"),
        (image(POLE.replace("10.5,", "-0.1,")), "outside the left image"),
        (image(POLE.replace("11.5,200.5", "10.5,20.6")), "the same point"),
        (image(POLE.replace(' points="', ' nope="')), "a shape without 'points'"),
        (image(POLE, size='width="641" height="480"'), "641x480, but the left images .* 640x480"),
        (image(POLE, size='width="-1" height="480"'), "an image of -1 by 480 pixels"),
        (image(POLE, size='width="9.5" height="480"'), "an image of 9.5 by 480"),
        (image(POLE, size='width="640"'), "an image without 'height'"),
        (image(POLE, "left/x.png"), "no frame number in its name"),
        (image(POLE, "left/99.png"), "of frame 99, which is not there"),
        (image(POLE, "left/3_right.png"), "says both left and right"),
        (image(POLE, "000003.png"), "does not say whether it is left or right"),
        (image('<box label="round" xtl="9" ytl="1" xbr="2" ybr="2"/>'), "a box of negative size"),
        (image(POLE.replace('"0"', '"yes"')), "occluded is neither 0 nor 1"),
        (image(POLE.replace("/>", ' group_id="1.5"/>')), "not a whole number"),
        (image("<a>" * 40 + "</a>" * 40), "nested too deeply"),
        ("<version>2.0</version>", "version '2.0' of CVAT's format"),
        (image(POLE)[:-9], "not XML"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, inside: str, words: str) -> None:
    with pytest.raises(SemvizError, match=words) as caught:
        read(tmp_path, inside)
    line = str(caught.value)
    assert line.startswith(str(tmp_path / "street.xml"))
    assert line.endswith(". Nothing was imported.")
    assert "\n" not in line


LAUGHS = "".join(f'<!ENTITY a{n} "&a{n - 1};&a{n - 1};&a{n - 1};&a{n - 1};">' for n in range(1, 20))


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (f"<!DOCTYPE a [<!ENTITY a0 'ha'>{LAUGHS}]><annotations>&a19;</annotations>", "entities"),
        ("<!DOCTYPE a SYSTEM 'file:///etc/passwd'><annotations/>", "document type"),
        ("<html/>", "the outermost element is 'html'"),
        ("", "not XML"),
        ("<annotations>\x00</annotations>", "not XML"),
        ("<?xml version='1.0' encoding='klingon'?><annotations/>", "not XML"),
    ],
)
def test_what_is_no_cvat_is_refused(tmp_path: Path, data: str, words: str) -> None:
    path = tmp_path / "street.xml"
    path.write_text(data)
    with pytest.raises(SemvizError, match=words):
        read_cvat(path, READING)


def test_a_huge_file_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "a.xml").open("wb") as file:
        file.truncate(MOST_XML_BYTES + 1)
    with pytest.raises(SemvizError, match=r"more than 128 MB; split the file"):
        read_cvat(tmp_path / "a.xml", READING)
