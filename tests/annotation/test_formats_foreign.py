"""Projects of others: boxes, polygons, other names and sizes of images, CVAT's tasks."""

import json
import shlex
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from defusedxml import ElementTree
from hypothesis import given
from hypothesis import strategies as st
from label_files import FRAMES, RULES, labels_of, pole, said, store_of, street

from semviz_annotation.label_formats.coco import read_coco
from semviz_annotation.label_formats.cvat import read_cvat
from semviz_annotation.label_formats.exchange import export_labels, import_labels
from semviz_annotation.label_formats.import_context import LabelImportContext
from semviz_annotation.label_formats.labelme import read_labelme
from semviz_annotation.label_formats.reading import ParsedLabels
from semviz_annotation.label_formats.shapes import DrawnShape, axis, centroid
from semviz_annotation.labels.labels import Labels
from semviz_core.common.errors import SemvizError

CLASSES = {"Laterne": "pole", "Schild": "rounded sign", "*": "ignore"}
READING = LabelImportContext(RULES, FRAMES, "left", CLASSES, "centroid")


@given(
    middle=st.tuples(st.floats(-500, 500), st.floats(-500, 500)),
    length=st.floats(20.0, 300.0),
    width=st.floats(0.5, 9.0),
    turn=st.floats(-1.4, 1.4),
    order=st.permutations(range(5)),
)
def test_the_axis_of_a_strip_is_its_middle_line(
    middle: tuple[float, float], length: float, width: float, turn: float, order: list[int]
) -> None:
    """In whatever order its corners come, also with one inside, and beside any origin."""
    along = np.array([np.sin(turn), np.cos(turn)])
    across = np.array([along[1], -along[0]])
    offsets = [(-0.5, -0.5), (-0.5, 0.5), (0.5, 0.5), (0.5, -0.5), (0.1, 0.2)]
    corners = [np.array(middle) + s * length * along + t * width * across for s, t in offsets]
    points = [(float(corners[row][0]), float(corners[row][1])) for row in order]
    found = axis(points)
    assert found is not None
    upper, lower = found
    assert upper == pytest.approx(np.array(middle) - 0.5 * length * along, abs=1e-6)
    assert lower == pytest.approx(np.array(middle) + 0.5 * length * along, abs=1e-6)
    assert centroid(points) == pytest.approx(np.array(middle), abs=1e-6)


def test_what_is_not_slender_or_flat_has_no_axis() -> None:
    square = [(0.0, 0.0), (9.0, 0.0), (9.0, 9.0), (0.0, 9.0)]
    assert axis(square) is None
    assert centroid(square) == pytest.approx((4.5, 4.5))
    flat = [(0.0, 0.0), (5.0, 5.0), (9.0, 9.0)]
    assert axis(flat) is None
    assert centroid(flat[:2]) is None
    assert centroid([(0.0, 0.0), (6.0, 0.0), (0.0, 3.0)]) == pytest.approx((2.0, 1.0))


def test_a_turned_box_is_turned_about_its_middle() -> None:
    lying = DrawnShape("box", ((10.0, 95.0), (110.0, 105.0)), np.deg2rad(80.0))
    ends = axis(lying.corners)
    assert ends is not None
    reach = 50.0 * np.array([np.cos(np.deg2rad(80.0)), np.sin(np.deg2rad(80.0))])
    assert np.array(ends) - [60.0, 100.0] == pytest.approx(np.array([-reach, reach]))
    assert lying.below_middle(0.0) == pytest.approx((60.0, 100.0))


# -- each tool's own file

CVAT = """<annotations><version>1.1</version>
<image id="0" name="drive/left_000003.jpg" width="640" height="480">
 <box label="Laterne" occluded="1" xtl="100" ytl="50" xbr="110" ybr="250"/>
 <polygon label="Laterne" points="201,50;203,50;203,250;201,250"/>
 <polyline label="Laterne" points="300,250;301,150;302,50"/>
 <box label="Laterne" xtl="0" ytl="0" xbr="100" ybr="100"/>
 <polygon label="Schild" points="400,100;420,100;420,120;400,120"/>
 <ellipse label="Schild" cx="500" cy="60" rx="9" ry="11"/>
 <box label="Schild" xtl="10" ytl="20" xbr="30" ybr="40" rotation="30.00"/>
 <polygon label="road" points="1,2;3,4;5,6"/><mask label="Laterne" rle="1" left="0" top="0"/>
</image></annotations>"""


def coco() -> dict[str, Any]:
    here = {"image_id": 7, "iscrowd": 0, "area": 1.0}
    return {
        "images": [{"id": 7, "file_name": "3_png.rf.0a1b2c3d.jpg", "width": 640, "height": 480}],
        "categories": [{"id": n, "name": name} for n, name in enumerate(["Laterne", "Schild"])],
        "annotations": [
            here | {"id": 1, "category_id": 0, "bbox": [100, 50, 10, 200],
                    "attributes": {"occluded": True}},
            here | {"id": 2, "category_id": 0, "bbox": [201, 50, 2, 200],
                    "segmentation": [[201, 50, 203, 50, 203, 100, 201, 100],
                                     [201, 130, 203, 130, 203, 250, 201, 250]]},
            here | {"id": 3, "category_id": 1, "bbox": [0, 0, 99, 99],
                    "segmentation": [[400, 100, 420, 100, 420, 120, 400, 120]]},
            here | {"id": 4, "category_id": 1, "bbox": [491, 49, 18, 22],
                    "segmentation": {"counts": "abc", "size": [480, 640]}},
        ],
    }  # fmt: skip


def labelme() -> dict[str, Any]:
    def shape(kind: str, label: str, *points: list[float]) -> dict[str, Any]:
        return {"label": label, "shape_type": kind, "points": list(points), "flags": {}}

    return {
        "imagePath": "..\\img\\3.jpg", "imageWidth": 640, "imageHeight": 480, "imageData": None,
        "shapes": [
            shape("rectangle", "Laterne", [110, 250], [100, 50]),
            shape("polygon", "Laterne", [201, 50], [203, 50], [203, 250], [201, 250]),
            shape("linestrip", "Laterne", [300, 250], [301, 150], [302, 50]),
            shape("polygon", "Schild", [400, 100], [420, 100], [420, 120], [400, 120]),
            shape("circle", "Schild", [500, 60], [500, 70]),
            shape("polygon", "road", [1, 2], [3, 4], [5, 6]),
        ],
    }  # fmt: skip


def ends(found: ParsedLabels) -> dict[tuple[float, ...], tuple[float, ...] | None]:
    def rounded(point: tuple[float, float] | None) -> tuple[float, ...] | None:
        return None if point is None else tuple(np.round(point, 6))

    return {rounded(row.anchor_px) or (): rounded(row.end_px) for row in found.observations}


BOX, OUTLINE = {(104.5, 49.5): (104.5, 249.5)}, {(201.5, 49.5): (201.5, 249.5)}
LINE, SIGN = {(301.5, 49.5): (299.5, 249.5)}, {(409.5, 109.5): None}
ROUND = {(499.5, 59.5): None}


def test_cvat(tmp_path: Path) -> None:
    (tmp_path / "a.xml").write_text(CVAT)
    found = read_cvat(tmp_path / "a.xml", READING)
    assert ends(found) == BOX | OUTLINE | LINE | SIGN | ROUND | {(19.5, 29.5): None}
    assert {(row.frame_index, row.side) for row in found.observations} == {(3, "left")}
    assert [row.end_known for row in found.observations[:2]] == [False, True]
    assert found.assumed == {
        "boxes of class pole: their axis is the pole; check its ends": 1,
        "polygons of class pole: their axis is the pole; check its ends": 1,
        "poles drawn from their lower end: turned": 1,
    }
    assert found.dropped["boxes of class pole: not slender, so they have no axis"] == 1
    assert found.dropped["shapes of class 'road': ignored, as asked"] == 1


def test_coco(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps(coco()))
    found = read_coco(tmp_path / "a.json", READING)
    assert ends(found) == BOX | OUTLINE | SIGN | ROUND
    assert [row.end_known for row in found.observations[:2]] == [False, True]
    assert found.dropped["masks (run lengths) of 'segmentation': the bbox is taken"] == 1


def test_labelme(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps(labelme()))
    found = read_labelme(tmp_path / "a.json", READING)
    assert ends(found) == BOX | OUTLINE | LINE | SIGN | ROUND


def test_all_unknown_classes_are_told_at_once(tmp_path: Path) -> None:
    (tmp_path / "a.xml").write_text(CVAT.replace('"road"', '"Mast \'7"'))
    with pytest.raises(SemvizError) as caught:
        read_cvat(tmp_path / "a.xml", LabelImportContext(RULES, FRAMES, "left"))
    words = shlex.split(str(caught.value).replace(",", " ").replace(";", " "))
    options = [word for before, word in pairwise(words) if before == "--class-map"]
    assert options == ["Laterne=CLASS", "Schild=CLASS", "Mast '7=CLASS", "*=ignore"]
    assert "a.xml: 3 classes are not known; say" in str(caught.value)


@pytest.mark.parametrize("write", [coco, labelme])
@pytest.mark.parametrize("scale", [2.0, 0.9, 3.3])
def test_labels_of_a_scaled_image_are_scaled(tmp_path: Path, write: Any, scale: float) -> None:
    """From the image's corner: its pixels have another size."""
    document = write()
    size = round(640 * scale), round(480 * scale)
    text = json.dumps(document).replace('idth": 640', f'idth": {size[0]}')
    (tmp_path / "a.json").write_text(text.replace('eight": 480', f'eight": {size[1]}'))
    read = read_coco if write is coco else read_labelme
    found = read(tmp_path / "a.json", READING)
    small = {point: end for point, end in ends(found).items() if end is None}
    expected = (np.array([410.0, 110.0]) / scale) - 0.5
    assert min(np.abs(np.array(point) - expected).max() for point in small) < 0.01
    assert found.assumed["labels of images of another size: scaled to that of the workspace"] >= 4


@pytest.mark.parametrize("size", [(642, 480), (638, 482), (640, 360), (480, 640)])
def test_other_images_are_not_taken_for_scaled_ones(tmp_path: Path, size: tuple[int, int]) -> None:
    document = coco()
    document["images"][0] |= {"width": size[0], "height": size[1]}
    (tmp_path / "a.json").write_text(json.dumps(document))
    with pytest.raises(SemvizError, match="are 640x480, and not the same ones scaled"):
        read_coco(tmp_path / "a.json", READING)


# -- CVAT's tasks


def drive(first: int, step: int) -> Labels:
    """Two poles: one in every image, one in the third alone."""
    frames = [first + step * number for number in range(5)]
    everywhere = [pole(1, frame, "left", (10.0, 20.0), (11.0, 99.0)) for frame in frames]
    return labels_of(*everywhere, pole(2, frames[2], "left", (50.0, 20.0), (51.0, 99.0)))


@pytest.mark.parametrize(("first", "step"), [(0, 1), (100, 1), (7, 5)])
@pytest.mark.parametrize("start_frame", [None, 0])
def test_a_task_holds_every_shape_of_its_file(
    tmp_path: Path, first: int, step: int, start_frame: int | None
) -> None:
    """CVAT refuses frames that are not in ``range(size)`` after its start frame and step."""
    frames = [first + step * number for number in range(5)]
    with store_of(drive(first, step), tmp_path / "first") as store:
        export_labels(
            store, tmp_path / "a.xml", "cvat-video", frames=frames, start_frame=start_frame
        )
        before = said(store.labels)
    task = ElementTree.parse(tmp_path / "a.xml").getroot().find("meta/task")
    start, stop, size = (int(task.findtext(name)) for name in ("start_frame", "stop_frame", "size"))
    task_step = int(task.findtext("frame_filter").removeprefix("step=") or 1)
    assert (start, stop) == ((first, frames[-1]) if start_frame is None else (0, 4))
    assert [task.findtext(f"original_size/{name}") for name in ("width", "height")] == [
        "640",
        "480",
    ]
    shapes = ElementTree.parse(tmp_path / "a.xml").findall("track/polyline")
    within = [divmod(int(shape.get("frame")) - start, task_step) for shape in shapes]
    assert {rest for _, rest in within} == {0}
    assert {number for number, _ in within} <= set(range(size))
    assert size == 5
    assert sum(shape.get("outside") == "1" for shape in shapes) == 1
    with store_of(Labels(), tmp_path / "second") as store:
        import_labels(tmp_path / "a.xml", store, "bea", frames=frames, side="left")
        assert said(store.labels) == before


def test_a_task_of_other_images_keeps_its_numbers(tmp_path: Path) -> None:
    """Only as many images as the workspace has are taken for them, in their order."""
    with store_of(drive(10, 1), tmp_path / "first") as store:
        export_labels(store, tmp_path / "a.xml", "cvat-video", frames=range(10, 15), start_frame=0)
    context = LabelImportContext(RULES, range(10, 16), "left")
    with pytest.raises(SemvizError, match="frame 0 is not there"):
        read_cvat(tmp_path / "a.xml", context)
    found = read_cvat(tmp_path / "a.xml", LabelImportContext(RULES, range(20, 25), "left"))
    assert [row.frame_index for row in found.observations] == [*range(20, 25), 22]
    assert found.assumed["frames of tracks: the task's images are the workspace's, in order"] == 6


def test_tracks_of_a_scaled_video_are_scaled(tmp_path: Path) -> None:
    with store_of(street(), tmp_path / "first") as store:
        export_labels(store, tmp_path / "a.xml", "cvat-video", frames=FRAMES)
    text = (tmp_path / "a.xml").read_text()
    double = text.replace("<width>640<", "<width>1280<").replace("<height>480<", "<height>960<")
    (tmp_path / "b.xml").write_text(double)
    whole, scaled = (
        read_cvat(tmp_path / name, LabelImportContext(RULES, FRAMES)) for name in ("a.xml", "b.xml")
    )
    u, v = whole.observations[-1].anchor_px
    assert scaled.observations[-1].anchor_px == pytest.approx((0.5 * u - 0.25, 0.5 * v - 0.25))
