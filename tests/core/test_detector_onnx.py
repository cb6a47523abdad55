"""Other people's models in ONNX: what they see comes through to the pixel, and what does not fit
is told. The models are made here, with answers that are known.
"""

import json
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semviz_core.base.classes import DEFAULT_CLASSES, POLE, RECTANGULAR, TRIANGULAR
from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.detection.detector import load_region_model
from semviz_core.detection.foreign_models import OnnxSettings, TransformersSettings
from semviz_core.detection.model_config import ProcessorInput, model_classes, read_settings
from semviz_core.detection.postprocessing import MOST_BOXES
from semviz_core.detection.regions import Region

onnx = pytest.importorskip("onnx", reason="makes ONNX models; pip install 'semviz[test]'")
pytest.importorskip("onnxruntime", reason="runs ONNX models; pip install 'semviz[onnx]'")

from onnx_models import COLORS, answering, choosy, describe, painted  # noqa: E402

REPOSITORY = Path(__file__).parents[2]
SIZE = (256, 128)
"""Of the models' inputs, which are not the image's."""
IMAGE_SIZE = (310, 94)
BOXES_PX = np.array(
    [[20.0, 10.0, 24.5, 80.0], [100.0, 30.0, 118.0, 47.5], [200.25, 3.0, 204.0, 88.75]]
)
BOX_LABELS = (1, 2, 1)
SCORES = np.array([0.9, 0.8, 0.6])


def gray(size: tuple[int, int] = IMAGE_SIZE) -> ByteImage:
    return np.full((size[1], size[0], 3), 90, np.uint8)


def in_input(boxes_px: FloatArray, resize: str) -> FloatArray:
    """(n, 4) centre, width, height in the input; written down apart from the code under test."""
    (width, height), (w, h) = SIZE, IMAGE_SIZE
    if resize == "stretch":
        across, down, left, top = width / w, height / h, 0.0, 0.0
    else:  # 256 / 310 is the smaller scale: 256 x 78 (77.6), 25 rows above
        across, down, left, top = 256 / 310, 78 / 94, 0.0, 25.0
    edges = boxes_px + 0.5
    x, y = edges[:, [0, 2]] * across + left, edges[:, [1, 3]] * down + top
    return np.stack([x.mean(1), y.mean(1), np.ptp(x, 1), np.ptp(y, 1)], axis=1)


def scores_of(labels: Sequence[int], scores: FloatArray, number: int = 3) -> FloatArray:
    table = np.full((len(labels), number), 1e-4)
    table[np.arange(len(labels)), labels] = scores
    return table


def yolo_v8(boxes: FloatArray, table: FloatArray) -> dict[str, Any]:
    return {"out": np.hstack([boxes, table]).T[None].astype(np.float32)}


def yolo_v5(boxes: FloatArray, table: FloatArray) -> dict[str, Any]:
    rows = np.hstack([boxes, np.full((len(boxes), 1), 0.95), table / 0.95])
    return {"out": rows[None].astype(np.float32)}


def detr(boxes: FloatArray, table: FloatArray) -> dict[str, Any]:
    odds = np.log(np.hstack([table, 1.0 - table.sum(1, keepdims=True)]))
    return {
        "logits": odds[None].astype(np.float32),
        "boxes": (boxes / [*SIZE, *SIZE])[None].astype(np.float32),
    }


def detr_sigmoid(boxes: FloatArray, table: FloatArray) -> dict[str, Any]:
    return detr(boxes, table) | {"logits": np.log(table / (1.0 - table))[None].astype(np.float32)}


LAYOUTS: dict[str, Callable[[FloatArray, FloatArray], dict[str, Any]]] = {
    "yolo-v5": yolo_v5,
    "yolo-v8": yolo_v8,
    "detr": detr,
    "detr sigmoid": detr_sigmoid,
}


def found(
    folder: Path, layout: str, boxes: FloatArray, table: FloatArray, **told: Any
) -> Sequence[Region]:
    """What a model that answers with these boxes of its input sees in a grey image."""
    outputs = LAYOUTS[layout](boxes, table)
    model = answering(folder / "planted.onnx", outputs, SIZE)
    told = {"kind": layout.split()[0], "outputs": list(outputs), **told}
    return load_region_model(str(describe(model, SIZE, **told))).find(gray())


@pytest.mark.parametrize("resize", ["stretch", "letterbox"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_planted_boxes_come_through_every_layout(tmp_path: Path, layout: str, resize: str) -> None:
    table = scores_of(BOX_LABELS, SCORES)
    regions = found(tmp_path, layout, in_input(BOXES_PX, resize), table, input={"resize": resize})
    assert [region.class_id for region in regions] == [POLE, None, POLE]
    assert [region.score for region in regions] == pytest.approx(SCORES, abs=1e-4)
    assert np.allclose([region.box_px for region in regions], BOXES_PX, atol=1e-3)


def test_of_boxes_that_overlap_the_better_stays_unless_one_is_a_pole(tmp_path: Path) -> None:
    middle, shift = np.array([[60.0, 60.0, 20.0, 20.0]]), np.array([0.0, 40.0, 0.0, 0.0])
    boxes = np.concatenate([middle, middle + 1.0, middle, middle + shift, middle])
    table = scores_of((2, 1, 0, 2, 3), np.array([0.5, 0.9, 0.4, 0.2, 0.99]), 4)
    classes = {"0": "pole", "1": "triangular sign", "2": "rectangular sign"}
    regions = found(tmp_path, "yolo-v8", boxes, table, labels=4, classes=classes)
    assert [region.class_id for region in regions] == [TRIANGULAR, POLE]
    apart = found(
        tmp_path, "yolo-v8", boxes, table, labels=4, classes=classes, most_overlap=0.9,
        least_score=0.1,
    )  # fmt: skip
    assert [element.class_id for element in apart] == [TRIANGULAR, RECTANGULAR, POLE, RECTANGULAR]


def test_a_flood_of_boxes_is_cut_at_the_best(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    boxes = np.column_stack([generator.uniform(40, 90, (5000, 2)), np.full((5000, 2), 4.0)])
    scores = generator.uniform(0.4, 0.9, 5000)
    table = scores_of([1] * 5000, scores)
    regions = found(tmp_path, "yolo-v8", boxes, table, most_overlap=1.0)
    assert len(regions) == MOST_BOXES
    assert min(region.score for region in regions) >= np.sort(scores)[-MOST_BOXES] - 1e-6


def scene() -> tuple[ByteImage, FloatArray]:
    """A pole and a sign on grey, and their boxes: a first pixel and a last."""
    image = gray((300, 120))
    image[8:108, 50:56] = COLORS["pole"]
    image[32:56, 200:224] = COLORS["sign"]
    return image, np.array([[50.0, 8.0, 55.0, 107.0], [200.0, 32.0, 223.0, 55.0]])


@pytest.mark.parametrize("label_map", [False, True])
def test_masks_of_a_model_at_the_images_size_are_exact(tmp_path: Path, label_map: bool) -> None:
    image, boxes_px = scene()
    size = (image.shape[1], image.shape[0])
    model = painted(tmp_path / "painted.onnx", size, stride=1, label_map=label_map)
    told = describe(model, size, outputs=["labels" if label_map else "logits"])
    pole, sign = sorted(
        load_region_model(str(told)).find(image), key=lambda element: element.class_id != POLE
    )
    assert (pole.class_id, sign.class_id) == (POLE, None)
    assert np.array_equal([pole.box_px, sign.box_px], boxes_px)
    for proposal in (pole, sign):
        assert proposal.mask is not None
        assert proposal.mask.all()
        assert proposal.corner_px == tuple(proposal.box_px[:2])
        assert proposal.score > 0.99


@pytest.mark.parametrize("resize", ["stretch", "letterbox"])
@pytest.mark.parametrize("stride", [2, 4])
def test_maps_of_low_resolution_land_where_the_image_has_them(
    tmp_path: Path, stride: int, resize: str
) -> None:
    """Half a pixel of the map forgotten would be 1 or 2 pixels of the image."""
    image, boxes_px = scene()
    model = painted(tmp_path / "painted.onnx", (512, 256), stride)
    told = describe(model, (512, 256), input={"resize": resize})
    regions = sorted(
        load_region_model(str(told)).find(image), key=lambda element: element.class_id != POLE
    )
    middles = [region.center_px for region in regions]
    assert np.allclose(middles, (boxes_px[:, :2] + boxes_px[:, 2:]) / 2.0, atol=0.6)


def test_blue_first_scale_mean_and_std_are_as_told(tmp_path: Path) -> None:
    """Colours given another way round, and brought back by what the TOML says, look the same."""
    image, boxes_px = scene()
    size = (image.shape[1], image.shape[0])
    model = painted(tmp_path / "painted.onnx", size, stride=1)
    told = describe(model, size, input={"scale": 1.0, "std": [255.0] * 3})
    assert len(load_region_model(str(told)).find(image)) == 2
    bgr = describe(model, size, input={"colors": "bgr"})
    regions = load_region_model(str(bgr)).find(np.ascontiguousarray(image[..., ::-1]))
    assert {tuple(region.box_px) for region in regions} == {tuple(box_px) for box_px in boxes_px}


def seen(tmp_path: Path, image: ByteImage) -> list[Region]:
    size = (image.shape[1], image.shape[0])
    model = painted(tmp_path / "painted.onnx", size, stride=1)
    regions = load_region_model(str(describe(model, size))).find(image)
    return sorted(regions, key=lambda region: float(region.box_px[0]))


def test_a_pole_behind_something_is_one_and_its_neighbours_are_others(tmp_path: Path) -> None:
    image = gray((200, 160))
    image[10:150, 40:45] = COLORS["pole"]
    image[60:100, 30:56] = (90, 90, 90)  # hides a part of it
    image[20:140, 90:94] = COLORS["pole"]
    image[20:140, 104:108] = COLORS["pole"]
    regions = seen(tmp_path, image)
    assert [region.box_px.tolist() for region in regions] == [
        [40, 10, 44, 149],
        [90, 20, 93, 139],
        [104, 20, 107, 139],
    ]
    assert regions[0].mask is not None
    assert not regions[0].mask[50:90].any()


def test_pieces_far_apart_or_beside_each_other_are_poles_of_their_own(tmp_path: Path) -> None:
    image = gray((200, 160))
    image[5:30, 40:44] = COLORS["pole"]
    image[90:115, 40:44] = COLORS["pole"]  # the gap is longer than either
    image[10:70, 100:104] = COLORS["pole"]
    image[80:140, 112:116] = COLORS["pole"]
    assert len(seen(tmp_path, image)) == 4


def test_a_bar_across_holds_no_poles_together_and_an_arm_is_cut(tmp_path: Path) -> None:
    image = gray((240, 160))
    image[10:150, 40:44] = COLORS["pole"]
    image[10:150, 100:104] = COLORS["pole"]
    image[30:33, 40:104] = COLORS["pole"]
    for row in range(20, 150):  # leans by 8 degrees
        column = 180 + row // 7
        image[row, column : column + 4] = COLORS["pole"]
    image[20:24, 150:183] = COLORS["pole"]
    left, right, leaning = seen(tmp_path, image)
    assert np.allclose(left.box_px, [40, 10, 43, 149], atol=1)
    assert np.allclose(right.box_px, [100, 10, 103, 149], atol=1)
    assert np.allclose(leaning.box_px, [182, 20, 204, 149], atol=2)
    assert leaning.mask is not None
    assert (leaning.mask[8:].sum(axis=1) == 4).all()


def test_specks_and_what_is_no_upright_are_dropped(tmp_path: Path) -> None:
    image = gray((200, 100))
    image[10:15, 20:22] = COLORS["pole"]
    image[50:60, 60:160] = COLORS["pole"]
    image[20:23, 100:120] = COLORS["sign"]
    assert not seen(tmp_path, image)


def test_the_tomls_of_the_docs_are_whole(tmp_path: Path) -> None:
    page = (REPOSITORY / "docs" / "detector.md").read_text().split("\n## Other models\n")[1]
    blocks = re.findall(r"^```toml\n(.*?)^```", page.split("\n## ")[0], re.MULTILINE | re.DOTALL)
    for number, block in enumerate(blocks):
        path = tmp_path / f"{number}.toml"
        path.write_text(block)
        if "kind = " not in block:
            read_settings(path, TransformersSettings)
            continue
        settings = read_settings(path, OnnxSettings)
        model_classes(settings.label_names, settings.classes, DEFAULT_CLASSES, path)
        assert f"`{settings.kind}`" in page
    assert len(blocks) == 4


Mutation = tuple[dict[str, Any], str]
MUTATIONS: dict[str, Mutation] = {
    "no file": ({"model": "other.onnx"}, r"other\.onnx: no such model"),
    "not ONNX": ({"model": "broken.onnx"}, r"broken\.onnx: not an ONNX model"),
    "kind": ({"kind": "yolo"}, r"planted\.toml: kind: "),
    "key": ({"treshold": 0.5}, r"planted\.toml: treshold: "),
    "size": ({"input": {"width": 320}}, r"takes \[1, 3, 128, 256\].*says \[1, 3, 128, 320\]"),
    "std": ({"input": {"std": [0, 1, 1]}}, r"planted\.toml: input: .*std above 0"),
    "output": ({"outputs": ["mask"]}, r"outputs: no 'mask' in the model, but logits"),
    "outputs": ({"outputs": ["a", "b"]}, r"outputs of kind segmentation are 1"),
    "labels": ({"labels": 4, "classes": {"1": "pole"}}, r"with 4 labels it is logits \(1, 4"),
    "no labels": ({"labels": 0}, r"labels: 0 of them; 1 to 10000 will do"),
    "too many": ({"labels": 10**12}, r"labels: 1000000000000 of them"),
    "layout": ({"kind": "yolo-v8"}, r"shape \(1, 3, 32, 64\); with 3 labels it is \(1, 7, boxes\)"),
    "its class": ({"classes": {"tree": "pole"}}, r"the model has no class 'tree'; it has road"),
    "lines": ({"labels": ["a\nb", "c", "d"], "classes": {"tree": "pole"}}, r"has a\\nb, c, d"),
    "our class": ({"classes": {"pole": "mast"}}, r"'pole' cannot be 'mast'; known are sign, ig"),
    "nothing": ({"classes": {"pole": "ignore"}}, r"no class of the model is a pole or a sign"),
}


@pytest.mark.parametrize("name", MUTATIONS)
def test_what_does_not_fit_is_one_line_that_names_the_file(tmp_path: Path, name: str) -> None:
    told, message = MUTATIONS[name]
    (tmp_path / "broken.onnx").write_bytes(b"a model it is not")
    model = answering(
        tmp_path / "planted.onnx", {"logits": np.zeros((1, 3, 32, 64), np.float32)}, SIZE
    )
    with pytest.raises(SemvizError, match=message) as raised:
        load_region_model(str(describe(model, SIZE, **told)))
    assert str(tmp_path) in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("outputs", "told", "message"),
    [
        (
            {"out": np.full((1, 7, 5), np.nan, np.float32)},
            {},
            "'out' holds other than finite numbers",
        ),
        ({"out": np.full((1, 7, 5), 9.0, np.float32)}, {}, "scores are not between 0 and 1"),
        ({"out": np.zeros((1, 5, 7), np.float32)}, {}, r"it is \(1, 7, boxes\)"),
        ({"out": np.zeros((1, 7, 5), np.float32)}, {"kind": "yolo-v5"}, r"it is \(1, boxes, 8\)"),
        (
            {"l": np.zeros((1, 5, 6), np.float32), "b": np.zeros((1, 5, 4), np.float32)},
            {"kind": "detr", "outputs": ["l", "b"]},
            r"logits of shape \(1, 5, 6\); with 3 labels they are \(1, boxes, 3\), or",
        ),
        (
            {"l": np.zeros((1, 5, 3), np.float32), "b": np.zeros((1, 4, 4), np.float32)},
            {"kind": "detr", "outputs": ["l", "b"]},
            r"boxes of shape \(1, 4, 4\); they are \(1, 5, 4\)",
        ),
        (
            {"out": np.full((1, 8, 8), 3)},
            {"kind": "segmentation"},
            "labels from 3 to 3; it has 3",
        ),
    ],
)
def test_other_outputs_than_told_are_refused(
    tmp_path: Path, outputs: dict[str, Any], told: dict[str, Any], message: str
) -> None:
    model = answering(tmp_path / "planted.onnx", outputs, SIZE)
    with pytest.raises(SemvizError, match=message) as raised:
        load_region_model(
            str(describe(model, SIZE, **{"kind": "yolo-v8", "outputs": ["out"], **told}))
        )
    assert "planted.onnx" in str(raised.value)


def test_a_model_that_fails_on_its_input_is_one_line(tmp_path: Path) -> None:
    told = describe(choosy(tmp_path / "choosy.onnx", (64, 64)), SIZE)
    with pytest.raises(
        SemvizError, match=r"choosy\.onnx: cannot run on \(1, 3, 128, 256\)"
    ) as raised:
        load_region_model(str(told))
    assert "\n" not in str(raised.value)
    assert not load_region_model(str(describe(told.with_suffix(".onnx"), (64, 64)))).find(gray())


def test_images_that_are_none_and_names_that_are_no_model(tmp_path: Path) -> None:
    model = painted(tmp_path / "painted.onnx", SIZE, 1)
    loaded = load_region_model(str(describe(model, SIZE)))
    assert loaded.name == "painted"
    assert not loaded.find(gray((1, 1)))
    with pytest.raises(SemvizError, match=r"shape \(94, 310\).*give \(height, width, 3\)"):
        loaded.find(gray()[..., 0])
    for name, message in {
        str(model): "name the TOML",
        str(tmp_path / "none.toml"): "no such file",
        str(tmp_path): "a folder of a transformers model, or hf:NAME",
        "yolov5s.pt": "not a model that semviz can read",
    }.items():
        with pytest.raises(SemvizError, match=message):
            load_region_model(name)


@pytest.mark.parametrize("package", ["onnxruntime", "transformers"])
def test_a_missing_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str
) -> None:
    told = describe(painted(tmp_path / "painted.onnx", SIZE, 1), SIZE)
    (tmp_path / "config.json").write_text("{}")
    monkeypatch.setitem(sys.modules, package, None)
    extra = {"onnxruntime": "onnx"}.get(package, package)
    with pytest.raises(SemvizError, match=rf"pip install 'semviz\[{extra}\]'"):
        load_region_model(str(told if extra == "onnx" else tmp_path))


CROPPED = {
    "image_processor_type": "MobileViTImageProcessor",
    "size": {"shortest_edge": 160},
    "do_center_crop": True,
    "crop_size": {"height": 128, "width": 256},
    "do_flip_channel_order": True,
}
"""Blue comes first: where an image is red is what the third label is told."""


def test_without_an_input_the_processor_beside_the_model_is_asked(tmp_path: Path) -> None:
    pytest.importorskip("transformers", reason="pip install 'semviz[transformers]'")
    told = describe(choosy(tmp_path / "model.onnx", SIZE), SIZE)
    told.write_text(re.sub(r"\[input\]\n(.+=.+\n)+", "", told.read_text()))
    with pytest.raises(SemvizError, match=r"preprocessor_config\.json: cannot be read"):
        load_region_model(str(told))
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(CROPPED))
    image = np.zeros((IMAGE_SIZE[1], IMAGE_SIZE[0], 3), np.uint8)
    image[..., 2] = 255
    image[30:60, 140:170] = [255, 0, 0]
    (region,) = load_region_model(str(told)).find(image)
    assert region.class_id is None
    np.testing.assert_allclose(region.box_px, [140.0, 30.0, 169.0, 59.0], atol=1.0)


def test_the_processor_is_of_an_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(CROPPED))
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(SemvizError, match=r"json needs transformers: pip install 'semviz\[tr"):
        ProcessorInput.load(tmp_path)
