"""Files that other tools wrote: refused by the right line, or read with a class map."""

from pathlib import Path

import pytest
from conftest import skip_or_fail

from semviz_annotation.label_formats.exchange import ImportReport, guess_format, import_labels
from semviz_annotation.storage.store import LabelStore
from semviz_core.common.errors import SemvizError

pytestmark = pytest.mark.realdata

POLES_OF_BOXES = "boxes of class pole: their axis is the pole; check its ends"
FILES = {
    "cvat": "cvat11_images_allshapes.xml",
    "labelme": "labelme5_primitives.json",
    "coco": "coco_keypoints.json",
}


@pytest.fixture
def annotations(kitti_root: Path) -> Path:
    folder = kitti_root.parent / "annotations"
    if not folder.is_dir():
        skip_or_fail(f"no annotations of other tools in {folder}")
    return folder


@pytest.fixture
def store(tmp_path: Path) -> LabelStore:
    """Without a rig: these images are of many sizes."""
    return LabelStore.open(tmp_path / "labels.db")


@pytest.mark.parametrize(
    ("format_", "words"),
    [
        (
            "cvat",
            r"allshapes.xml: 3 classes are not known; say --class-map label1=CLASS --cl",
        ),
        ("labelme", r"primitives.json: 6 classes are not known; .*line_strip=CLASS, CLASS being"),
        ("coco", r"keypoints.json: 2 classes are not known; .*-class-map female=CLASS"),
    ],
)
def test_classes_that_are_none_of_ours(
    annotations: Path, store: LabelStore, format_: str, words: str
) -> None:
    path = annotations / FILES[format_]
    assert guess_format(path) == format_
    with pytest.raises(SemvizError, match=words):
        import_labels(path, store, "ann", side="left")
    assert store.last_operation == 0


def test_cvat(annotations: Path, store: LabelStore) -> None:
    mapped = {"label1": "triangular sign", "label2": "rounded sign", "": "pole"}
    report = import_labels(annotations / FILES["cvat"], store, "ann", side="left", class_map=mapped)
    assert (report.images, report.observations, report.elements) == (2, 3, 3)
    sign, pole = sorted(store.labels.in_frame(0), key=lambda row: row.end_px is not None)
    # The box from (0, 2) to (4, 4), from the corner; a triangle's centroid is a sixth lower.
    assert sign.anchor_px == pytest.approx((1.5, 2.5 + 2.0 / 6.0))
    assert (pole.anchor_px, pole.end_px) == ((0.5, 1.5), (6.5, 7.5))
    (drawn,) = store.labels.in_frame(1)  # a polygon
    assert drawn.end_px is not None
    assert report.assumed == {"polygons of class pole: their axis is the pole; check its ends": 1}
    assert report.dropped["skeleton: neither line, point, box nor polygon"] == 2
    assert report.dropped["points of class rounded sign: a sign is one point, a box or a polygon"]


def test_labelme(annotations: Path, store: LabelStore) -> None:
    mapped = {"rectangle": "rectangular sign", "point": "round", "line": "pole"}
    mapped |= {"line_strip": "pole", "circle": "round", "polygon": "rectangular sign"}
    report = labelme(annotations, store, mapped)
    assert (report.observations, report.elements) == (7, 7)
    drawn = {row.anchor_px: row.end_px for row in store.labels.observations.values()}
    assert drawn[187.5, 177.5] == (159.5, 223.5)
    assert drawn[344.5, 173.5] is None
    assert drawn[81.5, 84.5] is None
    assert drawn[194.5, 83.5] is None
    assert report.dropped["mask: neither line, point, box nor polygon"] == 1


def labelme(annotations: Path, store: LabelStore, mapped: dict[str, str]) -> ImportReport:
    """Its image is called ``primitives.jpg``, which is no frame, so a numbered copy is read."""
    with pytest.raises(SemvizError, match=r"'primitives.jpg' has no frame number in its name; na"):
        import_labels(annotations / FILES["labelme"], store, "ann", class_map=mapped)
    text = (annotations / FILES["labelme"]).read_text()
    path = store.path.parent / "numbered.json"
    path.write_text(text.replace('"primitives.jpg"', '"primitives_7.jpg"'))
    return import_labels(path, store, "ann", side="left", class_map=mapped)


def test_coco(annotations: Path, store: LabelStore) -> None:
    mapped = {"male": "rounded sign", "female": "ignore"}
    report = import_labels(annotations / FILES["coco"], store, "ann", side="left", class_map=mapped)
    assert report.images == 3
    assert report.observations == len(store.labels.observations) > 0
    row = next(iter(store.labels.in_frame(113)))
    assert row.anchor_px == (
        pytest.approx(146.30914306640625 + 193.315673828125 / 2 - 0.5),
        pytest.approx(55.671630859375 + 357.3597717285156 / 2 - 0.5),
    )
    as_poles = import_labels(
        annotations / FILES["coco"], store, "ann", side="right",
        class_map={"male": "pole", "female": "ignore"},
    )  # fmt: skip
    assert as_poles.observations == as_poles.assumed[POLES_OF_BOXES] == 2
    assert as_poles.dropped["boxes of class pole: not slender, so they have no axis"] == 2
